"""Steps of ranks as replays of one CUDA graph per rank, messages included."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, Protocol, TypeVar

from pgccd.distributed.halo.halo_sizes import HaloSizes
from pgccd.distributed.partition.balance import RankLoads
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.distributed.steps.rank import Rank
from pgccd.runtime.replayed_steps import ReplayedSteps
from pgccd.runtime.transaction import Replay, TransactionGraph

# Bodies that have left their rank's cells migrate when there are more of them than the number of ghosts divided by this
# (each may be a ghost).
_MOST_AWAY = 4
# Spare rows for arriving bodies: this fraction of the own bodies, plus a constant.
_OWN_SHARE, _OWN_MORE = 16, 256


class CommittedByRanks(Protocol):
    """A step that was committed on all ranks; the same values on each."""

    @property
    def index(self) -> int:
        """From 0."""
        ...

    @property
    def loads(self) -> RankLoads: ...

    @property
    def ghosts(self) -> int:
        """Number of ghosts, over all ranks."""
        ...

    @property
    def leaving(self) -> int:
        """Number of bodies in cells of other ranks than their own, over all ranks."""
        ...


T = TypeVar("T")
M = TypeVar("M")
C = TypeVar("C", bound=CommittedByRanks)
G = TypeVar("G", bound=TransactionGraph[Any])


class RankSteps(ReplayedSteps[M, C, G]):
    """Steps of a loop on many ranks: replays of one graph per rank, and eager steps where bodies migrate, space is
    rebalanced, or a graph does not suffice on any rank. All ranks call every method.

    Args:
        rank: this one.
        wants_graph: whether steps are replayed, the same on all ranks.
    """

    _graph_decomposition: Decomposition

    def __init__(self, rank: Rank, wants_graph: bool) -> None:
        super().__init__(wants_graph)
        self._rank = rank

    @abstractmethod
    def _graph_of(self, index: int, decomposition: Decomposition, sizes: HaloSizes, rows: int) -> G:
        """The graph of the next step, to be captured.

        Args:
            index: of the step.
            decomposition: a copy owned by the graph.
            sizes: of the halo.
            rows: number of rows for own bodies.
        """

    @abstractmethod
    def _largest_message(self, sizes: HaloSizes) -> int:
        """Number of 8-byte values of the largest message between two ranks, or of all ranks, that holds no bodies."""

    def _make_graph(self, index: int) -> G:
        sizes, own_count = self._rank.capacities(), len(self._columns["id"])
        self._graph_decomposition = self._rank.decomposition.copy()
        self._rank.comm.reserve_peer_messages(8 * self._largest_message(sizes))
        rows = own_count + own_count // _OWN_SHARE + _OWN_MORE
        return self._graph_of(index, self._graph_decomposition, sizes, rows)

    def _begin(self, graph: G, index: int) -> None:
        self._rank.comm.close_before(graph)
        super()._begin(graph, index)

    def _fits(self, graph: G) -> bool:
        fits = super()._fits(graph) and self._graph_decomposition.become(self._rank.decomposition)
        return not self._rank.comm.any(not fits)

    def _is_captured(self, captured: bool) -> bool:
        return not self._rank.comm.any(not captured)

    def _are_others_waiting(self, graph: G | None) -> bool:
        return self._rank.comm.size > 1 and (graph is None or not graph.has_run)

    def _read(self, replay: Replay[C], index: int) -> C | None:
        return self._wait(replay, index)

    def _wait(self, replay: Replay[T], index: int) -> T | None:
        """What a replay committed, watched by the guard; None if it did not."""
        comm = self._rank.comm
        with comm.guard.waiting("step"):
            return replay.read(index)

    def _needs_eager_step(self, step: C, enqueued: int) -> bool:
        # Bodies migrate, and space is rebalanced, after an eager step.
        is_due = self._rank.is_balance_due(step.index + 2 + enqueued, step.loads)
        return is_due or _MOST_AWAY * step.leaving > step.ghosts
