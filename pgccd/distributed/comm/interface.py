"""How ranks talk: one interface over torch.distributed and MPI; a world of one rank needs neither.

Whatever moves bodies or contacts between ranks goes through `Comm`. Only `torch_comm` and `mpi_comm` know what is
below.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Protocol

import torch
from torch import Tensor

from pgccd.distributed.guard import Guard, RankFailureError, is_of_all_ranks

# With more ranks than this, rows go to and come from neighbours alone; up to it, one collective call is faster.
_NEIGHBOURS_ABOVE = 32


class Closeable(Protocol):
    def close(self) -> None: ...


class Pending:
    """A message under way. What it was made of stays alive until `wait`.

    Args:
        wait: returns what was received.
        guard: notified when the rank waits for others; None if it never does.
    """

    def __init__(self, wait: Callable[[], Tensor], guard: Guard | None = None) -> None:
        self._wait = wait
        self._guard = guard

    def wait(self) -> Tensor:
        """What was received, on the device of what was sent."""
        if self._guard is None:
            return self._wait()
        with self._guard.waiting("exchange"):
            return self._wait()


class Background:
    """Small picklable values between ranks, from a thread of its own while others exchange messages. Here of one rank;
    every method must be called by all ranks, in the same order.
    """

    def gather(self, value: Any) -> list[Any]:
        """That of every rank, on rank 0; nothing on others."""
        return [value]

    def broadcast(self, value: Any) -> Any:
        """Rank 0's."""
        return value


class Comm(ABC):
    """Ranks 0 to size - 1, this one among them. Every method must be called by all of them, in the same order.

    Tensors are given and returned on any device; where the transport cannot read a GPU's memory, they are staged
    through the host.
    """

    #: What carries the messages: "none", "nccl", "gloo", "mpi", ...
    transport: str
    rank: int
    size: int
    #: Finds the rank at fault when a message does not come.
    guard: Guard
    #: With more ranks than this, `exchange` sends to neighbours one by one.
    neighbours_above = _NEIGHBOURS_ABOVE

    @property
    def goes_with_the_stream(self) -> bool:
        """Whether messages between GPUs are sent by their current stream, so that the host waits for nothing."""
        return self.transport == "nccl"

    @abstractmethod
    def exchange(self, rows: Tensor, sent: list[int], received: list[int]) -> Pending:
        """Ragged all-to-all of rows (K, bytes) uint8: `sent[r]` of them go to rank r, in order; `received[r]` come."""

    @abstractmethod
    def exchange_counts(self, counts: Tensor) -> Tensor:
        """counts (size, ...) int64, a row for each rank -> what each rank has for this one."""

    @abstractmethod
    def all_gather(self, values: Tensor) -> Tensor:
        """values (k,) -> (size, k): those of every rank."""

    @abstractmethod
    def sum(self, values: Tensor) -> Tensor:
        """The sum over the ranks of values (k,) int64 (modulo 2^64) or float64."""

    @abstractmethod
    def any(self, flag: bool) -> bool:
        """True if it is on any rank."""

    @abstractmethod
    def gather_objects(self, value: Any) -> list[Any]:
        """A small picklable value of every rank, by rank."""

    def broadcast_object(self, value: Any) -> Any:
        """Rank 0's small picklable value."""
        return self.gather_objects(value if self.rank == 0 else None)[0]

    def barrier(self) -> None:
        """Returns once every rank has come here."""
        self.any(False)

    @property
    @abstractmethod
    def background(self) -> Background:
        """Asked for by all ranks at once."""

    def close_before(self, graph: Closeable) -> None:
        """Closes a graph that sends messages before the connection, if it still exists then: NCCL does not end while
        there are graphs with messages of its own."""
        return  # other transports do not wait for graphs

    @abstractmethod
    def close(self) -> None:
        """Ends the connection; the last thing every rank calls."""

    def __enter__(self) -> Comm:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _traceback: object) -> None:
        if isinstance(error, RankFailureError):
            self.guard.close()  # ending the connection properly would wait for a rank that is no more
            return
        if error is not None and not is_of_all_ranks(error):
            self.guard.report(error)
        self.close()


class Alone(Comm):
    """A world of one rank: every exchange is the identity.

    Example:
        >>> world = pgccd.distributed.World([mesh], lower, upper, position, comm=pgccd.distributed.Alone())
    """

    transport = "none"
    rank = 0
    size = 1

    def __init__(self) -> None:
        self.guard = Guard()

    def exchange(self, rows: Tensor, sent: list[int], received: list[int]) -> Pending:
        return Pending(lambda: rows)

    def exchange_counts(self, counts: Tensor) -> Tensor:
        return counts

    def all_gather(self, values: Tensor) -> Tensor:
        return values[None]

    def sum(self, values: Tensor) -> Tensor:
        return values

    def any(self, flag: bool) -> bool:
        return flag

    def gather_objects(self, value: Any) -> list[Any]:
        return [value]

    @property
    def background(self) -> Background:
        return Background()

    def close(self) -> None:
        self.guard.close()


def split_rows(rows: Tensor, counts: list[int]) -> list[Tensor]:
    """Views of consecutive rows."""
    return list(torch.split(rows, counts))
