"""Ranks over MPI by mpi4py. CUDA-aware libraries read GPU memory directly; otherwise it is staged through the host."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from pgccd.distributed.comm.interface import Comm, Pending, messages
from pgccd.distributed.comm.objects import Objects, decode, encode, require_sizes
from pgccd.distributed.comm.torch_comm import NO_TIMEOUT, GroupObjects
from pgccd.distributed.guard import Guard

# Environment variables that make MPI libraries read GPU memory, or declare that they do.
_CUDA_SWITCHES = {
    "MPICH_GPU_SUPPORT_ENABLED": "1",  # Cray MPICH
    "MPIR_CVAR_ENABLE_GPU": "1",  # MPICH
    "OMPI_MCA_opal_cuda_support": "true",  # Open MPI
    "MV2_USE_CUDA": "1",  # MVAPICH
    "PGCCD_MPI_CUDA": "1",  # any other
}


class MpiObjects(Objects):
    """Exchange of small values over an MPI communicator. mpi4py's methods whose names begin with a small letter send
    pickles.
    """

    def __init__(self, world: Any) -> None:
        self._world = world

    def gather(self, value: Any) -> list[Any]:
        own, is_first = encode(value), self._world.Get_rank() == 0
        sizes = torch.zeros(self._world.Get_size(), dtype=torch.int64)
        self._world.Allgather(torch.tensor([len(own)]).numpy(), sizes.numpy())
        announced = require_sizes(sizes)
        gathered = own.new_empty(sum(announced) if is_first else 0)
        self._world.Gatherv(own.numpy(), [gathered.numpy(), announced] if is_first else None)
        return [decode(each) for each in gathered.split(announced)] if is_first else []

    def broadcast(self, value: Any) -> Any:
        is_first = self._world.Get_rank() == 0
        own = encode(value if is_first else None)
        size = torch.tensor([len(own)])
        self._world.Bcast(size.numpy())
        message = own if is_first else own.new_empty(require_sizes(size))
        self._world.Bcast(message.numpy())
        return decode(message)


class MpiComm(Comm):
    """The ranks of MPI_COMM_WORLD.

    Args:
        control: a torch.distributed group for objects and checkpoints; without it there are no checkpoints.
        guard: default: one that is not connected to other ranks.
        on_close: called by `close`.

    Attributes:
        control: the group for objects and checkpoints, or None.
        reads_gpu: whether the MPI library reads GPU memory, so that messages need not be staged through the host.

    Raises:
        ImportError: mpi4py is not installed, or there is no MPI library.

    Example:
        >>> comm = pgccd.distributed.MpiComm()  # under mpirun
    """

    transport = "mpi"

    def __init__(
        self,
        control: dist.ProcessGroup | None = None,
        guard: Guard | None = None,
        on_close: Callable[[], None] | None = None,
    ) -> None:
        try:
            from mpi4py import MPI
        except RuntimeError as error:
            raise ImportError(f"mpi4py: {error}") from error
        self._mpi = MPI
        self._world = MPI.COMM_WORLD.Dup()  # separates our messages from the user's
        self.control = control
        self.rank, self.size = self._world.Get_rank(), self._world.Get_size()
        self.guard = guard or Guard()
        self._on_close = on_close
        self.reads_gpu = any(os.environ.get(name) == value for name, value in _CUDA_SWITCHES.items())

    def _stage(self, tensor: Tensor) -> Tensor:
        if not tensor.is_cuda:
            return tensor
        if not self.reads_gpu:
            return tensor.cpu()
        torch.cuda.current_stream().synchronize()  # MPI is not ordered with CUDA streams
        return tensor

    @staticmethod
    def _buffer(tensor: Tensor) -> Any:
        """As mpi4py expects it: an array, or a tensor with the CUDA array interface."""
        return tensor if tensor.is_cuda else tensor.numpy()

    def exchange(
        self, rows: Tensor, sent: list[int], received: list[int], peers: Sequence[int] | None = None
    ) -> Pending[Tensor]:
        device, rows = rows.device, self._stage(rows.contiguous())
        arriving = rows.new_empty((sum(received), rows.shape[1]))
        peers = self._peers(peers)
        with self.guard.waiting("exchange"):
            if peers is None:
                requests = [self._to_all(rows, arriving, sent, received)]
            else:
                incoming, outgoing = messages(rows, arriving, sent, received, peers, self.rank)
                requests = [self._world.Irecv([self._buffer(part), self._mpi.BYTE], peer) for peer, part in incoming]
                requests += [self._world.Isend([self._buffer(part), self._mpi.BYTE], peer) for peer, part in outgoing]

        def wait(rows: Tensor = rows) -> Tensor:  # keeps the send buffer alive
            self._mpi.Request.Waitall(requests)
            return arriving.to(device)

        return Pending(wait, self.guard)

    def _to_all(self, rows: Tensor, arriving: Tensor, sent: list[int], received: list[int]) -> Any:
        width = rows.shape[1]

        def message(tensor: Tensor, counts: list[int]) -> list[Any]:
            bytes_each = [count * width for count in counts]
            begins = [0, *accumulate(bytes_each)][:-1]
            return [self._buffer(tensor), (bytes_each, begins), self._mpi.BYTE]

        return self._world.Ialltoallv(message(rows, sent), message(arriving, received))

    def all_gather(self, values: Tensor) -> Tensor:
        staged = values.cpu().contiguous()
        gathered = staged.new_empty((self.size, len(staged)))
        with self.guard.waiting("all-gather"):
            self._world.Allgather(staged.numpy(), gathered.numpy())
        return gathered.to(values.device)

    def _reduce(self, values: Tensor, operation: Any, what: str) -> Tensor:
        staged = values.cpu().clone()
        with self.guard.waiting(what):
            self._world.Allreduce(self._mpi.IN_PLACE, staged.numpy(), op=operation)
        return staged.to(values.device)

    def sum(self, values: Tensor) -> Tensor:
        return self._reduce(values, self._mpi.SUM, "sum")

    def min(self, values: Tensor) -> Tensor:
        return self._reduce(values, self._mpi.MIN, "agreement")

    @property
    def objects(self) -> Objects:
        return MpiObjects(self._world)

    @functools.cached_property
    def background(self) -> Objects:
        if self.control is None:
            raise RuntimeError("control: checkpoints need a torch.distributed group beside MPI")
        with self.guard.waiting("connection"):
            return GroupObjects(dist.new_group(backend="gloo", timeout=NO_TIMEOUT), self.guard)

    def close(self) -> None:
        self.guard.close()
        # As in torch_comm.
        vars(self).pop("control", None)
        vars(self).pop("background", None)
        if self._on_close is not None:
            self._on_close()
