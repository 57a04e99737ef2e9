"""Arrays that users give: coordinates and indices as NumPy arrays, and warnings of coordinates that float32 has
rounded.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from torch import Tensor

from pgccd import arguments

# A face is distorted if its edges, and a body if its radius, are at most so many units in the last place of float32.
FEW_UNITS = 4


def as_array(values: Any, dtype: type, name: str, width: int | None) -> np.ndarray:
    """(n, width), or (n,) for a width of None: float64, or int64 of integers. An empty list has any shape.

    Raises:
        TypeError, ValueError: naming the argument, it is no such array.
    """
    values = arguments.as_tensor(values, name)
    if isinstance(values, Tensor):
        arguments.refuse_gradient(values, name)
    numbers = "float32, float64 or integers" if dtype is np.float64 else "integers"
    try:
        raw = values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)
    except (TypeError, ValueError, RuntimeError) as error:  # ragged lists, bfloat16
        raise TypeError(f"{name}: expected {numbers}, got {arguments.describe(values)}: {error}") from error
    is_real = raw.dtype.kind == "f" and raw.dtype.itemsize in (4, 8)
    if raw.size and not (raw.dtype.kind in "iu" or (is_real and dtype is np.float64)):
        raise TypeError(f"{name}: expected {numbers}, got {raw.dtype}")
    expected = (width,) if width is not None else ()
    if raw.ndim != 1 + len(expected) or raw.shape[1:] != expected:
        if raw.size or raw.ndim > 2:
            shape = "(n,)" if width is None else f"(n, {width})"
            raise ValueError(f"{name}: expected shape {shape}, got {raw.shape}")
        raw = raw.reshape(0, *expected)
    return np.ascontiguousarray(raw, dtype=dtype)


def is_float32(values: np.ndarray) -> bool:
    """Whether all values are representable in float32."""
    with np.errstate(over="ignore"):
        return bool((values.astype(np.float32) == values).all())


def warn_of_rounding(points: np.ndarray, faces: np.ndarray, source: str = "", stacklevel: int = 3) -> None:
    """Warns of faces that are as small as the rounding of float32.

    Args:
        points: (V, 3) finite, given in float32.
        faces: (F, 3); points are not looked at.
        source: where the points come from, in words, at the start of the message. Default: an argument.
        stacklevel: see `warnings.warn`.
    """
    corners = points[faces[faces[:, 0] != faces[:, 1]]]
    if len(corners) == 0:
        return
    size = np.abs(corners - np.roll(corners, 1, axis=1)).max(axis=(1, 2))
    unit = np.spacing(np.abs(corners).max(axis=(1, 2)).astype(np.float32)).astype(np.float64)
    is_lost = size <= FEW_UNITS * unit
    if is_lost.any():
        face = int(np.argmax(is_lost))
        warnings.warn(
            f"{source or 'vertices'}: float32 has distorted {int(is_lost.sum())} of {len(faces)} faces: the edges of "
            f"face {face} are at most {size[face]:.3g} long, where coordinates are multiples of {unit[face]:.3g}. "
            + ("Export the file again" if source else "Give float64, or coordinates")
            + " relative to a point nearby",
            UserWarning,
            stacklevel=stacklevel,
        )
