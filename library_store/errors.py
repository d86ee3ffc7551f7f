"""What can go wrong with a library.

LibraryError
    The library is missing, incomplete, corrupt or of another format. The message names the file and
    says how to mend it; it is meant for the person who runs the service.

IndexUnavailableError
    The engine that holds the index of a library in service does not answer now. It may well do so
    in a moment.
"""

from __future__ import annotations


class LibraryError(Exception):
    """A library cannot be used; the message names the file and the way to mend it."""


class IndexUnavailableError(Exception):
    """The index's engine is away; ask again after ``retry_after_s`` seconds."""

    def __init__(self, message: str, retry_after_s: int) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s
