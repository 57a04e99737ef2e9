"""Agreement between ranks on the first toi of robots that several of them hold."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from pgccd import ops
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.halo.centres import Centres
from pgccd.distributed.halo.held import Held
from pgccd.distributed.halo.replicas import ReplicaList, ReplicaTable, find_replicas, join_replicas
from pgccd.distributed.partition.interface import Partition
from pgccd.runtime.host_copy import HostCopy


class HeldExchange:
    """Exchange of the first toi of bodies held by several ranks (`pgccd.sim.Exchange`).

    All ranks that hold a body exchange messages directly. Its owner has the list of these ranks, the others derive it
    from the swept box; two ranks list the bodies that both hold in the same order, by owner, then by id.

    Args:
        comm: between the ranks.
    """

    # Bodies that other ranks hold too: their ranks, their rows, and their number per rank (being copied to the host).
    _replicas: ReplicaTable | ReplicaList
    _rows: Tensor
    _known: HostCopy

    def __init__(self, comm: Comm) -> None:
        self._comm = comm

    @classmethod
    def start(
        cls,
        held: Held,
        ghosts: Centres,
        kept: tuple[float, float],
        partition: Partition,
        capacities: list[int] | None = None,
    ) -> HeldExchange:
        """Finds the bodies that other ranks hold too. Does not synchronise.

        Args:
            held: the bodies.
            ghosts: swept spheres of the ghosts among them.
            kept: min_separation and tolerance, as the operators take them.
            partition: used for the halo.
            capacities: padded number of bodies shared with each rank, equal on both ranks. Default: the exact number,
                which synchronises.
        """
        comm = held.route.comm
        exchange = cls(comm)
        if comm.size == 1:
            exchange._shared = held.own_id[:0], [0]
            exchange._replicas = held.replicas
            return exchange
        received, ghost = held.route.received, torch.arange(held.ghost_count, device=held.own_id.device)
        subdomain, row = partition.subdomain(comm.rank), ghost + held.own_count
        if capacities is not None:
            ghost = torch.where(held.ghosts["id"] < 0, -1, ghost)
        of_ghosts = find_replicas(ghosts, kept, subdomain, ghost, comm.size, received)
        before = sum(received[: comm.rank])
        exchange._replicas = join_replicas(of_ghosts, before, held.replicas)
        exchange._rows = torch.cat([row[:before], held.boundary, row[before:]])
        if capacities is None:
            exchange._known = HostCopy.start(exchange._replicas.counts)  # copied while pairs are tested
        else:
            exchange._shared = exchange._rows_by_rank(capacities), capacities
        return exchange

    def overflow(self) -> Tensor:
        """(1,) int64: nonzero if a capacity was exceeded."""
        counts, capacities = self._replicas.counts, self._shared[1]
        return ops.counts_to_send(counts, capacities, torch.zeros_like(counts[:1]), 0)[0, 1:]

    def _rows_by_rank(self, capacities: list[int]) -> Tensor:
        return self._replicas.rows_by_rank(self._rows, capacities)

    @functools.cached_property
    def _shared(self) -> tuple[Tensor, list[int]]:
        """Rows of bodies that other ranks hold too, by rank; and their number per rank."""
        counts: list[int] = self._known.numpy().tolist()
        return self._rows_by_rank(counts), counts

    @functools.cached_property
    def _twice(self) -> Tensor:
        """(S, 2): these rows, each repeated as a pair."""
        return self._shared[0][:, None].expand(-1, 2).contiguous()

    @property
    def common(self) -> list[int]:
        """Number of bodies that this rank shares with each other rank."""
        return self._shared[1]

    @property
    def rank(self) -> int:
        return self._comm.rank

    @property
    def ranks(self) -> int:
        return self._comm.size

    def share(self, first: Tensor) -> None:
        """Sets the first toi (N + G,) float64 of all held bodies to the minimum over the ranks."""
        if self._comm.size == 1:
            return
        rows, counts = self._shared
        answer = self._comm.exchange(ops.pack_rows([first], rows), counts, counts).wait()
        ops.simulate_first_toi(first, None, self._twice, answer.view(first.dtype)[:, 0])

    def gather(self, values: Tensor) -> Tensor:
        """values (k,) -> (ranks, k): those of every rank."""
        return self._comm.all_gather(values)
