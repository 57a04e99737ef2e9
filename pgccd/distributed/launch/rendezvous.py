"""How ranks that were started together find one another: through a store that only they share."""

from __future__ import annotations

import os
import re
import socket
import time
import uuid
from datetime import timedelta

import torch.distributed as dist

from pgccd.distributed.launch.placement import Placement

_POLL_SECONDS = 0.01


def meet(placement: Placement, timeout: float) -> dist.Store:
    """The store.

    Raises:
        ValueError: naming a variable of the environment.
        ImportError: mpi4py is needed and not installed.
        RuntimeError: the others did not come within `timeout` seconds.
    """
    if placement.launcher == "torchrun":
        run = os.environ.get("TORCHELASTIC_RUN_ID", "run")
        address = _variable("MASTER_ADDR"), int(_variable("MASTER_PORT"))
        store = _connect_store(*address, placement, timeout, keeps=not agent_keeps_store())
        return agree_on_start(dist.PrefixStore(f"pgccd/{run}", store), placement, timeout)
    if placement.launcher == "srun":
        host = os.environ.get("MASTER_ADDR") or first_host(_variable("SLURM_STEP_NODELIST"))
        # The same on all ranks, and another for another job or step.
        number = int(os.environ.get("SLURM_JOB_ID", "0")) * 31 + int(os.environ.get("SLURM_STEP_ID", "0"))
        port = int(os.environ.get("MASTER_PORT", 20000 + number % 20000))
        return _connect_store(host, port, placement, timeout, keeps=True)
    return _meet_by_mpi(placement, timeout)


def agent_keeps_store() -> bool:
    """torchrun's agent, not rank 0: then the store outlives the ranks."""
    return os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"


def agree_on_start(store: dist.Store, placement: Placement, timeout: float) -> dist.Store:
    """A part of a store that was perhaps used before, for this start alone: what others left there might be taken for
    signs of ranks of this one. Counts of restarts do not identify a start: each agent of torchrun counts its own.

    Rank 0 answers each rank's request with the name of the start, until every rank has joined.
    """
    name = uuid.uuid4().hex
    if placement.rank == 0:
        _welcome(store, placement.size, name, timeout)
        return dist.PrefixStore(name, store)
    store.set(f"asks/{placement.rank}", name)
    try:
        start = store.get(f"start for {name}").decode()
    except dist.DistError as error:
        raise RuntimeError(f"rank 0 did not come within {timeout:g} s ({error})") from error
    store.set(f"{start}/here/{placement.rank}", "")
    return dist.PrefixStore(start, store)


def _welcome(store: dist.Store, size: int, start: str, timeout: float) -> None:
    """Gives all other ranks the start's name."""
    deadline = time.monotonic() + timeout
    missing, answered = list(range(1, size)), set()
    while missing:
        for rank in missing:
            if store.check([f"asks/{rank}"]):  # perhaps one that is no more: its successor asks by another name
                asking = store.get(f"asks/{rank}").decode()
                if asking not in answered:
                    store.set(f"start for {asking}", start)
                    answered.add(asking)
        missing = [rank for rank in missing if not store.check([f"{start}/here/{rank}"])]
        if missing and time.monotonic() > deadline:
            raise RuntimeError(f"ranks {missing[:8]} of {size} did not come within {timeout:g} s")
        time.sleep(_POLL_SECONDS)


def _meet_by_mpi(placement: Placement, timeout: float) -> dist.Store:
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
        timeout=timedelta(seconds=timeout),
        wait_for_workers=False,
    )


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
