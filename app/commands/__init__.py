"""The sub-commands of ``posematch``, one module a topic, and the console they share."""
