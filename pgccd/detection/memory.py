"""How much memory a step may take, and how much it is expected to."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

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


def is_out_of_memory(error: Exception) -> bool:
    """Whether a device had too little memory, by the error of torch or of our operators."""
    return isinstance(error, torch.OutOfMemoryError) or "out of memory: no room for" in str(error)


@dataclass(frozen=True)
class _Experience:
    size: int  #: of the step: bodies, or pairs where they were given
    needed: Capacity


def recall_capacity(
    scene: Scene, query: Query, pairs: Tensor | None, part: str | None = None, slack: float = _SLACK
) -> Capacity:
    """Capacity for a step like the last one of these meshes, or of the standard scene if there was none.

    The meshes remember, since scenes come and go with the bodies of a rank. What they remember changes how often a step
    is repeated, never its result.

    Args:
        scene, query: what is asked of which bodies.
        pairs: if they are given.
        part: of every step, which this is.
        slack: times what the last step needed.
    """
    size = scene.body_count if pairs is None else len(pairs)
    last = scene.meshes.experience.get(_kind(query, pairs, part))
    given = None if pairs is None else len(pairs)
    guess = Capacity.guess(scene.body_count, given, scene.self_colliding_vertices)
    if not isinstance(last, _Experience):
        return guess
    capacity = last.needed.times(slack * size / last.size)
    return replace(capacity, launches=max(capacity.launches, guess.launches))


def remember_needs(scene: Scene, query: Query, pairs: Tensor | None, needed: Capacity, part: str | None = None) -> None:
    """For `recall_capacity`."""
    size = scene.body_count if pairs is None else len(pairs)
    if size > 0:
        scene.meshes.experience[_kind(query, pairs, part)] = _Experience(size, needed)


def pairs_a_chunk(scene: Scene, query: Query, budget: int | None, pair_count: int) -> int:
    """How many body pairs to traverse at a time, so that memory stays within the budget."""
    bytes_per_pair = _BYTES_PER_PAIR
    last = scene.meshes.experience.get(query.report)
    if isinstance(last, _Experience) and last.needed.pairs:
        bytes_per_pair = max(bytes_per_pair, math.ceil(last.needed.bytes / last.needed.pairs))
    limit = memory_limit(budget, pair_count * bytes_per_pair, scene.device)
    return max(1, limit // bytes_per_pair)


def _kind(query: Query, pairs: Tensor | None, part: str | None) -> str:
    if part is not None:
        return f"{query.report}: {part}"
    if pairs is None:
        return query.report
    # A whole step and a repetition of a part of it may need very different memory a pair: octaves of sizes
    # distinguish them.
    return f"{query.report} of 2^{len(pairs).bit_length()} given pairs"
