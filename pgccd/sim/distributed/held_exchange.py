"""How ranks agree on the first toi of robots that several of them hold."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from pgccd import ops
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.halo import Centres, Held
from pgccd.distributed.partition import Partition
from pgccd.runtime.host_copy import HostCopy


class HeldExchange:
    """How ranks agree on the first toi of the bodies they hold (`pgccd.sim.Exchange`).

    All ranks that hold a body exchange messages directly. Its owner has the list of them, the others derive it from
    the sweep; each two ranks list the bodies both hold by owner, then by id.

    Args:
        comm: between the ranks.
    """

    # Of the bodies that other ranks hold too: which ranks, rows, how many for each rank, and these on their way.
    _replica_ranks: Tensor
    _rows: Tensor
    _counts: Tensor
    _known: HostCopy

    def __init__(self, comm: Comm) -> None:
        self._comm = comm

    @classmethod
    def start(cls, held: Held, ghosts: Centres, kept: tuple[float, float], partition: Partition) -> HeldExchange:
        """Finds out which bodies other ranks hold too. Waits for nothing.

        Args:
            held: the bodies.
            ghosts: centres of those among them that others own.
            kept: min_separation and tolerance, as the operators take them.
            partition: that the halo was made with.
        """
        comm = held.route.comm
        exchange = cls(comm)
        if comm.size == 1:
            exchange._shared = held.own_id[:0], [0]
            return exchange
        received, ghost = held.route.received, torch.arange(held.ghost_count, device=held.own_id.device)
        subdomain, row = partition.subdomain(comm.rank), ghost + held.own_count
        replica_ranks, counts = ops.replica_ranks(ghosts, *kept, subdomain, ghost, comm.size, received)
        before = sum(received[: comm.rank])
        exchange._replica_ranks = torch.cat([replica_ranks[:before], held.replica_ranks, replica_ranks[before:]])
        exchange._rows = torch.cat([row[:before], held.boundary, row[before:]])
        exchange._counts = counts + held.boundary_counts
        # On its way while bodies are tested.
        exchange._known = HostCopy.start(exchange._counts)
        return exchange

    @functools.cached_property
    def _shared(self) -> tuple[Tensor, list[int]]:
        """Rows of bodies that others hold too, by rank; and how many for each rank."""
        counts: list[int] = self._known.numpy().tolist()
        return ops.rows_by_rank(self._replica_ranks, self._rows, self._counts, counts), counts

    @functools.cached_property
    def _twice(self) -> Tensor:
        """(S, 2): these rows, each as both bodies of a pair."""
        return self._shared[0][:, None].expand(-1, 2).contiguous()

    @property
    def rank(self) -> int:
        return self._comm.rank

    @property
    def ranks(self) -> int:
        return self._comm.size

    def share(self, first: Tensor) -> None:
        """Sets that of all bodies (N + G,) float64 to the smallest."""
        if self._comm.size == 1:
            return
        rows, counts = self._shared
        answer = self._comm.exchange(ops.pack_rows([first], rows), counts, counts).wait()
        ops.simulate_first_toi(first, None, self._twice, answer.view(first.dtype)[:, 0])

    def gather(self, values: Tensor) -> Tensor:
        """values (k,) -> (ranks, k): those of every rank."""
        return self._comm.all_gather(values)
