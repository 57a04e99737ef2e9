"""Ranks that are the processes of an existing process group of torch.distributed, started by any launcher."""

from __future__ import annotations

import socket
from collections.abc import Mapping

import torch.distributed as dist

from pgccd.distributed.comm.torch_comm import NO_TIMEOUT, TorchComm
from pgccd.distributed.launch.agreement import require_agreement
from pgccd.distributed.launch.placement import Placement
from pgccd.distributed.launch.rendezvous import Meeting, meet_at_first

BACKENDS = ("gloo", "nccl", "mpi")


def require_usable(group: dist.ProcessGroup, transport: str) -> str:
    """The backend of a group.

    Raises:
        TypeError: it is no process group, or this process is not in it.
        ValueError: it has another backend than pgccd can use, or than `transport`.
    """
    if not isinstance(group, dist.ProcessGroup):
        raise TypeError(f"group: expected a process group of this process, got {type(group).__name__}")
    backend = dist.get_backend(group)
    if backend not in BACKENDS:
        raise ValueError(f"group: expected one of backend {', '.join(BACKENDS)}, got {backend!r}")
    asked = {"torch-mpi": "mpi"}.get(transport, transport)
    if asked not in ("auto", backend):
        raise ValueError(f"transport: the group has backend {backend!r}, got {transport!r}; leave it out")
    return backend


def of_group(
    group: dist.ProcessGroup, backend: str, timeout: float, facts: Mapping[str, str]
) -> tuple[TorchComm, Meeting, Placement]:
    """A connection over the group, without a guard; and where its ranks meet to start one. All ranks of the group call
    it. The group remains the caller's.

    Raises:
        DisagreementError: ranks have different facts; on all of them.
        RuntimeError: rank 0 cannot be reached.
    """
    ranks = dist.get_process_group_ranks(group)
    control = None
    if backend != "gloo":
        control = dist.new_group(ranks, backend="gloo", use_local_synchronization=True, timeout=NO_TIMEOUT)
    comm = TorchComm(group, control)
    require_agreement(comm, facts)
    hosts = comm.broadcast_object(comm.gather_objects(socket.gethostname()))
    is_local = len(set(hosts)) == 1
    placement = Placement("a process group", comm.rank, comm.size, hosts[: comm.rank].count(hosts[comm.rank]), is_local)
    return comm, meet_at_first(comm.broadcast_object, placement, is_local, timeout), placement
