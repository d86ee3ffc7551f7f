"""The service: HTTP in, JSON out, and the lifting pipeline behind it."""
