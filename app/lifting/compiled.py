"""The loops of lifting that are compiled: resection, ensemble, evidence and update.cpp.

They trust the shapes that they are told, so only the modules that check them call them. They run
without Python's lock.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path

from app.lifting.geometry import Floats, Integers

_FILE = Path(__file__).with_name("_lifting.so")
_ADDRESS = ctypes.c_char * 0


def pointer(array: Floats | Integers) -> ctypes.Array[ctypes.c_char] | int:
    """Where a contiguous array's numbers are, as the loops take it.

    ``array.ctypes`` says it too, and takes three times as long.
    """
    if not array.flags.writeable:
        return array.ctypes.data
    return _ADDRESS.from_buffer(array)  # type: ignore[arg-type]  # numpy arrays are buffers


@cache
def compiled() -> ctypes.CDLL:
    """The library of the loops; ``ImportError`` when it was not compiled."""
    try:
        library = ctypes.CDLL(str(_FILE))
    except OSError as error:
        raise ImportError(
            f"{_FILE} cannot be loaded ({error}); install posematch again: `scripts/setup`, or "
            "pip, compiles it"
        ) from error
    array, number, real = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
    library.posematch_resect.argtypes = [
        *(number, number, array, array, array, array, ctypes.c_int),
        *(number, real, real, array, array, array, array),
    ]
    library.posematch_resect.restype = None
    library.posematch_place.argtypes = [
        *(number, number, array, array, array, array),
        *(number, number, array, number, number, real, real, real),
        *(number, array, array, array, array, array),
    ]
    library.posematch_place.restype = real
    library.posematch_local_prior.argtypes = [
        *(number, number, array, number, array, array),
        *(number, array, real, real, array, array, array, array),
    ]
    library.posematch_local_prior.restype = None
    library.posematch_evidence.argtypes = [
        *(number, number, array, array, array, real, array, array, array),
    ]
    library.posematch_evidence.restype = None
    library.posematch_observe_state.argtypes = [
        *(number, array, array, array, array, array, real, real),
    ]
    library.posematch_observe_state.restype = None
    library.posematch_observe_joints.argtypes = [
        *(number, number, array, array, array, array, array),
    ]
    library.posematch_observe_joints.restype = None
    library.posematch_observe_pairs.argtypes = [
        *(number, array, array, real, real, number, array, real),
    ]
    library.posematch_observe_pairs.restype = None
    library.posematch_answer.argtypes = [
        *(number, array, array, real, real, real, number, array, array),
        *(number, number, real, number, array, array, array, array),
    ]
    library.posematch_answer.restype = real
    return library
