"""How much memory a step may take, and how much it is expected to."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from pgccd.detection.capacity import Capacity
from pgccd.detection.query import Query
from pgccd.geometry.scene import Scene

_DEFAULT_BUDGET = 1 << 30
# Times what the last step needed.
_SLACK = 1.25
# Memory of one pair of the PCS in traversal and narrow phase, on the standard scene with a margin.
_BYTES_PER_PAIR = 1536


def memory_limit(budget: int | None, wanted: int, device: torch.device) -> int:
    """Bytes of scratch memory to aim at. What a GPU has free is only asked where it matters: asking takes time.

    Args:
        budget: the user's.
        wanted: what would be used.
        device: where.
    """
    if budget is not None:
        return budget
    if device.type != "cuda" or wanted <= _DEFAULT_BUDGET:
        return _DEFAULT_BUDGET
    free, _ = torch.cuda.mem_get_info(device)
    return max(_DEFAULT_BUDGET, free // 4)


class CapacityEstimate:
    """The capacity of a step, estimated from what the last one of its kind needed. It changes how often a step is
    repeated, never its result.

    Example:
        >>> estimate = CapacityEstimate()
        >>> capacity = estimate.capacity(scene, pairs=None)
    """

    def __init__(self) -> None:
        self._size = 0  # of the last step: bodies, or pairs where they were given
        #: What the last step needed; None before the first.
        self.needed: Capacity | None = None

    def learn(self, size: int, needed: Capacity) -> None:
        """Takes note of a step of so many bodies, or of so many pairs where these were given."""
        if size > 0:
            self._size, self.needed = size, needed

    def capacity(self, scene: Scene, pairs: Tensor | None, slack: float = _SLACK) -> Capacity:
        """For a step like the last one, or like one of the standard scene if there was none.

        Args:
            scene: the bodies.
            pairs: (P, 2), if they are given.
            slack: times what the last step needed.
        """
        size, given = (scene.body_count, None) if pairs is None else (len(pairs), len(pairs))
        guess = Capacity.guess(scene.body_count, given, scene.self_colliding_vertices)
        if self.needed is None:
            return guess
        capacity = self.needed.times(slack * size / self._size)
        return replace(capacity, launches=max(capacity.launches, guess.launches))


def estimate_of(scene: Scene, query: Query, pairs: Tensor | None) -> CapacityEstimate:
    """That of the scene's steps with this report. A whole step and a repetition of a part of it may need very different
    memory a pair: where pairs are given, octaves of their number have estimates of their own."""
    octave = None if pairs is None else len(pairs).bit_length()
    estimates, key = scene.capacity_estimates, (query.report, octave)
    if key not in estimates:
        estimates[key] = CapacityEstimate()
    return estimates[key]


def pairs_a_chunk(scene: Scene, estimate: CapacityEstimate, budget: int | None, pair_count: int = 0) -> int:
    """How many body pairs to traverse at a time, so that memory stays within the budget.

    Args:
        scene: the bodies.
        estimate: of whole steps of theirs.
        budget: the user's.
        pair_count: how many there are, for which a GPU may have more memory than usual.
    """
    bytes_per_pair = _BYTES_PER_PAIR
    needed = estimate.needed
    if needed is not None and needed.pairs:
        bytes_per_pair = max(bytes_per_pair, math.ceil(needed.bytes / needed.pairs))
    limit = memory_limit(budget, pair_count * bytes_per_pair, scene.device)
    return max(1, limit // bytes_per_pair)
