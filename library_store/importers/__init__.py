"""Motion capture files as users have them, read as clips of 14-joint poses in mm, Y up."""

from library_store.importers.clip import Clip, MocapError
from library_store.importers.npz import states_licence
from library_store.importers.npz import write as write_npz
from library_store.importers.reader import find_files, read, read_all, read_each

__all__ = [
    "Clip",
    "MocapError",
    "find_files",
    "read",
    "read_all",
    "read_each",
    "states_licence",
    "write_npz",
]
