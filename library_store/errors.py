"""What can go wrong with a library on disk.

LibraryError
    The library is missing, incomplete, corrupt or of another format. The message names the file and
    says how to mend it; it is meant for the person who runs the service.
"""

from __future__ import annotations


class LibraryError(Exception):
    """A library cannot be used; the message names the file and the way to mend it."""
