"""How ranks agree on the first toi of robots that several of them hold."""

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
    """How ranks agree on the first toi of the bodies they hold (`pgccd.sim.Exchange`).

    All ranks that hold a body exchange messages directly. Its owner has the list of them, the others derive it from
    the sweep; each two ranks list the bodies both hold by owner, then by id.

    Args:
        comm: between the ranks.
    """

    # Of the bodies that other ranks hold too: which ranks, rows, and how many for each rank, on their way.
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
        """Finds out which bodies other ranks hold too. Waits for nothing.

        Args:
            held: the bodies.
            ghosts: centres of those among them that others own.
            kept: min_separation and tolerance, as the operators take them.
            partition: that the halo was made with.
            capacities: how many bodies each rank may hold too, with padding; both ranks give one number. Default: as
                many as there are, for which the host waits.
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
            exchange._known = HostCopy.start(exchange._replicas.counts)  # on its way while bodies are tested
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
        """Rows of bodies that others hold too, by rank; and how many for each rank."""
        counts: list[int] = self._known.numpy().tolist()
        return self._rows_by_rank(counts), counts

    @functools.cached_property
    def _twice(self) -> Tensor:
        """(S, 2): these rows, each as both bodies of a pair."""
        return self._shared[0][:, None].expand(-1, 2).contiguous()

    @property
    def common(self) -> list[int]:
        """How many bodies this rank and each other one hold."""
        return self._shared[1]

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
