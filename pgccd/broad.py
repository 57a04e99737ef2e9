"""Broad phase: from swept spheres to the potentially colliding set (PCS)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, get_args

import torch
from torch import Tensor

from pgccd import ops
from pgccd.bodies import MovingBodies
from pgccd.capacity import COUNT_ROWS, Capacity

BroadPhase = Literal["auto", "sweep", "grid", "lbvh"]
BROAD_PHASES: tuple[str, ...] = get_args(BroadPhase)

# Where "auto" goes from one to another, as measured (bench/bench_broad_phase.py): fewer bodies are swept faster than
# sorted into cells. On a CPU every octave of sizes is a level of the grid that bodies look into one after the other,
# and a sweep's work grows with the power 5/3 of the bodies; a GPU does best with the grid whatever the sizes.
_FEW_BODIES = 2_000
_GRID_OCTAVES = 3
_MANY_BODIES = 150_000
_AXES = {"auto": -1, "x": 0, "y": 1, "z": 2}


def sweep(bodies: MovingBodies, min_separation: float = 0.0, axis: Literal["auto", "x", "y", "z"] = "auto") -> Tensor:
    """Sweep and prune along one axis by radix sort, then a test of moving spheres (Du, Liu & Suzumura 2017, 3.3).

    Args:
        bodies: the scene in motion.
        min_separation: length; bodies this close count as colliding.
        axis: the axis swept; "auto" takes that with the largest variance of centres. The result does not depend on it.

    Returns:
        (P, 2) int64: every pair i < j that the scene's filters allow and whose swept spheres come within the separation
        (and, by rounding outward, perhaps a few that miss it by about 1e-14 of their distance), and (i, i) for every
        body that collides with itself; sorted.

    Example:
        >>> pairs = pgccd.broad.sweep(bodies)
    """
    if axis not in _AXES:
        raise ValueError(f"axis: expected one of {list(_AXES)}, got {axis!r}")
    pairs = ops.sweep(*_columns(bodies), check_separation(min_separation), _AXES[axis])
    return with_self_pairs(bodies, pairs)


def grid(bodies: MovingBodies, min_separation: float = 0.0) -> Tensor:
    """A hashed uniform grid with a level for each octave of body sizes (Ericson 2005, Real-Time Collision Detection,
    7.2), then the same test as `sweep`.

    Fastest where bodies are of a few sizes. Memory is proportional to their number, wherever they are.

    Args:
        bodies: the scene in motion.
        min_separation: length; bodies this close count as colliding.

    Returns:
        (P, 2) int64: the pairs of `sweep`, bit for bit.

    Example:
        >>> pairs = pgccd.broad.grid(bodies)
    """
    return with_self_pairs(bodies, ops.grid(*_columns(bodies), check_separation(min_separation)))


def lbvh(bodies: MovingBodies, min_separation: float = 0.0) -> Tensor:
    """A bounding volume hierarchy over the bodies in Morton order (Karras 2012, Maximizing parallelism in the
    construction of BVHs, octrees, and k-d trees), then the same test as `sweep`.

    For bodies of very many sizes.

    Args:
        bodies: the scene in motion.
        min_separation: length; bodies this close count as colliding.

    Returns:
        (P, 2) int64: the pairs of `sweep`, bit for bit.

    Example:
        >>> pairs = pgccd.broad.lbvh(bodies)
    """
    return with_self_pairs(bodies, ops.lbvh(*_columns(bodies), check_separation(min_separation)))


def choose(bodies: MovingBodies, broad_phase: BroadPhase = "auto") -> BroadPhase:
    """The broad phase meant: what "auto" stands for in this scene, else the one named.

    Looks at what the host knows without waiting for a device: the number of bodies and the sizes of the meshes.

    Raises:
        ValueError: there is no such broad phase.

    Example:
        >>> pgccd.broad.choose(bodies)
        'grid'
    """
    if broad_phase not in BROAD_PHASES:
        raise ValueError(f"broad_phase: expected one of {list(BROAD_PHASES)}, got {broad_phase!r}")
    if broad_phase != "auto":
        return broad_phase
    if bodies.scene.body_count < _FEW_BODIES:
        return "sweep"
    if bodies.device.type != "cpu":
        return "grid"
    octaves = {math.frexp(mesh.radius)[1] for mesh in bodies.scene.meshes.meshes}
    if len(octaves) <= _GRID_OCTAVES:
        return "grid"
    return "lbvh" if bodies.scene.body_count >= _MANY_BODIES else "sweep"


def find_pairs_within(
    bodies: MovingBodies, min_separation: float, broad_phase: BroadPhase, capacity: Capacity, invalid: Tensor
) -> tuple[Tensor, Tensor]:
    """The PCS without waiting for its size.

    Args:
        bodies, min_separation, broad_phase: as for `find_pairs`.
        capacity: room.
        invalid: (1,) int64; unless it is 0, there are none.

    Returns:
        (capacity.pairs, 2) int64, the pairs first, then rows of -1; and counts (7,) int64: the first seven of
        `pgccd.capacity.Counts`. If there was no room for all pairs, any may be missing.
    """
    number = list(_FINDERS).index(choose(bodies, broad_phase))
    own = 0 if bodies.scene.self_collision is None else len(bodies.self_colliding)
    room, *rest = capacity.of_pairs
    pairs, counts = ops.pairs_within(
        *_columns(bodies),
        invalid,
        check_separation(min_separation),
        number,
        [max(0, room - own), *rest],
    )
    if own:
        added = own * (invalid[0] == 0)
        for name in ("pairs", "pairs_written"):
            counts[COUNT_ROWS[name]] += added
    if own > room:
        counts[COUNT_ROWS["pairs_overflow"]] += 1
    return with_self_pairs(bodies, pairs), counts


def find_pairs(bodies: MovingBodies, min_separation: float = 0.0, broad_phase: BroadPhase = "auto") -> Tensor:
    """The PCS by the broad phase named, or by the one that `choose` thinks fastest. All of them give the same pairs.

    Example:
        >>> pairs = pgccd.broad.find_pairs(bodies, min_separation=0.01)
    """
    return _FINDERS[choose(bodies, broad_phase)](bodies, min_separation)


_FINDERS: dict[str, Callable[[MovingBodies, float], Tensor]] = {"sweep": sweep, "grid": grid, "lbvh": lbvh}


def with_self_pairs(bodies: MovingBodies, pairs: Tensor) -> Tensor:
    """Sorted pairs (P, 2), perhaps with rows of -1 after them, and among them (i, i) for every body that collides with
    itself. How many they are is known, so that nothing waits for a device.
    """
    if bodies.scene.self_collision is None:
        return pairs
    own = bodies.self_colliding
    if not len(own):
        return pairs
    if bodies.scene.body_count == 1:  # which has no other partner
        return pairs.new_zeros((1, 2))
    first = torch.where(pairs[:, 0] < 0, bodies.scene.body_count, pairs[:, 0])
    # A row moves on by the bodies up to its own, and a new row comes before those of its body.
    row_of_pair = torch.arange(len(pairs), device=pairs.device) + torch.searchsorted(own, first, right=True)
    row_of_own = torch.arange(len(own), device=pairs.device) + torch.searchsorted(first, own)
    merged = pairs.new_empty((len(pairs) + len(own), 2))
    merged[row_of_pair] = pairs
    merged[row_of_own] = own[:, None].expand(-1, 2)
    return merged


def _columns(
    bodies: MovingBodies,
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor | None, Tensor | None, Tensor | None]:
    scene = bodies.scene
    filters = scene.group, scene.mask, scene.world, scene.static
    return bodies.centre_t0, bodies.centre_t1, bodies.reach, *filters


def check_separation(min_separation: float) -> float:
    """The value, if it is a finite length >= 0."""
    if not 0.0 <= min_separation < float("inf"):
        raise ValueError(f"min_separation: expected a finite length >= 0, got {min_separation}")
    return float(min_separation)
