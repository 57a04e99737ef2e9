"""Communication between ranks: one interface over torch.distributed and MPI; a single rank needs neither.

All transfers of bodies and contacts use `Comm`. Only `torch_comm` and `mpi_comm` depend on a communication library.
"""

from __future__ import annotations

import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Generic, Protocol, TypeVar

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.distributed.comm.objects import Objects
from pgccd.distributed.comm.peer_memory import PeerMessages
from pgccd.distributed.guard import Guard, RankFailureError, collective, is_of_all_ranks

# Up to this number of ranks one collective call exchanges counts and rows; above it, messages go to neighbours only.
_NEIGHBOURS_ABOVE = 32
# Calls that each transport makes in its own way.
_OF_TRANSPORTS = ("exchange", "all_gather", "sum", "min", "reserve_peer_messages")

T = TypeVar("T")


class Closeable(Protocol):
    def close(self) -> None: ...


class Pending(Generic[T]):
    """A pending message. Its send buffer is kept alive until `wait`.

    Args:
        wait: returns what was received.
        guard: notified while the rank waits for others; None if it never does.
    """

    def __init__(self, wait: Callable[[], T], guard: Guard | None = None) -> None:
        self._wait = wait
        self._guard = guard

    def wait(self) -> T:
        """What was received, on the device of what was sent."""
        if self._guard is None:
            return self._wait()
        with self._guard.waiting("exchange"):
            return self._wait()


class Comm(ABC):
    """Communication among ranks 0 to size - 1. Every method must be called by all ranks, in the same order.

    Tensors may be on any device, and results are on the same device; if the transport cannot read GPU memory, they are
    staged through the host.

    Attributes:
        transport: the communication library: "none", "nccl", "gloo", "mpi", ...
        rank: of this process.
        size: number of ranks.
        guard: finds the rank at fault when a message does not arrive.
        peer_messages: for small messages in a CUDA graph, after `reserve_peer_messages`; None: not possible.
        neighbours_above: above this number of ranks, messages are sent point-to-point, bodies and their counts to
            neighbours only.
    """

    transport: str
    rank: int
    size: int
    guard: Guard
    peer_messages: PeerMessages | None = None
    neighbours_above = _NEIGHBOURS_ABOVE

    def __init_subclass__(cls) -> None:
        for name in _OF_TRANSPORTS:
            if name in vars(cls):
                setattr(cls, name, collective(vars(cls)[name], f"Comm.{name}"))

    @property
    def goes_with_the_stream(self) -> bool:
        """Whether messages between GPUs are enqueued on the current stream, so that the host does not wait."""
        return self.transport == "nccl"

    @abstractmethod
    def exchange(
        self, rows: Tensor, sent: list[int], received: list[int], peers: Sequence[int] | None = None
    ) -> Pending[Tensor]:
        """Ragged exchange of rows (K, bytes) uint8 between ranks: the first `sent[0]` go to `peers[0]`, and so on;
        `received[i]` come from `peers[i]`.

        Args:
            peers: ascending; only the ranks with rows for each other exchange messages. Default: all ranks, up to
                `neighbours_above` of them by one collective call.
        """

    @collective
    def exchange_counts(self, counts: Tensor, peers: Sequence[int] | None = None) -> Tensor:
        """counts (peers, ...) int64, one row per peer -> the row for this rank of each; `peers` as for `exchange`."""
        once = [1] * len(counts)
        packed = counts.reshape(len(counts), math.prod(counts.shape[1:])).contiguous().view(torch.uint8)
        return self.exchange(packed, once, once, peers).wait().view(counts.dtype).view_as(counts)

    @abstractmethod
    def all_gather(self, values: Tensor) -> Tensor:
        """values (k,) -> (size, k): those of every rank."""

    @abstractmethod
    def sum(self, values: Tensor) -> Tensor:
        """The sum over the ranks of values (k, ...) int64 (modulo 2^64) or float64."""

    @abstractmethod
    def min(self, values: Tensor) -> Tensor:
        """The minimum over the ranks of each of the values (k, ...) int64 or float64."""

    @collective
    def any(self, flag: bool) -> bool:
        """True if the flag is set on any rank."""
        return bool(self.min(torch.tensor([-int(flag)])))

    @property
    @abstractmethod
    def objects(self) -> Objects:
        """The exchange of small values."""

    @property
    @abstractmethod
    def background(self) -> Objects:
        """The same, from a separate thread, concurrent with other messages; created by a call on all ranks."""

    @collective
    def gather_objects(self, value: Any) -> list[Any]:
        """A small value of every rank on rank 0, ordered by rank; an empty list on the others. Values are sent as JSON,
        in which tuples are lists.
        """
        with self.guard.waiting("gather of objects"):
            return self.objects.gather(value)

    @collective
    def broadcast_object(self, value: Any) -> Any:
        """Rank 0's small value, as by `gather_objects`."""
        with self.guard.waiting("broadcast of an object"):
            return self.objects.broadcast(value)

    @collective
    def broadcast(self, values: Tensor | None) -> Tensor:
        """Rank 0's tensor on all ranks, on the CPU.

        Args:
            values: of any shape (...) and dtype; ignored on ranks other than 0, which may pass None.

        Returns:
            (...): the same shape and dtype on all ranks.
        """
        mine = values.detach().cpu().contiguous() if self.rank == 0 and values is not None else None
        layout = None if mine is None else [arguments.dtype_name(mine.dtype), list(mine.shape)]
        dtype, shape = self.broadcast_object(layout)
        tensor = torch.zeros(shape, dtype=getattr(torch, dtype)) if mine is None else mine
        if not tensor.numel():
            return tensor
        packed = tensor.view(-1).view(torch.uint8)
        # The sum of rank 0's bytes and of zeros.
        words = torch.nn.functional.pad(packed, (0, -len(packed) % 8)).view(torch.int64)
        return self.sum(words).view(torch.uint8)[: len(packed)].view(tensor.dtype).view(shape)

    def _peers(self, peers: Sequence[int] | None) -> Sequence[int] | None:
        """The ranks to send to point-to-point; None: one collective call with all ranks."""
        return range(self.size) if peers is None and self.size > self.neighbours_above else peers

    @collective
    def barrier(self) -> None:
        """Returns once every rank has called it."""
        self.any(False)

    def reserve_peer_messages(self, bytes: int) -> None:
        """Makes `peer_messages` available, if possible, for messages of up to `bytes` between two ranks (which may
        differ between ranks). Called before the capture of each graph that uses them.
        """
        return  # only for GPUs

    def close_before(self, graph: Closeable) -> None:
        """Closes a graph with messages before the connection, if it still exists then: NCCL's shutdown blocks while
        graphs with its messages exist.
        """
        return  # other transports do not block on graphs

    @abstractmethod
    def close(self) -> None:
        """Ends the connection; the last call on every rank."""

    def abandon(self, error: BaseException) -> None:
        """Ends the connection of a rank that leaves the job because of an error that not all ranks have, so that
        messages may be missing.
        """
        self.guard.report(error)
        if isinstance(error, RankFailureError):
            self.guard.close()  # a regular shutdown would wait for the lost rank
        else:
            self.close()

    def __enter__(self) -> Comm:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _traceback: object) -> None:
        if error is None:
            self.close()
            return
        with contextlib.suppress(Exception):  # `error` is raised, not one of the shutdown that follows from it
            if is_of_all_ranks(error):
                self.close()
            else:
                self.abandon(error)


class Alone(Comm):
    """Communication of a single rank: every exchange is the identity.

    Example:
        >>> world = pgccd.distributed.World.create(scene, position, lower, upper, comm=pgccd.distributed.Alone())
    """

    transport = "none"
    rank = 0
    size = 1

    def __init__(self) -> None:
        self.guard = Guard()

    def exchange(
        self, rows: Tensor, sent: list[int], received: list[int], peers: Sequence[int] | None = None
    ) -> Pending[Tensor]:
        return Pending(lambda: rows)

    def all_gather(self, values: Tensor) -> Tensor:
        return values[None]

    def sum(self, values: Tensor) -> Tensor:
        return values

    def min(self, values: Tensor) -> Tensor:
        return values

    @property
    def objects(self) -> Objects:
        return Objects()

    background = objects

    def close(self) -> None:
        self.guard.close()


def messages(
    rows: Tensor, arriving: Tensor, sent: list[int], received: list[int], peers: Sequence[int], rank: int
) -> tuple[list[tuple[int, Tensor]], list[tuple[int, Tensor]]]:
    """The messages of an exchange as (other rank, view of its rows): those received, and those sent; rows for this rank
    itself are copied.
    """
    lists: list[list[tuple[int, Tensor]]] = []
    for tensor, counts in ((arriving, received), (rows, sent)):
        parts = zip(peers, torch.split(tensor, counts), strict=True)
        lists.append([(other, part) for other, part in parts if len(part)])
    own = [part for parts in lists for other, part in parts if other == rank]
    if own:
        own[0].copy_(own[1])
    incoming, outgoing = ([message for message in parts if message[0] != rank] for parts in lists)
    return incoming, outgoing
