"""The functions of csrc/library/pgccd.h, which the library of the compiled operators contains, for ctypes. A call takes
less time than a torch operator's, and releases the global interpreter lock.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from ctypes import POINTER, c_char_p, c_double, c_int32, c_int64, c_size_t, c_void_p

import torch
from torch import Tensor

from pgccd.ops.library import _C

_TYPES = {torch.uint8: 0, torch.int32: 1, torch.int64: 2, torch.float32: 3, torch.float64: 4}
_MESSAGE_BYTES = 512
#: What a call returns if another thread uses the validator.
BUSY = -1


class _Table(ctypes.Structure):
    _fields_ = [("data", c_void_p), ("shape", c_int64 * 3), ("dimensions", c_int32), ("type", c_int32)]


class Motion(ctypes.Structure):
    """As in pgccd.h."""

    _fields_ = [("free_until", c_double), ("bodies", c_int32 * 2), ("point", c_double * 3), ("pair_spans", c_int64)]


_library = ctypes.CDLL(str(_C.__file__))
_library.pgccd_validator_new.restype = c_void_p
_library.pgccd_validator_new.argtypes = [POINTER(_Table), c_int32, c_double, c_double, c_char_p, c_size_t]
_library.pgccd_validator_load.restype = c_void_p
_library.pgccd_validator_load.argtypes = [c_char_p, c_char_p, c_size_t]
_library.pgccd_validator_save.argtypes = [c_void_p, c_char_p, c_char_p, c_size_t]
_library.pgccd_validator_clone.restype = c_void_p
_library.pgccd_validator_clone.argtypes = [c_void_p]
_library.pgccd_validator_free.argtypes = [c_void_p]
_library.pgccd_validator_free.restype = None
_library.pgccd_check_motion.argtypes = [c_void_p, c_void_p, c_void_p, c_int64, c_void_p]
_library.pgccd_check_states.argtypes = [c_void_p, c_void_p, c_int64, c_void_p]
_check_motion, _check_states = _library.pgccd_check_motion, _library.pgccd_check_states


class NativeValidator:
    """A validator of the library, for configurations of `width` values. It is freed with this object.

    Args:
        handle: of the library's validator.
        width: J.
        tables: are kept as long as the validator.
    """

    def __init__(self, handle: int, width: int, tables: Sequence[Tensor]) -> None:
        self._handle, self._width, self._tables = handle, width, tables
        self._ends = ((c_double * width)(), (c_double * width)())
        self._motion = Motion()
        self._begin, self._end, self._found = *map(ctypes.addressof, self._ends), ctypes.addressof(self._motion)

    @classmethod
    def of(cls, tables: Sequence[Tensor], width: int, room: float, resolution: float) -> NativeValidator:
        """From the tables of the operators' arguments: `mesh_set`, `arm`, `bodies`, `obstacles`; all on the CPU."""
        kept = [tensor.contiguous() for tensor in tables]
        rows = (_Table * len(kept))()
        for row, tensor in zip(rows, kept, strict=True):
            row.data, row.dimensions, row.type = tensor.data_ptr(), tensor.dim(), _TYPES[tensor.dtype]
            row.shape[: tensor.dim()] = tensor.shape
        message = ctypes.create_string_buffer(_MESSAGE_BYTES)
        handle = _library.pgccd_validator_new(rows, len(kept), room, resolution, message, _MESSAGE_BYTES)
        if not handle:
            raise ValueError(message.value.decode())
        return cls(handle, width, kept)

    def clone(self) -> NativeValidator:
        """Another one, with the same tables."""
        return NativeValidator(_library.pgccd_validator_clone(self._handle), self._width, self._tables)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes it to a file.

        Raises:
            OSError: it cannot be written.
        """
        message = ctypes.create_string_buffer(_MESSAGE_BYTES)
        if _library.pgccd_validator_save(self._handle, os.fsencode(path), message, _MESSAGE_BYTES):
            raise OSError(message.value.decode())

    def check_motion(self, start: Sequence[float], goal: Sequence[float], budget: int, wants_first: bool) -> int:
        """The verdict, or `BUSY`. If the first contact is wanted, `motion` tells more.

        Raises:
            TypeError, ValueError: a configuration does not have `width` numbers.
        """
        self._ends[0][:] = list(start)
        self._ends[1][:] = list(goal)
        return int(_check_motion(self._handle, self._begin, self._end, budget, self._found if wants_first else None))

    @property
    def motion(self) -> Motion:
        """Of the last call of `check_motion`."""
        return self._motion

    def check_states(self, states: Tensor) -> Tensor | None:
        """(K,) bool: whether no two bodies touch in configurations (K, J) float64; None if the validator is busy."""
        valid = torch.empty(len(states), dtype=torch.uint8)
        code = _check_states(self._handle, states.data_ptr(), len(states), valid.data_ptr())
        return None if code == BUSY else valid.bool()

    def __del__(self) -> None:
        _library.pgccd_validator_free(self._handle)
