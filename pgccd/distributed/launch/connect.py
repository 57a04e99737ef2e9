"""From a launcher to a `Comm`."""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Mapping
from typing import Any, Literal, NoReturn, get_args

import torch
import torch.distributed as dist

from pgccd import arguments
from pgccd.distributed.comm import nccl
from pgccd.distributed.comm.interface import Alone, Comm
from pgccd.distributed.comm.peer_access import read_setting
from pgccd.distributed.comm.torch_comm import NO_TIMEOUT, TorchComm
from pgccd.distributed.guard import Guard, Hub
from pgccd.distributed.guard.channel import join, process_name
from pgccd.distributed.launch.agent import watching_agent
from pgccd.distributed.launch.agreement import PROBLEM, agree_by_store
from pgccd.distributed.launch.code import code_facts
from pgccd.distributed.launch.existing import of_group, require_usable
from pgccd.distributed.launch.interfaces import interface_of, is_loopback
from pgccd.distributed.launch.placement import Placement, find_placement
from pgccd.distributed.launch.rendezvous import LOOPBACK, Meeting, meet, naming
from pgccd.distributed.launch.token import VARIABLE as TOKEN
from pgccd.distributed.launch.token import share_token

Transport = Literal["auto", "nccl", "gloo", "torch-mpi", "mpi4py"]
TRANSPORTS: tuple[str, ...] = get_args(Transport)
DEFAULT_TIMEOUT = 300.0
# Time for the hub to handle what ranks have sent before they agreed.
_JOINED_SECONDS = 10.0
# Environment variables by which Gloo and NCCL choose an interface.
_INTERFACES = ("GLOO_SOCKET_IFNAME", "NCCL_SOCKET_IFNAME")


def choose_device(device: str | torch.device, placement: Placement | None = None) -> torch.device:
    """The device of this rank: for "cuda" the GPU with the local rank of this process.

    Args:
        device: "cpu", "cuda" or a device of torch.
        placement: of the ranks on machines; default: from the launcher's environment.
    """
    chosen = torch.device(device)
    placement = placement or find_placement()
    if chosen.type == "cuda" and chosen.index is None and placement.size > 1:
        return torch.device("cuda", placement.local_rank % max(1, torch.cuda.device_count()))
    return chosen


def connect(
    device: str | torch.device = "cpu",
    transport: Transport = "auto",
    timeout: float = DEFAULT_TIMEOUT,
    settings: Mapping[str, str] | None = None,
    group: dist.ProcessGroup | None = None,
) -> Comm:
    """Connects all processes that were launched together, or those of a process group of torch.distributed. Without a
    launcher there is a single rank.

    Args:
        device: of the data.
        transport: "nccl", "gloo", "torch-mpi" (torch's MPI backend, if it was built with one), "mpi4py", or "auto":
            NCCL if every rank has a GPU of its own, else Gloo.
        timeout: seconds after which a pending exchange ends the job.
        settings: of the program, by name. They are compared between ranks first, together with the arguments above.
        group: a process group whose ranks all call this; it is not destroyed by `Comm.close`. Default: the default
            process group if it has been initialised, else a new one. The group's own time-out ends exchanges too: give
            it a long one, so that the guard can name the rank at fault.

    Raises:
        DisagreementError: ranks have different settings; on all of them.
        TypeError, ValueError: naming the argument or environment variable.
        ImportError: mpi4py is needed and not installed.
        RuntimeError: other ranks are missing after the time-out.

    Example:
        >>> with pgccd.distributed.connect() as comm:
        ...     print(comm.rank, comm.size)
    """
    if transport not in TRANSPORTS:
        raise ValueError(f"transport: expected one of {list(TRANSPORTS)}, got {transport!r}")
    if not 0.0 < timeout < 1e9:
        raise ValueError(f"timeout: expected seconds > 0, got {timeout}")
    if group is not None or dist.is_initialized():
        return _connect_group(group or dist.group.WORLD, device, transport, timeout, settings or {})
    placement = find_placement()
    if placement.size == 1:
        arguments.device(device)
        return Alone()
    try:
        device = choose_device(device, placement)
    except RuntimeError as error:
        tell_problem(f"device: {error}", timeout)
    try:
        read_setting()
        _require_interfaces()
        if transport == "nccl" and not (dist.is_nccl_available() and torch.cuda.is_available()):
            raise ValueError("transport: 'nccl' needs a GPU and a torch that was built with NCCL")
    except ValueError as error:
        tell_problem(str(error), timeout)
    with watching_agent(placement.rank):
        meeting = meet(placement, timeout)
        with naming(meeting.at):
            own = {**code_facts(), "device": device.type, "transport": transport, "timeout": f"{timeout:g}"}
            own[TOKEN] = "a value" if os.environ.get(TOKEN) else "none"  # not compared: it would pass through the store
            agree_by_store(meeting.store, placement, {**own, **(settings or {})}, timeout)
            if device.type == "cuda" and torch.cuda.is_available():
                torch.cuda.set_device(device)
            guard = _start_guard_on_all(meeting, placement, timeout)
    with naming(meeting.at):
        control = _make_groups(guard, meeting.store, transport, device, placement, timeout)
    comm: Comm
    if transport == "mpi4py":
        from pgccd.distributed.comm.mpi_comm import MpiComm

        comm = MpiComm(control, guard, dist.destroy_process_group)
    else:
        comm = TorchComm(dist.group.WORLD, control, guard, dist.destroy_process_group)
    return comm


def _make_groups(
    guard: Guard,
    store: dist.Store,
    transport: Transport,
    device: torch.device,
    placement: Placement,
    timeout: float,
) -> dist.ProcessGroup | None:
    """The default process group; returns the one of Gloo, for the host's messages."""
    backend = _backend(transport, device, placement, store)
    with guard.waiting("connection"):
        if backend == "nccl":
            guard.is_broken = nccl.make_default_group(store, placement.rank, placement.size, timeout)
        else:
            dist.init_process_group(
                backend, store=store, rank=placement.rank, world_size=placement.size, timeout=NO_TIMEOUT
            )
        return dist.group.WORLD if backend == "gloo" else dist.new_group(backend="gloo", timeout=NO_TIMEOUT)


def _connect_group(
    group: Any, device: str | torch.device, transport: Transport, timeout: float, settings: Mapping[str, str]
) -> Comm:
    backend = require_usable(group, transport)
    if dist.get_world_size(group) == 1:
        return Alone()
    read_setting()
    facts = {"device": torch.device(device).type, "transport": transport, "timeout": f"{timeout:g}", **settings}
    facts[TOKEN] = "a value" if os.environ.get(TOKEN) else "none"
    comm, meeting, placement = of_group(group, backend, timeout, facts)
    comm.guard = _start_guard_on_all(meeting, placement, timeout)
    comm.kept = meeting.store  # other ranks may still read it
    return comm


def _require_interfaces() -> None:
    """Raises ValueError if GLOO_SOCKET_IFNAME names an interface that this machine does not have."""
    there = [name for _, name in socket.if_nameindex()]
    for name in filter(None, os.environ.get("GLOO_SOCKET_IFNAME", "").split(",")):
        if name not in there:
            raise ValueError(
                f"GLOO_SOCKET_IFNAME: {socket.gethostname()} has no interface {name!r}, but {', '.join(there)}"
            )


def tell_problem(problem: str, timeout: float = DEFAULT_TIMEOUT) -> NoReturn:
    """Called instead of `connect` by a rank that failed: all ranks that call either function raise the error.

    Args:
        problem: one line.
        timeout: seconds within which all ranks must have called.

    Raises:
        DisagreementError: with the problem of the first rank that reported one.
    """
    placement = find_placement()
    agree_by_store(meet(placement, timeout).store, placement, {PROBLEM: problem}, timeout)
    raise AssertionError("expected an error on all ranks")


def _start_guard_on_all(meeting: Meeting, placement: Placement, timeout: float) -> Guard:
    """The guard. If the hub rejects a rank, the other ranks fail too instead of waiting for it."""
    guard, problem = None, {}
    try:
        guard = _start_guard(meeting, placement, timeout)
    except RuntimeError as error:
        problem = {PROBLEM: str(error)}
    try:
        agree_by_store(dist.PrefixStore("guard", meeting.store), placement, problem, timeout)
    except BaseException:
        if guard is not None:
            guard.close()
        raise
    assert guard is not None
    _require_all(guard, placement)
    _use_interface(guard, meeting, placement)
    return guard


def _start_guard(meeting: Meeting, placement: Placement, timeout: float) -> Guard:
    token = share_token(meeting.store, placement, timeout)
    host, hub = LOOPBACK if meeting.is_local or placement.rank == 0 else meeting.host, None
    if placement.rank == 0:
        hub = Hub(LOOPBACK if meeting.is_local else "", token, placement.size, timeout)
        meeting.store.set("guard/port", str(hub.port))
    text = meeting.store.get("guard/port").decode(errors="replace")
    if not re.fullmatch("[0-9]{1,5}", text) or not 0 < int(text) < 1 << 16:  # anybody may write to a store
        raise RuntimeError(f"guard: the port of rank 0 in the store has been overwritten with {text[:40]!r}")
    port = int(text)
    who = {"rank": placement.rank, "name": process_name()}
    return Guard(join((host, port), token, who, timeout), placement.rank, timeout, hub)


def _require_all(guard: Guard, placement: Placement) -> None:
    """Rank 0 goes on only when all ranks have proved to the hub that they belong to the job.

    Raises:
        RuntimeError: a process without the token is in the place of a rank.
    """
    if guard.hub is not None and not guard.hub.is_complete.wait(_JOINED_SECONDS):
        missing = guard.hub.missing()
        raise RuntimeError(
            f"guard: ranks {missing[:8]} of {placement.size} have not proved that they belong to the job"
        )


def _use_interface(guard: Guard, meeting: Meeting, placement: Placement) -> None:
    """Makes Gloo and NCCL use the interface of the guard's connection, unless another one is configured. By themselves
    Gloo and NCCL look up the machine's name, which may be unknown, or belong to the loopback interface (127.0.1.1 on
    Debian).
    """
    if meeting.is_local:
        _keep_to_this_machine()
        return
    if guard.hub is not None:  # all ranks have joined
        meeting.store.set("guard/address", guard.hub.outer_address or "")
    address = guard.address
    # Ranks on the machine of rank 0 use the interface by which the others reach it.
    if placement.rank == 0 or is_loopback(address):
        address = meeting.store.get("guard/address").decode(errors="replace")
    interface = interface_of(address) if address else None
    if interface is not None:
        for name in _INTERFACES:
            os.environ.setdefault(name, interface)


def _keep_to_this_machine() -> None:
    """Makes Gloo and NCCL listen on the loopback interface only, unless another one is configured."""
    if any(name == "lo" for _, name in socket.if_nameindex()):
        for name in _INTERFACES:
            os.environ.setdefault(name, "lo")


def _backend(transport: Transport, device: torch.device, placement: Placement, store: dist.Store) -> str:
    if transport == "mpi4py":
        return "gloo"  # for agreement and checkpoints
    if transport == "torch-mpi":
        if not dist.is_mpi_available():
            raise ValueError("transport: this torch was built without MPI; use mpi4py")
        return "mpi"
    if transport != "auto":
        return transport
    # NCCL needs a separate GPU for every rank; rank 0 decides for all.
    keys = [f"device/{rank}" for rank in range(placement.size)]
    # The GPU's UUID: if each rank sees one GPU only, all of them call it cuda:0.
    has_gpu = device.type == "cuda" and torch.cuda.is_available()
    store.set(keys[placement.rank], str(torch.cuda.get_device_properties(device).uuid) if has_gpu else "none")
    if placement.rank == 0:
        store.wait(keys)
        devices = store.multi_get(keys)
        usable = b"none" not in devices and len(set(devices)) == len(devices)
        store.set("device/backend", "nccl" if usable and dist.is_nccl_available() else "gloo")
    return store.get("device/backend").decode()
