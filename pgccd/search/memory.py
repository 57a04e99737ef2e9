"""Memory limits and estimates of a step."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from pgccd.geometry.scene import Scene
from pgccd.runtime.sizes import MOST_ROWS, BufferSizes, Capacity, sizes_of
from pgccd.search.query import Query

_DEFAULT_BUDGET = 1 << 30
# Capacity relative to what the last step needed; and, for large scenes before their first step, relative to a guess.
_SLACK, _SPARSE = 1.25, 0.25
# Memory per pair of the PCS in traversal and narrow phase, in the standard scene, with a safety factor.
_BYTES_PER_PAIR = 1536


def memory_limit(budget: int | None, wanted: int, device: torch.device) -> int:
    """Target size of scratch memory in bytes. Free GPU memory is queried only above the default budget, because the
    query is slow.

    Args:
        budget: the user's limit, or None.
        wanted: the number of bytes that would be used.
        device: the device of the memory.
    """
    if budget is not None:
        return budget
    if device.type != "cuda" or wanted <= _DEFAULT_BUDGET:
        return _DEFAULT_BUDGET
    free, _ = torch.cuda.mem_get_info(device)
    return max(_DEFAULT_BUDGET, free // 4)


class CapacityEstimate:
    """An estimate of a step's capacity from what the last step of its kind needed. It changes how often a step is
    repeated, never its result.

    Example:
        >>> estimate = CapacityEstimate()
        >>> capacity = estimate.capacity(scene, pairs=None)
    """

    def __init__(self) -> None:
        self._size = 0  # number of bodies of the last step, or of pairs if they were given
        #: The capacity that the last step needed; None before the first.
        self.needed: BufferSizes | None = None

    def learn(self, size: int, needed: BufferSizes) -> None:
        """Records what a step of `size` bodies (or given pairs) needed."""
        if size > 0:
            self._size, self.needed = size, needed

    def capacity(self, scene: Scene, pairs: Tensor | None, slack: float = _SLACK) -> BufferSizes:
        """The expected capacity: what the last step needed, times `slack`, or before the first step the need of the
        standard scene, for a large scene only a part of it.

        Args:
            scene: the bodies.
            pairs: (P, 2), if they are given.
            slack: factor over what the last step needed.
        """
        size, given = (scene.body_count, None) if pairs is None else (len(pairs), len(pairs))
        guess = sizes_of(Capacity.of(scene.body_count, given, scene._self_colliding_vertices))
        if self.needed is None:
            # A first step of a large scene that is searched twice costs less than memory for the densest one.
            return guess if guess.bytes <= _DEFAULT_BUDGET else guess.times(_SPARSE)
        capacity = self.needed.times(slack * size / self._size)
        return replace(capacity, launches=max(capacity.launches, guess.launches))


def estimate_of(scene: Scene, query: Query, pairs: Tensor | None) -> CapacityEstimate:
    """The scene's estimate for this report. Searches of given pairs have one estimate per octave of their number, since
    repeating part of a step may need very different memory per pair than the whole step.
    """
    octave = None if pairs is None else len(pairs).bit_length()
    estimates, key = scene._capacity_estimates, (query.report, octave)
    if key not in estimates:
        estimates[key] = CapacityEstimate()
    return estimates[key]


def pairs_a_chunk(scene: Scene, estimate: CapacityEstimate | None, budget: int | None, pair_count: int = 0) -> int:
    """Number of body pairs per chunk, so that memory stays within the budget.

    Args:
        scene: the bodies.
        estimate: of a whole step of these bodies, if there is one.
        budget: `memory_budget` of the user.
        pair_count: number of all pairs; many pairs raise the default budget on a GPU.
    """
    bytes_per_pair = _BYTES_PER_PAIR
    needed = None if estimate is None else estimate.needed
    if needed is not None and needed.pairs:
        bytes_per_pair = max(bytes_per_pair, math.ceil(needed.bytes / needed.pairs))
    limit = memory_limit(budget, pair_count * bytes_per_pair, scene.device)
    return min(MOST_ROWS, max(1, limit // bytes_per_pair))
