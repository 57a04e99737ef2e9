"""The partition of space in a checkpoint."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from pgccd.checkpoint.files import CheckpointError
from pgccd.checkpoint.stored import Stored
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.launch.agreement import together
from pgccd.distributed.partition.bisection import Bisection
from pgccd.distributed.partition.cells import Cells
from pgccd.distributed.partition.interface import Partition


def partition_header(partition: Partition) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The parameters of a partition, as JSON; and the tensor of its owners or planes, by name."""
    cut: dict[str, Any] = {"lower": list(partition.lower), "upper": list(partition.upper), "ranks": partition.ranks}
    if isinstance(partition, Cells):
        cut |= {"kind": "cells", "subdomains": list(partition.subdomains), "cells": list(partition.cells)}
        return cut, {"owner": partition.owner}
    assert isinstance(partition, Bisection)
    return cut | {"kind": "bisection"}, {"planes": partition.planes}


def stored_kind(stored: Stored) -> str | None:
    """The kind of a checkpoint's partition, if it is known."""
    header = stored.header.get("partition")
    kind = header.get("kind") if isinstance(header, dict) else None
    return kind if isinstance(kind, str) else None


def load_partition(comm: Comm, stored: Stored, uniform: Partition) -> Partition:
    """The partition of a checkpoint, which preserves the balance.

    Args:
        comm: between the ranks.
        stored: the checkpoint.
        uniform: the initial partition; returned if that of the checkpoint has other parameters, such as the number of
            ranks.

    Raises:
        ValueError: the checkpoint is damaged; on all ranks.
    """
    if stored.header.get("partition") != partition_header(uniform)[0]:
        return uniform
    own = together(comm, lambda: stored.shared() if comm.rank == 0 else {})
    shared = {name: comm.broadcast(own.get(name)) for name in comm.broadcast_object(list(own))}

    def restore() -> Partition:
        try:
            if isinstance(uniform, Cells):
                return uniform.with_owner(shared["owner"])
            assert isinstance(uniform, Bisection)
            return uniform.with_planes(shared["planes"])
        except KeyError as error:
            raise CheckpointError(f"{stored.folder}: it has no {error} of its partition") from error
        except ValueError as error:
            raise CheckpointError(f"{stored.folder}: its partition: {error}") from error

    return together(comm, restore)
