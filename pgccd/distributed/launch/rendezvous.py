"""Rendezvous of the ranks of a job through a common store.

Torchrun's store is used where there is one. `init_process_group` alone does not suffice: it does not read the variables
of mpirun or srun, and after a restart it reuses the keys of the start before.
"""

from __future__ import annotations

import json
import os
import re
import socket
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from queue import Empty, Queue
from typing import Any

import torch.distributed as dist

from pgccd.distributed.comm.mpi_comm import MpiObjects
from pgccd.distributed.launch.interfaces import addresses, is_loopback, outer_addresses, plain
from pgccd.distributed.launch.placement import Placement
from pgccd.distributed.launch.private_files import folders, read_private, refresh, write_private

LOOPBACK = "127.0.0.1"
_POLL_SECONDS = 0.01
# Time after the time-out for torch to report it.
_LATER_SECONDS = 2.0
# Time for a connection, for a store to answer on it, and until the user is told what this rank waits for.
_REACH_SECONDS, _STORE_SECONDS, _TOLD_AFTER = 5.0, 25.0, 10.0


@dataclass(frozen=True)
class Meeting:
    """The store and address that all ranks share."""

    store: dist.Store
    host: str  #: address of rank 0
    is_local: bool  #: whether that address is reachable from this machine only
    at: str  #: where the store is, for messages


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
        with naming(at := f"{host}, port {port} (MASTER_ADDR, MASTER_PORT)"):
            common = connect_store(host, port, placement, timeout, keeps=not agent_keeps_store())
            store = agree_on_start(dist.PrefixStore(f"pgccd/{run}", common), placement, timeout)
        return Meeting(store, host, is_loopback(host) or placement.is_one_machine, at)
    if placement.launcher == "srun":
        return _meet_by_srun(placement, timeout)
    return _meet_by_mpi(placement, timeout)


def agent_keeps_store() -> bool:
    """Whether torchrun's agent, not rank 0, hosts the store, so that it outlives the ranks."""
    return os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"


@contextmanager
def naming(at: str) -> Iterator[None]:
    """Raises RuntimeError that names MASTER_ADDR if the connection to the store is lost meanwhile.

    Args:
        at: where the store is.
    """
    try:
        yield
    except dist.DistNetworkError as error:
        keeper = "torchrun's agent there" if agent_keeps_store() else "rank 0"
        reason = str(error).splitlines()[0]
        raise RuntimeError(f"MASTER_ADDR: the store at {at} is lost: {keeper} has died ({reason})") from error


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
    except dist.DistNetworkError:
        raise
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


def _meet_by_srun(placement: Placement, timeout: float) -> Meeting:
    """At MASTER_PORT or a port that Slurm has reserved for the step; else rank 0 takes any free port, and tells it in a
    private file.
    """
    name = f"step-{os.environ.get('SLURM_CLUSTER_NAME', 'slurm')}-{_number('SLURM_JOB_ID')}.{_number('SLURM_STEP_ID')}"
    host = os.environ.get("MASTER_ADDR") or (LOOPBACK if placement.is_one_machine else None)
    given = os.environ.get("MASTER_PORT") or os.environ.get("SLURM_STEP_RESV_PORTS", "").partition("-")[0]
    if given:
        host, port = host or first_host(_variable("SLURM_STEP_NODELIST")), _port(given)
        with naming(at := f"{host}, port {port} (MASTER_ADDR, MASTER_PORT)"):
            return Meeting(connect_store(host, port, placement, timeout, keeps=True), host, is_loopback(host), at)
    file = _AddressFile(re.sub(r"[^\w.-]", "_", name))
    if placement.rank != 0:
        host, port = file.wait(timeout)
        with naming(at := f"{host}, port {port}"):
            store: dist.Store = connect_store(host, port, placement, timeout, keeps=True)
            return Meeting(agree_on_start(store, placement, timeout), host, is_loopback(host), at)
    hosts = [host] if host else [first_host(_variable("SLURM_STEP_NODELIST")), *outer_addresses()]
    kept = connect_store(hosts[0], 0, placement, timeout, keeps=True)
    with file.published(hosts, kept.port):
        store = agree_on_start(kept, placement, timeout)
    return Meeting(store, hosts[0], is_loopback(hosts[0]), f"{hosts[0]}, port {kept.port}")


class _AddressFile:
    """A private file with rank 0's address, in a folder that all machines share.

    Args:
        name: the same on all ranks; of no other step that runs now.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    @contextmanager
    def published(self, hosts: Sequence[str], port: int) -> Iterator[None]:
        """Rank 0: a context in which the file exists.

        Raises:
            RuntimeError: it cannot be written.
        """
        path = write_private(json.dumps([list(hosts), port]).encode(), self._name)
        if path is None:
            raise RuntimeError(f"MASTER_PORT: not set, and rank 0 cannot tell its port in {folders()[0]}")
        try:
            yield
        finally:
            path.unlink(missing_ok=True)

    def wait(self, timeout: float) -> tuple[str, int]:
        """Other ranks: the first address of rank 0 that can be reached. The file may be left from an earlier start of
        the step: then nothing answers, and the file is read again.

        Raises:
            RuntimeError: after `timeout` seconds.
        """
        deadline, reason = time.monotonic() + timeout, "there is no such file"
        while time.monotonic() < deadline:
            for folder in folders():
                refresh(folder)
                hosts, port = self._content(folder)
                for host in hosts:
                    try:
                        socket.create_connection((host, port), timeout=_REACH_SECONDS).close()
                        return host, port
                    except OSError as error:
                        reason = f"{host}, port {port}: {error.strerror or error}"
            time.sleep(10 * _POLL_SECONDS)
        where = f"{folders()[0] / self._name} on {socket.gethostname()}"
        raise RuntimeError(
            f"MASTER_PORT: not set, and {where} does not lead to rank 0 within {timeout:g} s ({reason}): set "
            "MASTER_PORT (and MASTER_ADDR) to a free port of rank 0's machine if the machines share no home folder"
        )

    def _content(self, folder: Path) -> tuple[list[str], int]:
        try:
            hosts, port = json.loads(read_private(folder / self._name))
            return [str(host) for host in hosts], int(port)
        except (ValueError, TypeError, RecursionError):  # it is not there, or is none
            return [], 0


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
    names = objects.broadcast(objects.gather(socket.gethostname()))
    return meet_at_first(objects.broadcast, placement, len(set(names)) == 1, timeout, os.environ.get("MASTER_ADDR"))


def meet_at_first(
    broadcast: Callable[[Any], Any],
    placement: Placement,
    is_one_machine: bool,
    timeout: float,
    address: str | None = None,
) -> Meeting:
    """At a free port of rank 0, which tells it and the addresses of its machine, or the one given, by a broadcast.

    Raises:
        RuntimeError: rank 0 cannot be reached, naming MASTER_ADDR.
    """
    hosts = [address] if address else [socket.gethostname(), *outer_addresses()]
    hosts = [LOOPBACK] if is_one_machine else hosts
    store, where = None, None
    if placement.rank == 0:
        store = connect_store(hosts[-1], 0, placement, timeout, keeps=True)
        where = [hosts, store.port]
    hosts, port = broadcast(where)
    if store is not None:
        return Meeting(store, hosts[0], is_one_machine, f"{hosts[0]}, port {port}")
    for host in hosts:
        with suppress(OSError), naming(at := f"{host}, port {port}"):
            socket.create_connection((host, port), timeout=_REACH_SECONDS).close()
            return Meeting(connect_store(host, port, placement, timeout, keeps=True), host, is_one_machine, at)
    raise RuntimeError(f"MASTER_ADDR: rank 0 cannot be reached at {' or '.join(hosts)}, port {port}")


def connect_store(host: str, port: int, placement: Placement, timeout: float, keeps: bool) -> dist.TCPStore:
    """The store of all ranks.

    Args:
        host, port: of rank 0; port 0: any free one.
        placement: of this rank.
        timeout: seconds, also of the store's own.
        keeps: whether rank 0 hosts it.

    Raises:
        RuntimeError: naming MASTER_ADDR or MASTER_PORT.
    """
    common: dict[str, Any] = {"timeout": timedelta(seconds=timeout), "wait_for_workers": False}
    if not (keeps and placement.rank == 0):
        return _join_store(host, port, placement.size, timeout, common)
    # By default torch listens on all interfaces.
    try:
        if not is_loopback(host):
            if "MASTER_ADDR" in os.environ:
                _require_own(host)
            return dist.TCPStore(LOOPBACK, port, placement.size, is_master=True, **common)
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listener = socket.create_server((host, port), family=family, backlog=min(placement.size, 4096))
    except (OSError, dist.DistError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise RuntimeError(f"MASTER_PORT: cannot listen on {host}, port {port}: {reason}") from error
    port = listener.getsockname()[1]
    return dist.TCPStore(host, port, placement.size, is_master=True, master_listen_fd=listener.detach(), **common)


def _require_own(host: str) -> None:
    """Raises RuntimeError if MASTER_ADDR is not an address of this machine, on which rank 0 runs."""
    here, resolved = socket.gethostname(), set()
    with suppress(OSError):
        resolved = {plain(str(info[4][0])) for info in socket.getaddrinfo(host, None)}
    is_own = any(is_loopback(address) for address in resolved) or bool(resolved & set(addresses()))
    if resolved and host != here and not is_own:
        raise RuntimeError(f"MASTER_ADDR: {host} is no address of {here}, on which rank 0 runs")


def _join_store(host: str, port: int, size: int, timeout: float, common: dict[str, Any]) -> dist.TCPStore:
    """Connects to rank 0's store. In a thread, because torch waits without a time-out for the answer of a process that
    accepts the connection: if another program listens on this port, forever.
    """
    _wait_until_reached(host, port, timeout)
    made: Queue[dist.TCPStore | Exception] = Queue()

    def join() -> None:
        try:
            made.put(dist.TCPStore(host, port, size, is_master=False, **common))
        except Exception as error:
            made.put(error)

    thread = threading.Thread(target=join, name="pgccd-store", daemon=True)
    thread.start()
    patience = min(timeout, _STORE_SECONDS)
    try:
        store = made.get(timeout=patience + _LATER_SECONDS)
    except Empty:
        why = "another program listens there, or MASTER_ADDR is not rank 0's machine"
        raise RuntimeError(
            f"MASTER_PORT: no store answers at {host}, port {port}, within {patience:g} s: {why}"
        ) from None
    thread.join()
    if isinstance(store, Exception):
        raise store
    return store


def _wait_until_reached(host: str, port: int, timeout: float) -> None:
    """Returns once a process listens there.

    Raises:
        RuntimeError: nothing listens after `timeout` seconds; or there is no such machine, sooner.
    """
    begin, is_told = time.monotonic(), False
    while True:
        try:
            socket.create_connection((host, port), timeout=_REACH_SECONDS).close()
            return
        except OSError as error:
            reason, is_refused = error.strerror or str(error), isinstance(error, ConnectionRefusedError)
        at = f"{host}, port {port} (MASTER_ADDR, MASTER_PORT): {reason}"
        waited = time.monotonic() - begin
        # Rank 0 may start later, but its machine does not move.
        if waited > timeout or (not is_refused and waited > _STORE_SECONDS - _REACH_SECONDS):
            raise RuntimeError(f"MASTER_ADDR: rank 0 cannot be reached at {at}, for {waited:.0f} s")
        if waited > _TOLD_AFTER and not is_told:
            is_told = True
            sys.stderr.write(f"pgccd: rank 0 is not yet reached at {at}\n")
            sys.stderr.flush()
        time.sleep(10 * _POLL_SECONDS)


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
    if not re.fullmatch("[0-9]{1,5}", value) or not 0 < int(value) < 1 << 16:
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
