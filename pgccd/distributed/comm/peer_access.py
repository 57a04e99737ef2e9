"""How the GPUs of a host get access to each other's memory: by CUDA's handles for other processes (CUDA IPC)."""

from __future__ import annotations

import ctypes
import os
import socket
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from pgccd.distributed.comm.peer_memory import PeerMemory, size_of_memory
from pgccd.runtime.events import gpu_finishes_within

if TYPE_CHECKING:
    from pgccd.distributed.comm.interface import Comm

# "0": never; "1": with a warning if it is not possible, and also if ranks share a GPU or NCCL may not use peer access;
# default: if it is possible.
_SETTING = "PGCCD_PEER_MEMORY"
# Settings of NCCL for machines on which peer access does not work, with the values that forbid it.
_NCCL_SETTINGS = {"NCCL_P2P_DISABLE": ("1",), "NCCL_P2P_LEVEL": ("0", "LOC")}
# As in csrc/kernels/peers/peers.h.
_MOST_RANKS = 16
# CUDA_IPC_HANDLE_SIZE
_HANDLE_BYTES = 64
# CUDA allocates memory in blocks of this size; other processes open whole blocks.
_BLOCK_BYTES = 2 << 20
# Time for the first messages to arrive.
_TRIAL_SECONDS = 20.0
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")

T = TypeVar("T")


class Place(NamedTuple):
    """Where a rank runs."""

    host: str
    gpu: str
    may_share: bool  #: whether other ranks may use the same GPU


def read_setting() -> str:
    """The value of PGCCD_PEER_MEMORY: "0", "1", or "" (default).

    Raises:
        ValueError: another value.
    """
    setting = os.environ.get(_SETTING, "")
    if setting not in ("", "0", "1"):
        raise ValueError(f"{_SETTING}: expected 0 or 1, got {setting!r}")
    return setting


def place_of_gpu() -> Place | None:
    """The place of this rank; None if other GPUs shall not write its memory, or its host cannot be identified."""
    setting = read_setting()
    is_forbidden = any(os.environ.get(name) in values for name, values in _NCCL_SETTINGS.items())
    if setting == "0" or (is_forbidden and setting != "1"):
        return None
    try:
        boot = _BOOT_ID.read_text().strip()
    except OSError:
        return None
    gpu = str(torch.cuda.get_device_properties(torch.cuda.current_device()).uuid)
    return Place(f"{socket.gethostname()} {boot}", gpu, setting == "1")


def are_peers(places: Sequence[Place | None]) -> bool:
    """Whether the ranks, given the place of each, are on one host, each with a GPU of its own unless all may share."""
    known = [place for place in places if place is not None]
    if len(known) < len(places) or len(places) > _MOST_RANKS or len({place.host for place in known}) > 1:
        return False
    return len({place.gpu for place in known}) == len(known) or all(place.may_share for place in known)


def map_peer_memory(comm: Comm, bytes: int) -> PeerMemory | None:
    """Reserves memory for messages of up to `bytes` between two ranks. None, on all ranks, if this fails on one: no
    memory is left, a GPU cannot access the memory of another one, or messages do not arrive. All ranks call it.

    The memory is kept until the process ends, since other ranks may write it until then.
    """
    own = _on_all_ranks(comm, lambda: _Reserved(size_of_memory(comm.size, bytes)))
    if own is None:
        return None
    handles = comm.all_gather(own.handle)

    def open_others() -> PeerMemory:
        opened = [own.address if rank == comm.rank else _open(handle) for rank, handle in enumerate(handles.cpu())]
        return PeerMemory(own.memory, opened, comm.rank)

    mapped = _on_all_ranks(comm, open_others)
    return None if mapped is None else _on_all_ranks(comm, lambda: _try_messages(mapped, comm.rank, comm.size))


def _on_all_ranks(comm: Comm, work: Callable[[], T]) -> T | None:
    """The result of work on this rank; None, on all ranks, if it fails on one. So no rank waits for one that failed."""
    made, why = None, "another rank could not"
    try:
        made = work()
    except Exception as error:  # any: the other ranks wait for this one
        why = str(error)
    if not comm.any(made is None):
        return made
    warn_if_wanted(f"GPUs cannot access each other's memory: {why}")
    return None


def warn_if_wanted(why: str) -> None:
    """Warns that NCCL sends the messages, if PGCCD_PEER_MEMORY=1."""
    if read_setting() == "1":
        warnings.warn(f"NCCL sends small messages: {why}", stacklevel=2)


class _Reserved:
    """Zeroed memory of this rank's GPU that other processes can open. It is not torch's, of which other processes could
    only open the whole block that a tensor is in.
    """

    def __init__(self, size: int) -> None:
        runtime = _runtime()
        self.address = int(_call(runtime.cudaMalloc, -(-size // _BLOCK_BYTES) * _BLOCK_BYTES))
        interface = {"shape": (size,), "typestr": "|u1", "data": (self.address, False), "version": 3}
        self.__cuda_array_interface__ = interface
        #: (size,) uint8.
        self.memory = torch.as_tensor(self, device="cuda").zero_()
        assert self.memory.data_ptr() == self.address, "expected no copy"
        torch.cuda.synchronize()
        handle = ctypes.string_at(_call(runtime.cudaIpcGetMemHandle, self.address).getPtr(), _HANDLE_BYTES)
        #: (8,) int64.
        self.handle = torch.frombuffer(bytearray(handle), dtype=torch.int64)


def _open(handle: Tensor) -> int:
    """The address, in this process, of the memory that another one reserved, given its handle."""
    runtime = _runtime()
    opened = runtime.cudaIpcMemHandle_t()
    ctypes.memmove(opened.getPtr(), handle.numpy().tobytes(), _HANDLE_BYTES)
    return int(_call(runtime.cudaIpcOpenMemHandle, opened, runtime.cudaIpcMemLazyEnablePeerAccess))


def _try_messages(memory: PeerMemory, rank: int, size: int) -> PeerMemory:
    """Sends messages of the full size, three, so that each of both slots is used and one again. Where peer access is
    broken, as on some machines with virtualised PCIe, they do not arrive.

    Raises:
        RuntimeError: values other than those sent have arrived, or none in time.
    """
    try:
        sent = [torch.arange(memory.bytes // 8, device="cuda") * size + 1000 * turn for turn in range(3)]
        gathered = [memory.gather(values + rank) for values in sent]
        if not gpu_finishes_within(_TRIAL_SECONDS):
            raise RuntimeError("messages do not arrive")
        ranks = torch.arange(size, device="cuda")[:, None]
        if not all(torch.equal(found, values + ranks) for found, values in zip(gathered, sent, strict=True)):
            raise RuntimeError("other values arrive than were sent")
    except BaseException:
        memory.stop()  # the agreement of ranks that follows would wait for these messages
        raise
    return memory


def _runtime() -> Any:
    from cuda.bindings import runtime  # comes with torch for CUDA

    _call(runtime.cudaSetDevice, torch.cuda.current_device())
    return runtime


def _call(function: Callable[..., Any], *arguments: Any) -> Any:
    error, *values = function(*arguments)
    if error.value != 0:
        raise RuntimeError(f"{function.__name__}: {error.name}")
    return values[0] if values else None
