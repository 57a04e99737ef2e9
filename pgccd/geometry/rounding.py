"""Meshes that float32 has distorted: far from the origin of their coordinates distinct vertices become equal."""

import warnings

import numpy as np

# A face whose edges are at most so many units in the last place has lost its shape.
_FEW_UNITS = 4


def is_float32(values: np.ndarray) -> bool:
    """Whether all values are representable in float32."""
    with np.errstate(over="ignore"):
        return bool((values.astype(np.float32) == values).all())


def warn_of_rounding(points: np.ndarray, faces: np.ndarray, source: str = "", stacklevel: int = 3) -> None:
    """Warns of faces whose size is that of float32's rounding.

    Args:
        points: (V, 3) finite, given in float32.
        faces: (F, 3).
        source: where they come from, in words: the start of the message. Default: an argument.
        stacklevel: see `warnings.warn`.
    """
    corners = points[faces]
    size = np.abs(corners - np.roll(corners, 1, axis=1)).max(axis=(1, 2))
    unit = np.spacing(np.abs(corners).max(axis=(1, 2)).astype(np.float32)).astype(np.float64)
    is_lost = size <= _FEW_UNITS * unit
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
