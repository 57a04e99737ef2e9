"""Broad phase: from swept spheres to the potentially colliding set (PCS)."""

import math
from typing import Literal, get_args

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.runtime.sizes import COUNT_ROWS, BufferSizes
from pgccd.search.bodies import MovingBodies
from pgccd.search.checks import check_separation, operator_tolerance

__all__ = ["BroadPhase", "choose", "find_pairs", "grid", "lbvh", "sweep"]

BroadPhase = Literal["auto", "sweep", "grid", "lbvh"]
BROAD_PHASES: tuple[str, ...] = get_args(BroadPhase)
#: The operators' numbers (enum BroadPhase of csrc/kernels/broad/broad.h).
BROAD_PHASE_NUMBERS: dict[str, int] = {name: number for number, name in enumerate(BROAD_PHASES[1:])}

# Limits used by "auto", as measured (bench/bench_broad_phase.py): a sweep is fastest for few bodies. On a CPU every
# octave of sizes is a level of the grid, and each body searches all levels one by one; a sweep's work grows with the
# power 5/3 of the number of bodies; on a GPU the grid is fastest for any sizes.
_FEW_BODIES = 2_000
_GRID_OCTAVES = 3
_MANY_BODIES = 150_000

_AXES = {"auto": -1, "x": 0, "y": 1, "z": 2}


def sweep(
    bodies: MovingBodies,
    min_separation: float = 0.0,
    axis: Literal["auto", "x", "y", "z"] = "auto",
    tolerance: float | None = None,
) -> Tensor:
    """Sweep and prune along one axis by radix sort, then a test of moving spheres (Du, Liu & Suzumura 2017, 3.3).

    Args:
        bodies: the scene in motion.
        min_separation: length; bodies at most this far apart count as colliding.
        axis: the sweep axis; "auto" selects the one with the largest variance of centres. The result does not depend on
            it.
        tolerance: length; contacts up to min_separation + tolerance may be reported. Default: 1e-6 of the smaller SBV
            radius of each pair, as for `detect`.

    Returns:
        (P, 2) int64: every pair i < j that the scene's filters allow and whose swept spheres come within min_separation
        + tolerance (rounded outward by some 1e-13 of their size), and (i, i) for every body tested against itself;
        sorted. For bodies that fill little of their SBV, such as rods, boxes that move with the bodies must come within
        the same distance too (rounded outward by some 1e-5 of their size).

    Raises:
        TypeError, ValueError: naming the argument.

    Example:
        >>> pairs = pgccd.broad.sweep(bodies)
    """
    arguments.choice(axis, "axis", _AXES)
    return _find(bodies, "sweep", min_separation, tolerance, _AXES[axis])


def grid(bodies: MovingBodies, min_separation: float = 0.0, tolerance: float | None = None) -> Tensor:
    """A hashed uniform grid with a level for each octave of body sizes (Ericson 2005, Real-Time Collision Detection,
    7.2), then the same test as `sweep`.

    Fastest for bodies of few different sizes. Memory is proportional to the number of bodies, whatever their positions.

    Args:
        bodies: the scene in motion.
        min_separation, tolerance: lengths, as for `sweep`.

    Returns:
        (P, 2) int64, as for `sweep`.

    Raises:
        TypeError, ValueError: naming the argument.

    Example:
        >>> pairs = pgccd.broad.grid(bodies)
    """
    return _find(bodies, "grid", min_separation, tolerance)


def lbvh(bodies: MovingBodies, min_separation: float = 0.0, tolerance: float | None = None) -> Tensor:
    """A bounding volume hierarchy over the bodies in Morton order (Karras 2012, Maximizing parallelism in the
    construction of BVHs, octrees, and k-d trees), then the same test as `sweep`.

    Suited to bodies of very different sizes.

    Args:
        bodies: the scene in motion.
        min_separation, tolerance: lengths, as for `sweep`.

    Returns:
        (P, 2) int64, as for `sweep`.

    Raises:
        TypeError, ValueError: naming the argument.

    Example:
        >>> pairs = pgccd.broad.lbvh(bodies)
    """
    return _find(bodies, "lbvh", min_separation, tolerance)


def choose(bodies: MovingBodies, broad_phase: BroadPhase = "auto") -> BroadPhase:
    """The broad phase to run: the given one, or for "auto" the one expected to be fastest.

    Depends only on host data: the number of bodies and the sizes of the meshes.

    Args:
        bodies: the scene in motion.
        broad_phase: "auto", or a name, which is returned.

    Raises:
        ValueError: unknown broad phase.

    Example:
        >>> pgccd.broad.choose(bodies)  # two bodies
        'sweep'
    """
    arguments.choice(broad_phase, "broad_phase", BROAD_PHASES)
    arguments.instance(bodies, "bodies", MovingBodies)
    return chosen_for(bodies, broad_phase)


def chosen_for(bodies: MovingBodies, broad_phase: BroadPhase) -> BroadPhase:
    """`choose`, of arguments that have been checked."""
    if broad_phase != "auto":
        return broad_phase
    if bodies.scene.body_count < _FEW_BODIES:
        return "sweep"
    if bodies.device.type != "cpu":
        return "grid"
    octaves = {math.frexp(mesh.radius + mesh.thickness)[1] for mesh in bodies.scene.meshes.meshes}
    if len(octaves) <= _GRID_OCTAVES:
        return "grid"
    return "lbvh" if bodies.scene.body_count >= _MANY_BODIES else "sweep"


def find_pairs_padded(
    bodies: MovingBodies,
    min_separation: float,
    broad_phase: BroadPhase,
    capacity: BufferSizes,
    invalid: Tensor,
    tolerance: float | None = None,
    in_other_search: Tensor | None = None,
    at_any_times: bool = False,
) -> tuple[Tensor, Tensor]:
    """The PCS in a given capacity, without synchronising.

    Args:
        bodies, min_separation, broad_phase, tolerance: as for `find_pairs`.
        capacity: of the pairs and of the broad phase's buffers.
        invalid: (1,) int64; if nonzero, no pairs are returned.
        in_other_search: (N,) uint8, nonzero for bodies whose pairs with each other another search finds: left out here.
        at_any_times: whether to return all pairs that may come so near with each body at a time of its own, that
            is, pairs that may collide if bodies are stopped or slowed down anywhere on their way. The PCS is among
            them. The bodies are `MovingBodies.stoppable`.

    Returns:
        (capacity.pairs, 2) int64, the pairs first, then rows of -1; and counts (7,) int64: the first seven of
        `pgccd.runtime.sizes.Counts`. After overflow, pairs may be missing.
    """
    number = BROAD_PHASE_NUMBERS[choose(bodies, broad_phase)]
    own = 0 if bodies.scene.self_collision is None else len(bodies._self_colliding)
    pair_capacity, *rest = capacity.of_pairs
    pairs, counts = ops.pairs_padded(
        bodies._swept(in_other_search),
        invalid,
        *_lengths(min_separation, tolerance),
        number,
        [max(0, pair_capacity - own), *rest],
        at_any_times,
    )
    if own:
        # In place: `counts[row] += added` would copy the sum once more.
        added = own * (invalid[0] == 0)
        for name in ("pairs", "pairs_written"):
            counts[COUNT_ROWS[name]].add_(added)
    if own > pair_capacity:
        counts[COUNT_ROWS["pairs_overflow"]] += 1
    pairs = with_self_pairs(bodies, pairs)
    if bodies.scene.exclude is not None:
        row = COUNT_ROWS["pairs_written"]
        pairs, counts[row : row + 1] = select_rows(pairs, _is_tested(bodies, pairs))
    return pairs, counts


def find_pairs(
    bodies: MovingBodies,
    min_separation: float = 0.0,
    broad_phase: BroadPhase = "auto",
    tolerance: float | None = None,
) -> Tensor:
    """The PCS by the given broad phase, or by the one that `choose` selects. All broad phases return the same pairs.

    Args:
        bodies: the scene in motion.
        min_separation, tolerance: lengths, as for `sweep`.
        broad_phase: "sweep", "grid", "lbvh", or "auto": see `choose`.

    Returns:
        (P, 2) int64, as for `sweep`.

    Raises:
        TypeError, ValueError: naming the argument.

    Example:
        >>> pairs = pgccd.broad.find_pairs(bodies, min_separation=0.01)
    """
    return _find(bodies, choose(bodies, broad_phase), min_separation, tolerance)


def find_pairs_of_checked(
    bodies: MovingBodies,
    min_separation: float,
    chosen: str,
    tolerance: float | None = None,
    axis: int = -1,
    in_other_search: Tensor | None = None,
    at_any_times: bool = False,
) -> Tensor:
    """As `find_pairs`, without checks; `chosen` comes from `choose`. in_other_search, at_any_times: see
    `find_pairs_padded`.
    """
    lengths, number = _lengths(min_separation, tolerance), BROAD_PHASE_NUMBERS[chosen]
    pairs = ops.broad_pairs(bodies._swept(in_other_search), *lengths, number, axis, at_any_times)
    pairs = with_self_pairs(bodies, pairs)
    return pairs if bodies.scene.exclude is None else pairs[_is_tested(bodies, pairs)]


def meeting_pairs(
    bodies: MovingBodies, pairs: Tensor, min_separation: float, tolerance: float | None = None
) -> tuple[Tensor, Tensor]:
    """The PCS among pairs found `at_any_times`, without synchronising.

    Args:
        bodies, min_separation, tolerance: as for `find_pairs`.
        pairs: (P, 2) int64; may contain rows of -1.

    Returns:
        (P, 2) int64, the PCS in the same order, then rows of -1; and its number (1,) int64.
    """
    return ops.meeting_pairs(pairs, bodies._swept(), *_lengths(min_separation, tolerance))


def with_self_pairs(bodies: MovingBodies, pairs: Tensor) -> Tensor:
    """Merges (i, i) for every body tested against itself into sorted pairs (P, 2), which may end with rows of -1. The
    number of such bodies is known on the host, so this does not synchronise.
    """
    if bodies.scene.self_collision is None:
        return pairs
    own = bodies._self_colliding
    if not len(own):
        return pairs
    if bodies.scene.body_count == 1:  # the body has no other partner
        return pairs.new_zeros((1, 2))
    first = torch.where(pairs[:, 0] < 0, bodies.scene.body_count, pairs[:, 0])
    # A row moves down by the number of self pairs up to its own body; a self pair precedes the other rows of its body.
    row_of_pair = torch.arange(len(pairs), device=pairs.device) + torch.searchsorted(own, first, right=True)
    row_of_own = torch.arange(len(own), device=pairs.device) + torch.searchsorted(first, own)
    merged = pairs.new_empty((len(pairs) + len(own), 2))
    merged[row_of_pair] = pairs
    merged[row_of_own] = own[:, None].expand(-1, 2)
    return merged


def select_rows(pairs: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """The rows of `pairs` (P, 2) marked by (P,) bool in the same order, then rows of -1; and their number (1,) int64.
    Does not synchronise.
    """
    to = torch.where(wanted, wanted.cumsum(0) - 1, len(pairs))
    chosen = pairs.new_full((len(pairs) + 1, 2), -1)
    chosen[to] = pairs
    return chosen[:-1], wanted.sum().reshape(1)


def _is_tested(bodies: MovingBodies, pairs: Tensor) -> Tensor:
    """(P,) bool: the pairs (P, 2) that `Scene.exclude` does not name; rows of -1 count as none."""
    exclude, count = bodies.scene.exclude, bodies.scene._exclude_period or bodies.scene.body_count
    if exclude is None or not len(exclude):
        return pairs[:, 0] >= 0
    keys = exclude[:, 0] * count + exclude[:, 1]  # ascending, as the pairs are sorted
    i, j = pairs.remainder(count).unbind(1)
    own = i * count + j
    place = torch.searchsorted(keys, own).clamp(max=len(keys) - 1)
    return (keys[place] != own) & (pairs[:, 0] >= 0)


def _find(bodies: MovingBodies, chosen: str, min_separation: float, tolerance: float | None, axis: int = -1) -> Tensor:
    arguments.instance(bodies, "bodies", MovingBodies)
    bodies.check()
    return find_pairs_of_checked(bodies, min_separation, chosen, tolerance, axis)


def _lengths(min_separation: float, tolerance: float | None) -> tuple[float, float]:
    return check_separation(min_separation), operator_tolerance(tolerance)


def __dir__() -> list[str]:
    return sorted(__all__)
