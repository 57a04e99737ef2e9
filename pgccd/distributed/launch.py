"""From a launcher to a `Comm`: torchrun, mpirun, srun, or none at all."""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Literal, get_args

import torch
import torch.distributed as dist

from pgccd.distributed import nccl
from pgccd.distributed.comm import Alone, Comm
from pgccd.distributed.guard import Guard
from pgccd.distributed.torch_comm import TorchComm

Transport = Literal["auto", "nccl", "gloo", "torch-mpi", "mpi4py"]
TRANSPORTS: tuple[str, ...] = get_args(Transport)
DEFAULT_TIMEOUT = 300.0
_NCCL_MARGIN = 60.0

# The variables of rank, size and local rank, by launcher. srun sets SLURM_STEP_NUM_TASKS; a batch script, which is one
# process, has only SLURM_NTASKS.
_VARIABLES = {
    "torchrun": ("RANK", "WORLD_SIZE", "LOCAL_RANK"),
    "Open MPI": ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_LOCAL_RANK"),
    "MPICH": ("PMI_RANK", "PMI_SIZE", "MPI_LOCALRANKID"),
    "MVAPICH": ("MV2_COMM_WORLD_RANK", "MV2_COMM_WORLD_SIZE", "MV2_COMM_WORLD_LOCAL_RANK"),
    "srun": ("SLURM_PROCID", "SLURM_STEP_NUM_TASKS", "SLURM_LOCALID"),
}


@dataclass(frozen=True)
class Placement:
    """Where this process stands among those that were launched together."""

    launcher: str  #: a key of the variables above, or "none"
    rank: int
    size: int
    local_rank: int  #: among those of its machine
    restarts: int = 0  #: of all of them, by torchrun


def find_placement(environment: Mapping[str, str] = os.environ) -> Placement:
    """Reads what the launcher left in the environment.

    Raises:
        ValueError: if a variable is not a number.

    Example:
        >>> pgccd.distributed.find_placement().size
        1
    """
    for launcher, (rank, size, local_rank) in _VARIABLES.items():
        if rank in environment and size in environment:
            numbers = {}
            for name in (rank, size, local_rank, "TORCHELASTIC_RESTART_COUNT"):
                text = environment.get(name, "0")
                if not re.fullmatch(r"\d+", text):
                    raise ValueError(f"{name}: expected a number, got {text!r}")
                numbers[name] = int(text)
            return Placement(launcher, *numbers.values())
    return Placement("none", 0, 1, 0)


def choose_device(device: str | torch.device, placement: Placement | None = None) -> torch.device:
    """ "cuda" becomes the GPU of this rank: that of its number on its machine."""
    chosen = torch.device(device)
    placement = placement or find_placement()
    if chosen.type == "cuda" and chosen.index is None and placement.size > 1:
        return torch.device("cuda", placement.local_rank % max(1, torch.cuda.device_count()))
    return chosen


def connect(
    device: str | torch.device = "cpu", transport: Transport = "auto", timeout: float = DEFAULT_TIMEOUT
) -> Comm:
    """Connects all processes that were launched together. Without a launcher there is one.

    Args:
        device: where data will be: "auto" takes NCCL for GPUs and Gloo for CPUs.
        transport: "nccl", "gloo", "torch-mpi" (torch's MPI backend, where it was built with one), or "mpi4py".
        timeout: seconds after which an exchange that does not end is an error, and the job with it.

    Raises:
        ValueError: naming the argument, or the variable of the environment.
        ImportError: mpi4py is needed and not installed.
        RuntimeError: the others did not come within the time-out.

    Example:
        >>> with pgccd.distributed.connect() as comm:
        ...     print(comm.rank, comm.size)
    """
    if transport not in TRANSPORTS:
        raise ValueError(f"transport: expected one of {list(TRANSPORTS)}, got {transport!r}")
    if not 0.0 < timeout < 1e9:
        raise ValueError(f"timeout: expected seconds > 0, got {timeout}")
    placement = find_placement()
    if placement.size == 1:
        return Alone()
    device = choose_device(device, placement)
    if device.type == "cuda" and torch.cuda.is_available():
        torch.cuda.set_device(device)
    store = _rendezvous(placement, timeout)
    # A process that keeps the store is the last to go.
    keeps = placement.rank == 0 and os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True"
    guard = Guard(_second_connection(store), placement.rank, placement.size, timeout, keeps)
    backend = _backend(transport, device, placement, store)
    # NCCL's own watchdog names nobody: the guard gets the time to.
    patience = timeout + _NCCL_MARGIN if backend == "nccl" else timeout
    options = nccl.options(_delta(patience)) if backend == "nccl" else None
    dist.init_process_group(
        backend,
        store=store,
        rank=placement.rank,
        world_size=placement.size,
        timeout=_delta(patience),
        pg_options=options,
    )
    if backend == "nccl":
        guard.is_broken = nccl.watch_errors()
    control = dist.group.WORLD if backend == "gloo" else dist.new_group(backend="gloo", timeout=_delta(timeout))
    if transport == "mpi4py":
        from pgccd.distributed.mpi_comm import MpiComm

        return MpiComm(control, guard, dist.destroy_process_group)
    return TorchComm(dist.group.WORLD, control, guard, dist.destroy_process_group)


def _delta(seconds: float) -> timedelta:
    return timedelta(seconds=seconds)


def _backend(transport: Transport, device: torch.device, placement: Placement, store: dist.Store) -> str:
    if transport == "mpi4py":
        return "gloo"  # for agreement and checkpoints
    if transport == "torch-mpi":
        if not dist.is_mpi_available():
            raise ValueError("transport: this torch was built without MPI; mpi4py takes its place")
        return "mpi"
    if transport != "auto":
        return transport
    # NCCL wants a GPU for every rank; whether there is one must look the same to all.
    keys = [f"device/{rank}" for rank in range(placement.size)]
    # Its own number: where each rank is shown one GPU only, all of them call it cuda:0.
    has_gpu = device.type == "cuda" and torch.cuda.is_available()
    store.set(keys[placement.rank], str(torch.cuda.get_device_properties(device).uuid) if has_gpu else "none")
    store.wait(keys)
    devices = store.multi_get(keys)
    usable = b"none" not in devices and len(set(devices)) == len(devices)
    return "nccl" if usable and dist.is_nccl_available() else "gloo"


def _rendezvous(placement: Placement, timeout: float) -> dist.Store:
    """A store that all ranks of this start share, and no other start."""
    if placement.launcher == "torchrun":
        # torchrun's agent keeps a store that outlives the workers: each start needs its own part of it, or it would
        # read the addresses of the one before.
        agent = os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"
        run = os.environ.get("TORCHELASTIC_RUN_ID", "run")
        store = _connect_store(
            _variable("MASTER_ADDR"), int(_variable("MASTER_PORT")), placement, timeout, keeps=not agent
        )
        return dist.PrefixStore(f"pgccd/{run}/{placement.restarts}", store)
    if placement.launcher == "srun":
        host = os.environ.get("MASTER_ADDR") or first_host(_variable("SLURM_STEP_NODELIST"))
        # The same on all ranks, and another for another job or step.
        number = int(os.environ.get("SLURM_JOB_ID", "0")) * 31 + int(os.environ.get("SLURM_STEP_ID", "0"))
        port = int(os.environ.get("MASTER_PORT", 20000 + number % 20000))
        return _connect_store(host, port, placement, timeout, keeps=True)
    return _rendezvous_by_mpi(placement, timeout)


def _rendezvous_by_mpi(placement: Placement, timeout: float) -> dist.Store:
    try:
        from mpi4py import MPI
    except (ImportError, RuntimeError) as error:  # RuntimeError: no MPI library
        raise ImportError(f"started by {placement.launcher}: pip install mpi4py mpich ({error})") from error
    world = MPI.COMM_WORLD
    if world.Get_size() != placement.size:
        raise ValueError(
            f"mpi4py: its library sees {world.Get_size()} ranks, {placement.launcher} started {placement.size}: "
            "they belong to different MPIs"
        )
    hosts = world.allgather(socket.gethostname())
    host = "127.0.0.1" if len(set(hosts)) == 1 else os.environ.get("MASTER_ADDR", hosts[0])
    store = None
    if placement.rank == 0:
        store = _connect_store(host, 0, placement, timeout, keeps=True)
    port = world.bcast(store.port if store is not None else None)
    return store or _connect_store(host, port, placement, timeout, keeps=True)


def _connect_store(host: str, port: int, placement: Placement, timeout: float, keeps: bool) -> dist.TCPStore:
    return dist.TCPStore(
        host,
        port,
        placement.size,
        is_master=keeps and placement.rank == 0,
        timeout=_delta(timeout),
        wait_for_workers=False,
    )


def _second_connection(store: Any) -> dist.Store:
    """For the guard: a store answers one question at a time, and one may wait long."""
    return dist.PrefixStore("guard", store.clone())


def _variable(name: str) -> str:
    try:
        return os.environ[name]
    except KeyError:
        raise ValueError(f"{name}: not set, though other variables of its launcher are") from None


def first_host(node_list: str) -> str:
    """Of Slurm's short form.

    Example:
        >>> first_host("gpu[007-012,020],login1")
        'gpu007'
    """
    found = re.match(r"([^\[,]+)(?:\[([^\],-]+))?", node_list)
    if found is None:
        raise ValueError(f"SLURM_STEP_NODELIST: expected host names, got {node_list!r}")
    return found[1] + (found[2] or "")
