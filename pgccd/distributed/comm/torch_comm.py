"""Ranks over torch.distributed: NCCL for GPUs, Gloo for CPUs, MPI if torch was built with it."""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable, Sequence
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn.functional import pad

from pgccd.distributed.comm.interface import Closeable, Comm, Pending, messages
from pgccd.distributed.comm.objects import Objects, decode, encode, require_sizes
from pgccd.distributed.comm.peer_access import (
    Place,
    are_peers,
    map_peer_memory,
    place_of_gpu,
    read_setting,
    warn_if_wanted,
)
from pgccd.distributed.comm.peer_memory import PeerMemory, size_of
from pgccd.distributed.guard import Guard, RankFailureError
from pgccd.runtime.events import gpu_finishes_within

# After an error of this rank: the time for messages that other ranks may still send, and the time in which kernels end
# after `stop_messages`. Together shorter than the guard's grace period, after which it ends the process.
_LAST_MESSAGES_SECONDS, _STOP_SECONDS = 5.0, 2.0
#: Time-out of Gloo's groups. The guard ends an exchange that takes too long; Gloo's clock also runs while the job is
#: suspended.
NO_TIMEOUT = timedelta(days=365)


# Interval in which a rank that waits for Gloo, whose own wait cannot be interrupted, looks whether there is a verdict.
_TURN = timedelta(seconds=0.2)


def finish(work: Any, guard: Guard) -> None:
    """Waits for work of Gloo. Raises RuntimeError when the guard has a verdict. None stands for finished work."""
    while work is not None:
        try:
            work.wait(_TURN)
            return
        except RuntimeError:
            if work.is_completed():
                work.wait()  # raises its error; none if it has completed since
                return
            guard.require_no_verdict()


class GroupObjects(Objects):
    """Exchange of small values over a process group.

    Args:
        group: of all ranks.
        guard: whose verdict ends a wait.
    """

    def __init__(self, group: dist.ProcessGroup, guard: Guard) -> None:
        self._group, self._guard = group, guard
        self._how: dict[str, Any] = {"group": group, "async_op": dist.get_backend(group) == "gloo"}
        self._device = torch.device("cuda" if dist.get_backend(group) == "nccl" else "cpu")

    def gather(self, value: Any) -> list[Any]:
        own = encode(value).to(self._device)
        sizes = own.new_zeros(dist.get_world_size(self._group), dtype=torch.int64)
        size = own.new_full((1,), len(own), dtype=torch.int64)
        finish(dist.all_gather(list(sizes.split(1)), size, **self._how), self._guard)
        announced = require_sizes(sizes)
        padded = pad(own, (0, max(announced) - len(own)))
        if dist.get_rank(self._group) != 0:
            finish(dist.gather(padded, group_dst=0, **self._how), self._guard)
            return []
        gathered = [torch.empty_like(padded) for _ in announced]
        finish(dist.gather(padded, gathered, group_dst=0, **self._how), self._guard)
        return [decode(each[:size]) for each, size in zip(gathered, announced, strict=True)]

    def broadcast(self, value: Any) -> Any:
        is_first = dist.get_rank(self._group) == 0
        own = encode(value if is_first else None).to(self._device)
        size = own.new_full((1,), len(own), dtype=torch.int64)
        finish(dist.broadcast(size, group_src=0, **self._how), self._guard)
        message = own if is_first else own.new_empty(require_sizes(size))
        finish(dist.broadcast(message, group_src=0, **self._how), self._guard)
        return decode(message)


class TorchComm(Comm):
    """The ranks of a process group.

    Args:
        group: default: the default process group, which must be initialised.
        control: a group for objects and checkpoints, on CPUs; default: `group`.
        guard: default: one that is not connected to other ranks.
        on_close: called by `close`.

    Attributes:
        control: the group for objects and checkpoints.
        kept: what must exist as long as this connection, such as the store of a group's ranks.

    Example:
        >>> torch.distributed.init_process_group("nccl")
        >>> comm = pgccd.distributed.TorchComm()
    """

    def __init__(
        self,
        group: dist.ProcessGroup | None = None,
        control: dist.ProcessGroup | None = None,
        guard: Guard | None = None,
        on_close: Callable[[], None] | None = None,
    ) -> None:
        if not dist.is_initialized():
            raise RuntimeError("group: torch.distributed is not initialised; see pgccd.distributed.connect")
        self._group: Any = dist.group.WORLD if group is None else group
        self.control: Any = self._group if control is None else control
        self.transport = dist.get_backend(self._group)
        self.rank = dist.get_rank(self._group)
        self.size = dist.get_world_size(self._group)
        self.guard = guard or Guard()
        self._on_close = on_close
        read_setting()  # raises an error now, not at the first graph
        self._is_closed = False
        self.kept: Any = None
        self._graphs: weakref.WeakSet[Closeable] = weakref.WeakSet()
        # Earlier graphs use earlier ones.
        self._peer_memories: list[PeerMemory] = []

    def _stage(self, tensor: Tensor) -> Tensor:
        """Moves a tensor to memory that the backend can read: GPU memory for NCCL, host memory for Gloo."""
        if self.transport == "nccl":
            return tensor if tensor.is_cuda else tensor.cuda()
        return tensor.cpu() if self.transport == "gloo" else tensor

    def exchange(
        self, rows: Tensor, sent: list[int], received: list[int], peers: Sequence[int] | None = None
    ) -> Pending[Tensor]:
        device, rows = rows.device, self._stage(rows).contiguous()
        arriving = rows.new_empty((sum(received), rows.shape[1]))
        # NCCL sends on the current stream, which is faster than on a separate one.
        later = self.transport != "nccl"
        if not later:
            # It sends no empty messages, and this call can be captured in a graph.
            sent, received, peers = self._of_all(sent, peers), self._of_all(received, peers), None
        else:
            peers = self._peers(peers)
        with self.guard.waiting("exchange"):
            if peers is None:
                work = dist.all_to_all_single(arriving, rows, received, sent, group=self._group, async_op=later)
                works = [work] if later else []
            else:
                works = self._to_peers(*messages(rows, arriving, sent, received, peers, self.rank))

        def wait(rows: Tensor = rows) -> Tensor:  # keeps the send buffer alive
            for work in works:
                if peers is None and self.transport == "gloo":
                    finish(work, self.guard)
                else:
                    work.wait()
            return arriving.to(device)

        return Pending(wait, self.guard)

    def _of_all(self, counts: list[int], peers: Sequence[int] | None) -> list[int]:
        """The number of rows for each rank, given those for the peers."""
        if peers is None:
            return counts
        of_all = [0] * self.size
        for peer, count in zip(peers, counts, strict=True):
            of_all[peer] = count
        return of_all

    def _to_peers(self, incoming: list[tuple[int, Tensor]], outgoing: list[tuple[int, Tensor]]) -> list[Any]:
        started = [
            dist.P2POp(operation, part, group=self._group, group_peer=other)
            for operation, parts in ((dist.irecv, incoming), (dist.isend, outgoing))
            for other, part in parts
        ]
        return dist.batch_isend_irecv(started) if started else []

    def all_gather(self, values: Tensor) -> Tensor:
        staged = self._stage(values)
        gathered = staged.new_empty((self.size, len(staged)))
        with self.guard.waiting("all-gather"):
            if self.transport == "nccl":  # one buffer, no copies
                dist.all_gather_into_tensor(gathered, staged, group=self._group)
            else:
                later = self.transport == "gloo"
                finish(dist.all_gather(list(gathered.unbind()), staged, group=self._group, async_op=later), self.guard)
            return gathered.to(values.device)

    def _reduce(self, values: Tensor, operation: Any, what: str) -> Tensor:
        staged = self._stage(values.clone())
        with self.guard.waiting(what):
            later = self.transport == "gloo"
            finish(dist.all_reduce(staged, op=operation, group=self._group, async_op=later), self.guard)
            return staged.to(values.device)

    def sum(self, values: Tensor) -> Tensor:
        return self._reduce(values, dist.ReduceOp.SUM, "sum")

    def min(self, values: Tensor) -> Tensor:
        return self._reduce(values, dist.ReduceOp.MIN, "agreement")

    def reserve_peer_messages(self, bytes: int) -> None:
        if not self._has_peers:
            return
        bytes = size_of(-int(self.min(torch.tensor([-bytes]))))
        if self._peer_memories and bytes <= self._peer_memories[-1].bytes:
            return
        self.peer_messages = mapped = map_peer_memory(self, bytes)
        if mapped is None:
            self._has_peers = False
        else:
            self._peer_memories.append(mapped)

    @functools.cached_property
    def _has_peers(self) -> bool:
        """Whether the GPUs of all ranks may be able to write each other's memory."""
        if self.transport != "nccl":
            return False
        places = [None if place is None else Place(*place) for place in self.gather_objects(place_of_gpu())]
        if self.broadcast_object(self.rank == 0 and are_peers(places)):
            return True
        warn_if_wanted("ranks are on several hosts, or more than 16, or one does not use the memory of other GPUs")
        return False

    @property
    def objects(self) -> Objects:
        return GroupObjects(self.control, self.guard)

    @functools.cached_property
    def background(self) -> Objects:
        ranks = dist.get_process_group_ranks(self._group)
        with self.guard.waiting("connection"):
            group = dist.new_group(ranks, backend="gloo", use_local_synchronization=True, timeout=NO_TIMEOUT)
        return GroupObjects(group, self.guard)

    def close_before(self, graph: Closeable) -> None:
        self._graphs.add(graph)

    def stop_messages(self) -> None:
        """Lets kernels of `peer_messages` give up messages that have not arrived. No message may follow."""
        for memory in self._peer_memories:
            memory.stop()

    def close(self) -> None:
        if self._is_closed:
            return
        if self.transport == "nccl":
            try:
                with self.guard.waiting("the last messages"):
                    torch.cuda.synchronize(self._gpu)
            except Exception as error:
                self.abandon(error)
                raise
        self._disconnect()

    def abandon(self, error: BaseException) -> None:
        self.guard.report(error)
        if isinstance(error, RankFailureError):
            # A regular shutdown would wait for the lost rank.
            self._is_closed = self.transport == "nccl"
            self.guard.close()
            self.stop_messages()
            return
        is_idle = False
        try:
            is_idle = self._finish_messages()
        finally:
            if is_idle:
                self._disconnect()
            else:  # NCCL waits for other ranks, and its shutdown would too
                self._is_closed = True
                self.guard.end_hard()

    def _finish_messages(self) -> bool:
        """Waits until this rank's GPU has finished its work, and lets it give up messages that do not arrive in time.
        False: it has not finished.
        """
        if self.transport != "nccl" or gpu_finishes_within(_LAST_MESSAGES_SECONDS, self._gpu):
            return True
        self.stop_messages()
        return gpu_finishes_within(_STOP_SECONDS, self._gpu)

    @property
    def _gpu(self) -> torch.device | int:
        """The GPU with messages of this rank."""
        return self._peer_memories[-1].device if self._peer_memories else torch.cuda.current_device()

    def _disconnect(self) -> None:
        self._is_closed = True
        self.guard.close()
        self.stop_messages()
        try:
            for graph in list(self._graphs):
                graph.close()
        finally:
            self.peer_messages = None
            self._peer_memories.clear()
            # Groups must be released before Python exits: Gloo's threads release tensors of theirs.
            vars(self).pop("_group", None)
            vars(self).pop("control", None)
            vars(self).pop("background", None)
            if self._on_close is not None:
                self._on_close()
