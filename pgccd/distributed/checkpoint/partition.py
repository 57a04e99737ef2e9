"""The partition of space in a checkpoint."""

from __future__ import annotations

import math
from typing import Any

from torch import Tensor

from pgccd import arguments
from pgccd.checkpoint.files import INDEX, CheckpointError, whole_number
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


def _check_header(stored: Stored) -> None:
    """Checks the parameters of a partition: against the files, one per rank, and the size of its table.

    Raises:
        CheckpointError: naming the index and the parameter.
    """
    header = stored.header["partition"]
    path = stored.folder / INDEX
    try:
        ranks, kind = whole_number(header["ranks"]), header["kind"]
        if ranks != len(stored.files):
            raise ValueError(f"ranks: {ranks}, but there are {len(stored.files)} files, one per rank")
        if kind == "cells":
            subdomains, cells = ([whole_number(count) for count in header[name]] for name in ("subdomains", "cells"))
            if len(subdomains) != 3 or len(cells) != 3 or math.prod(subdomains) != ranks:
                raise ValueError(f"subdomains, cells: {subdomains} of {cells} for {ranks} ranks")
            size = 8 * math.prod(subdomains) * math.prod(cells)  # an owner of each cell
        elif kind == "bisection":
            size = 32 * (ranks - 1)  # four numbers of each plane
        else:
            raise ValueError(f"kind: {arguments.describe(kind)}")
        if size > stored.shared_bytes():
            raise ValueError(f"{size} bytes of {kind}, more than its table has")
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, CheckpointError):
            raise
        problem = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise CheckpointError(f"{path} is not the index of a checkpoint: its partition: {problem}") from error


def load_partition(comm: Comm, stored: Stored, uniform: Partition) -> Partition:
    """The partition of a checkpoint, which preserves the balance.

    Args:
        comm: between the ranks.
        stored: the checkpoint.
        uniform: the initial partition. It is returned if the partition in the checkpoint has other parameters, such as
            the number of ranks.

    Raises:
        ValueError: the checkpoint is damaged; on all ranks.
    """
    if stored.header.get("partition") is None:
        return uniform
    together(comm, lambda: _check_header(stored) if comm.rank == 0 else None)
    if stored.header["partition"] != partition_header(uniform)[0]:
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
