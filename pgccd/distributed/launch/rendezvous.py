"""Rendezvous of the ranks of a job through a common store.

Torchrun's store is used where there is one. `init_process_group` does not start from the variables of mpirun or srun,
and reuses the keys of a start before a restart.
"""

from __future__ import annotations

import os
import re
import socket
import threading
import time
import uuid
from dataclasses import dataclass
from datetime import timedelta
from queue import Empty, Queue
from typing import Any

import torch.distributed as dist

from pgccd.distributed.comm.mpi_comm import MpiObjects
from pgccd.distributed.launch.placement import Placement

LOOPBACK = "127.0.0.1"
_POLL_SECONDS = 0.01
# Time after the time-out for torch to report it.
_LATER_SECONDS = 2.0


@dataclass(frozen=True)
class Meeting:
    """The store and address that all ranks share."""

    store: dist.Store
    host: str  #: address of rank 0
    is_local: bool  #: whether that address is reachable from this machine only


def meet(placement: Placement, timeout: float) -> Meeting:
    """Connects all ranks to a store.

    Raises:
        ValueError: naming an environment variable.
        ImportError: mpi4py is needed and not installed.
        RuntimeError: other ranks are missing after `timeout` seconds.
    """
    if placement.launcher == "torchrun":
        run = os.environ.get("TORCHELASTIC_RUN_ID", "run")
        host, port = _variable("MASTER_ADDR"), _port(_variable("MASTER_PORT"))
        common = _connect_store(host, port, placement, timeout, keeps=not agent_keeps_store())
        store = agree_on_start(dist.PrefixStore(f"pgccd/{run}", common), placement, timeout)
        return Meeting(store, host, is_loopback(host) or placement.is_one_machine)
    if placement.launcher == "srun":
        alone = LOOPBACK if placement.is_one_machine else first_host(_variable("SLURM_STEP_NODELIST"))
        host = os.environ.get("MASTER_ADDR") or alone
        # The same on all ranks, and different for other jobs and steps.
        number = 31 * _number("SLURM_JOB_ID") + _number("SLURM_STEP_ID")
        port = _port(os.environ.get("MASTER_PORT", str(20000 + number % 20000)))
        return Meeting(_connect_store(host, port, placement, timeout, keeps=True), host, is_loopback(host))
    return _meet_by_mpi(placement, timeout)


def is_loopback(host: str) -> bool:
    """Whether the address is reachable from this machine only."""
    return host in ("localhost", "::1") or host.startswith("127.")


def agent_keeps_store() -> bool:
    """Whether torchrun's agent, not rank 0, hosts the store, so that it outlives the ranks."""
    return os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"


def agree_on_start(store: dist.Store, placement: Placement, timeout: float) -> dist.Store:
    """A new prefix for this start in a store that earlier starts may have used, so that their keys are not mistaken for
    this one's. Restart counts do not identify a start, since each torchrun agent has its own count.

    Rank 0 answers each rank's request with the prefix, until every rank has joined.
    """
    name = uuid.uuid4().hex
    if placement.rank == 0:
        _welcome(store, placement.size, name, timeout)
        return dist.PrefixStore(name, store)
    store.set(f"asks/{placement.rank}", name)
    try:
        start = store.get(f"start for {name}").decode()
    except dist.DistError as error:
        raise RuntimeError(f"rank 0 did not connect within {timeout:g} s ({error})") from error
    store.set(f"{start}/here/{placement.rank}", "")
    return dist.PrefixStore(start, store)


def _welcome(store: dist.Store, size: int, start: str, timeout: float) -> None:
    """Sends the prefix to all other ranks."""
    deadline = time.monotonic() + timeout
    missing, answered = list(range(1, size)), set()
    while missing:
        for rank in missing:
            if store.check([f"asks/{rank}"]):  # may be from an earlier process, whose successor asks under another name
                asking = store.get(f"asks/{rank}").decode()
                if asking not in answered:
                    store.set(f"start for {asking}", start)
                    answered.add(asking)
        missing = [rank for rank in missing if not store.check([f"{start}/here/{rank}"])]
        if missing and time.monotonic() > deadline:
            raise RuntimeError(f"ranks {missing[:8]} of {size} did not connect within {timeout:g} s")
        time.sleep(_POLL_SECONDS)


def _meet_by_mpi(placement: Placement, timeout: float) -> Meeting:
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
    objects = MpiObjects(world)
    hosts = objects.broadcast(objects.gather(socket.gethostname()))
    host = LOOPBACK if len(set(hosts)) == 1 else os.environ.get("MASTER_ADDR", hosts[0])
    store = None
    if placement.rank == 0:
        store = _connect_store(host, 0, placement, timeout, keeps=True)
    port = objects.broadcast(store.port if store is not None else None)
    return Meeting(store or _connect_store(host, port, placement, timeout, keeps=True), host, is_loopback(host))


def _connect_store(host: str, port: int, placement: Placement, timeout: float, keeps: bool) -> dist.TCPStore:
    common: dict[str, Any] = {"timeout": timedelta(seconds=timeout), "wait_for_workers": False}
    if not (keeps and placement.rank == 0):
        return _join_store(host, port, placement.size, timeout, common)
    if not is_loopback(host):
        return dist.TCPStore(host, port, placement.size, is_master=True, **common)
    # By default torch would listen on all interfaces.
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family, backlog=min(placement.size, 4096))
    except OSError as error:
        raise RuntimeError(f"MASTER_PORT: cannot listen on {host}, port {port}: {error.strerror}") from error
    port = listener.getsockname()[1]
    return dist.TCPStore(host, port, placement.size, is_master=True, master_listen_fd=listener.detach(), **common)


def _join_store(host: str, port: int, size: int, timeout: float, common: dict[str, Any]) -> dist.TCPStore:
    """Connects to rank 0's store. In a thread, because torch waits without a time-out for the answer of a process that
    accepts the connection: if another program listens on this port, forever.
    """
    made: Queue[dist.TCPStore | Exception] = Queue()

    def join() -> None:
        try:
            made.put(dist.TCPStore(host, port, size, is_master=False, **common))
        except Exception as error:
            made.put(error)

    thread = threading.Thread(target=join, name="pgccd-store", daemon=True)
    thread.start()
    try:
        store = made.get(timeout=timeout + _LATER_SECONDS)
    except Empty:
        raise RuntimeError(f"MASTER_PORT: no store answers at {host}, port {port}, within {timeout:g} s") from None
    thread.join()
    if isinstance(store, Exception):
        raise store
    return store


def _variable(name: str) -> str:
    try:
        return os.environ[name]
    except KeyError:
        raise ValueError(f"{name}: not set, though other variables of its launcher are") from None


def _number(name: str) -> int:
    """A variable of Slurm, 0 if it is not set."""
    value = os.environ.get(name, "0")
    if not value.isdecimal():
        raise ValueError(f"{name}: expected a number, got {value!r}")
    return int(value)


def _port(value: str) -> int:
    if not value.isdecimal() or not 0 < int(value) < 1 << 16:
        raise ValueError(f"MASTER_PORT: expected a number below 65536, got {value!r}")
    return int(value)


def first_host(node_list: str) -> str:
    """The first host of Slurm's compressed node list.

    Example:
        >>> first_host("gpu[007-012,020],login1")
        'gpu007'
    """
    found = re.match(r"([^\[,]+)(?:\[([^\],-]+))?", node_list)
    if found is None:
        raise ValueError(f"SLURM_STEP_NODELIST: expected host names, got {node_list!r}")
    return found[1] + (found[2] or "")
