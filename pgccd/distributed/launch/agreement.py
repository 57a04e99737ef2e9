"""All ranks start alike, or none: configurations are compared, and what one rank alone cannot do fails on all."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import torch

import pgccd
from pgccd.distributed.comm.interface import Comm

T = TypeVar("T")


class DisagreementError(ValueError):
    """Ranks were started with different settings; the message names the setting and two ranks."""


def together(comm: Comm, action: Callable[[], T]) -> T:
    """Does something on every rank; if it fails on one, it fails on all.

    Raises:
        ValueError: naming the rank that failed, on the others; on itself, its own error.

    Example:
        >>> mesh = together(comm, lambda: pgccd.Mesh.load("robot.ply"))
    """
    result, error = None, None
    try:
        result = action()
    except Exception as raised:
        error = raised
    errors = comm.gather_objects(None if error is None else str(error))
    if error is not None:
        raise error
    for rank, other in enumerate(errors):
        if other is not None:
            raise ValueError(f"rank {rank}: {other}")
    return result  # type: ignore[return-value]


def on_first(comm: Comm, action: Callable[[], T]) -> T:
    """Does something on rank 0 and gives all ranks its (picklable) result; if it fails, it fails on all."""
    return comm.broadcast_object(together(comm, lambda: action() if comm.rank == 0 else None))


def require_agreement(comm: Comm, facts: Mapping[str, Any]) -> None:
    """Compares what all ranks were started with; the versions of pgccd and torch are added.

    Args:
        comm: between the ranks.
        facts: values whose `repr` identifies them; only digests are sent, so they may be long.

    Raises:
        DisagreementError: on all ranks.

    Example:
        >>> require_agreement(comm, {"--robots": options.robots, "meshes": digest})
    """
    mine = {"pgccd": pgccd.__version__, "torch": torch.__version__, "machine": platform.machine()}
    mine |= {name: repr(value) for name, value in facts.items()}
    short = {name: text if len(text) <= 80 else _digest(text) for name, text in mine.items()}
    of_all_ranks = comm.gather_objects(short)
    for name in sorted(set().union(*of_all_ranks)):
        values = [facts_of_rank.get(name, "nothing") for facts_of_rank in of_all_ranks]
        for rank, value in enumerate(values):
            if value != values[0]:
                raise DisagreementError(f"{name}: rank 0 has {values[0]}, rank {rank} has {value}")


def _digest(text: str) -> str:
    return f"{text[:40]}... ({hashlib.sha256(text.encode()).hexdigest()[:16]})"
