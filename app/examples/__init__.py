"""Example bodies of the API, shown by the OpenAPI document: real answers, kept as JSON files."""
