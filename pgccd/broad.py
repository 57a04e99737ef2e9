"""Broad phase: from swept spheres to the potentially colliding set (PCS)."""

from __future__ import annotations

from typing import Literal

from torch import Tensor

from pgccd import ops
from pgccd.bodies import MovingBodies

BroadPhase = Literal["sweep"]

_AXES = {"auto": -1, "x": 0, "y": 1, "z": 2}


def sweep(bodies: MovingBodies, min_separation: float = 0.0, axis: Literal["auto", "x", "y", "z"] = "auto") -> Tensor:
    """Sweep and prune along one axis by radix sort, then a test of moving spheres (Du, Liu & Suzumura 2017, 3.3).

    Args:
        bodies: the scene in motion.
        min_separation: length; bodies this close count as colliding.
        axis: the axis swept; "auto" takes that with the largest variance of centres. The result does not depend on it.

    Returns:
        (P, 2) int64: every pair i < j that the scene's filters allow and whose swept spheres come within the separation
        (and, by rounding outward, perhaps a few that miss it by about 1e-14 of their distance), sorted.

    Example:
        >>> pairs = pgccd.broad.sweep(bodies)
    """
    if axis not in _AXES:
        raise ValueError(f"axis: expected one of {list(_AXES)}, got {axis!r}")
    scene = bodies.scene
    return ops.sweep(
        bodies.position_t0,
        bodies.position_t1,
        bodies.radius,
        scene.group,
        scene.mask,
        scene.world,
        scene.static,
        check_separation(min_separation),
        _AXES[axis],
    )


def find_pairs(bodies: MovingBodies, min_separation: float = 0.0, broad_phase: BroadPhase = "sweep") -> Tensor:
    """The PCS by the broad phase named. All of them give the same pairs."""
    if broad_phase != "sweep":
        raise ValueError(f'broad_phase: expected "sweep", got {broad_phase!r}')
    return sweep(bodies, min_separation)


def check_separation(min_separation: float) -> float:
    """The value, if it is a finite length >= 0."""
    if not 0.0 <= min_separation < float("inf"):
        raise ValueError(f"min_separation: expected a finite length >= 0, got {min_separation}")
    return float(min_separation)
