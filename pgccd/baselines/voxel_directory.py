"""Assignment of the voxels of a sparse, distributed grid to ranks."""

import heapq

import numpy as np
import torch
from torch import Tensor

from pgccd.distributed.comm.exchange import make_route
from pgccd.distributed.comm.interface import Comm

# 21 bits per axis, as in csrc/kernels/voxel/voxel_table.h.
_BITS = 21
_LIMIT = 1 << 20


def voxel_keys(voxels: Tensor) -> Tensor:
    """(V,) int64 keys of voxels (V, 3) int32, in the same order."""
    x, y, z = (voxels.long() + _LIMIT).unbind(dim=1)
    return (x << (2 * _BITS)) | (y << _BITS) | z


class VoxelDirectory:
    """Maps voxels to ranks: the first rank that sends to a voxel owns it, until it is moved.

    A voxel's home rank (a hash of its coordinates) stores its owner; other ranks query it once and cache the answer. If
    several ranks first send to a voxel in the same step, the lowest owns it.
    """

    def __init__(self, comm: Comm) -> None:
        self._comm = comm
        # Entries of voxels whose home is this rank, keys ascending; then the cache of known owners.
        self._keys = torch.empty(0, dtype=torch.int64)
        self._ranks = torch.empty(0, dtype=torch.int64)
        self._known_keys, self._known_ranks = self._keys, self._ranks

    def locate(self, keys: Tensor) -> Tensor:
        """(V,) int64: the ranks of voxels (V,), unique keys. All ranks must call this."""
        if self._comm.size == 1:
            return torch.zeros_like(keys)
        row, is_known = _find(self._known_keys, keys)
        unknown = keys[~is_known]
        route = make_route(self._comm, torch.arange(len(unknown)), self._home_of(unknown))
        asked = route.forward({"key": unknown}).wait()["key"]
        answers = route.back({"rank": self._answer(asked, route.source)}).wait()["rank"]
        self._known_keys, self._known_ranks = _merge(self._known_keys, self._known_ranks, unknown[route.rows], answers)
        row, _ = _find(self._known_keys, keys)
        return self._known_ranks[row]

    def move(self, keys: Tensor, ranks: Tensor) -> None:
        """Moves voxels (V,) to ranks (V,). All ranks must call this, with the same arguments."""
        mine = self._home_of(keys) == self._comm.rank
        row, is_here = _find(self._keys, keys[mine])
        self._ranks[row[is_here]] = ranks[mine][is_here]
        self._known_keys, self._known_ranks = self._known_keys[:0], self._known_ranks[:0]

    def _home_of(self, keys: Tensor) -> Tensor:
        mixed = keys * 0x5851F42D4C957F2D  # multiplier of Knuth's MMIX generator
        return ((mixed >> 33) & 0x7FFFFFFF) % self._comm.size

    def _answer(self, keys: Tensor, source: Tensor) -> Tensor:
        """The ranks of the voxels (V,) queried by the ranks `source` (V,), ascending."""
        _, is_here = _find(self._keys, keys)
        asked, asking = keys[~is_here], source[~is_here]
        first = first_rows(asked)
        self._keys, self._ranks = _merge(self._keys, self._ranks, asked[first], asking[first])
        row, _ = _find(self._keys, keys)
        return self._ranks[row]


def first_rows(values: Tensor) -> Tensor:
    """The first row of each distinct value of values (K,) or (K, n), by ascending value."""
    _, rows = np.unique(values.numpy(), return_index=True, axis=None if values.dim() == 1 else 0)
    return torch.from_numpy(rows)


def _find(sorted_keys: Tensor, keys: Tensor) -> tuple[Tensor, Tensor]:
    """Index of each key among sorted ones, and whether it is there."""
    if not len(sorted_keys):
        return torch.zeros_like(keys), torch.zeros_like(keys, dtype=torch.bool)
    row = torch.searchsorted(sorted_keys, keys).clamp_(max=len(sorted_keys) - 1)
    return row, sorted_keys[row] == keys


def _merge(keys: Tensor, values: Tensor, more_keys: Tensor, more_values: Tensor) -> tuple[Tensor, Tensor]:
    """Both tables, by ascending key."""
    if not len(more_keys):
        return keys, values
    all_keys, order = torch.sort(torch.cat([keys, more_keys]))
    return all_keys, torch.cat([values, more_values])[order]


def greedy_ranks(loads: Tensor, ranks: int) -> Tensor:
    """(V,) int64: a rank for each of the loads (V,) int64 such that their sums are about equal: the largest load first,
    each to the least loaded rank; the same on all ranks.
    """
    totals = [(0, rank) for rank in range(ranks)]
    chosen = torch.empty_like(loads)
    for row in torch.argsort(loads, descending=True, stable=True).tolist():
        total, rank = heapq.heappop(totals)
        chosen[row] = rank
        heapq.heappush(totals, (total + int(loads[row]), rank))
    return chosen
