"""Agreement between ranks on the first toi of bodies that several of them hold."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from pgccd import ops
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.comm.neighbourhood import Neighbourhood
from pgccd.distributed.comm.peer_memory import PeerMessages, RowsOfRanks
from pgccd.distributed.detection.share import Share
from pgccd.distributed.halo.replicas import Replicas, agreed_replicas, find_replicas
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.runtime.host_copy import HostCopy


class RankExchange:
    """A `pgccd.resolution.rounds.Exchange` of ranks whose searches tell the owners of bodies what they found.

    Args:
        comm: between the ranks.
    """

    shares_found = False

    def __init__(self, comm: Comm) -> None:
        self._comm = comm

    @property
    def rank(self) -> int:
        return self._comm.rank

    @property
    def ranks(self) -> int:
        return self._comm.size

    def share(self, first: Tensor, found: Tensor | None = None, anywhere: Tensor | None = None) -> None:
        """Nothing is to be shared."""

    def gather(self, values: Tensor) -> Tensor:
        """values (k,) -> (ranks, k): those of every rank."""
        return self._comm.all_gather(values)

    def any(self, value: Tensor) -> bool:
        """Whether value (1,) is nonzero on any rank."""
        return self._comm.any(bool(value))


class ReplicaExchange(RankExchange):
    """Exchange of the first toi of bodies that several ranks hold.

    All ranks that hold a body exchange messages directly. Its owner has the list of these ranks, the others derive it
    from the swept box; two ranks list the bodies that both hold in the same order, by owner, then by id.

    Args:
        decomposition: of space.
        peers: sends the messages; default: the connection.
    """

    # Bodies that other ranks hold too: the neighbours that hold them, their rows, and their number per neighbour (being
    # copied to the host).
    _replicas: Replicas
    _rows: Tensor
    _known: HostCopy

    def __init__(self, decomposition: Decomposition, peers: PeerMessages | None = None) -> None:
        super().__init__(decomposition.comm)
        self._neighbours = decomposition.neighbours
        self._peers = peers

    @classmethod
    def start(
        cls,
        share: Share,
        decomposition: Decomposition,
        capacities: list[int] | None = None,
        peers: PeerMessages | None = None,
    ) -> ReplicaExchange:
        """Finds the bodies that other ranks hold too.

        Args:
            share: with the held bodies.
            decomposition: used for the halo. Without capacities, it is extended if ranks that hold the same ghost are
                not neighbours (which synchronises, unless all ranks are neighbours).
            capacities: padded number of bodies shared with each neighbour, equal on both ranks. Default: the exact
                number.
            peers: sends the messages; default: the connection.
        """
        held = share.held
        if share.ghosts is None:
            exchange = cls(decomposition)
            exchange._shared = held.own_id[:0], [0]
            exchange._replicas = held.replicas
            return exchange
        route, ghost = held.route, torch.arange(held.ghost_count, device=held.own_id.device)
        row, before = ghost + held.own_count, sum(route.received[: route.neighbours.rank])
        ghost = torch.where(held.ghosts["id"] < 0, -1, ghost)  # padding
        find = agreed_replicas if capacities is None else find_replicas
        of_ghosts = find(decomposition, share.ghosts.swept_spheres, share.options.distances, ghost, route.received)
        exchange = cls(decomposition, peers)
        of_own = held.replicas.renumber(route.neighbours, decomposition.neighbours)
        # By owner, then by id: ghosts are in this order, and own bodies come between them.
        table = torch.cat([of_ghosts.table[:before], of_own.table, of_ghosts.table[before:]])
        exchange._replicas = Replicas(table, of_ghosts.counts + of_own.counts)
        exchange._rows = torch.cat([row[:before], held.boundary, row[before:]])
        if capacities is None:
            exchange._known = HostCopy.start(exchange._replicas.counts)  # copied while pairs are tested
        else:
            exchange._shared = exchange._replicas.rows_by_rank(exchange._rows, capacities), capacities
        return exchange

    def overflow(self) -> Tensor:
        """(1,) int64: nonzero if a capacity was exceeded, or ranks that hold the same ghost are not neighbours."""
        return self._replicas.overflow(self._shared[1])

    @functools.cached_property
    def _shared(self) -> tuple[Tensor, list[int]]:
        """Rows of bodies that other ranks hold too, by neighbour; and their number per neighbour."""
        counts: list[int] = self._known.numpy().tolist()
        return self._replicas.rows_by_rank(self._rows, counts), counts

    @functools.cached_property
    def _twice(self) -> Tensor:
        """(S, 2): these rows, each repeated as a pair."""
        return self._shared[0][:, None].expand(-1, 2).contiguous()

    def common(self, neighbours: Neighbourhood) -> list[int]:
        """Number of bodies that this rank shares with each of these neighbours."""
        return neighbours.renumber(self._neighbours, torch.tensor(self._shared[1])).tolist()

    @property
    def shares_found(self) -> bool:  # type: ignore[override]
        return self._peers is not None

    def share(self, first: Tensor, found: Tensor | None = None, anywhere: Tensor | None = None) -> None:
        """Sets the first toi (N + G,) float64 of all held bodies to the minimum over the ranks."""
        if self._comm.size == 1:
            return
        rows, counts = self._shared
        if self._peers is not None:
            shared = RowsOfRanks(rows, self._neighbours.counts_of_ranks(counts))
            self._peers.lower(first, shared, shared, found, anywhere)
            return
        answer = self._neighbours.exchange(ops.pack_rows([first], rows), counts, counts).wait()
        ops.resolve_first_toi(first, self._twice, answer.view(first.dtype)[:, 0])

    def gather(self, values: Tensor) -> Tensor:
        """values (k,) -> (ranks, k): those of every rank."""
        return self._comm.all_gather(values) if self._peers is None else self._peers.gather(values)
