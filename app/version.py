"""The version of the service, as its package metadata states it."""

from importlib.metadata import version

VERSION = version("posematch")
