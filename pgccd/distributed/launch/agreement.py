"""Agreement at the start: all ranks compare their configurations, and an error of one rank is raised on all.

No launcher or library compares configurations: ranks with different options would hang in their first exchange, or
compute different worlds.
"""

from __future__ import annotations

import functools
import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import torch
import torch.distributed as dist

from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.guard import of_all_ranks
from pgccd.distributed.launch.code import code_facts
from pgccd.distributed.launch.placement import Placement

T = TypeVar("T")


# Keys read from the store at a time, and interval of polling it.
_KEYS_AT_A_TIME, _POLL_SECONDS = 256, 0.02
#: The key under which a rank reports an error instead of settings.
PROBLEM = "problem"


class DisagreementError(ValueError):
    """Ranks were started with different settings; the message names the setting and two ranks.

    Attributes:
        of_all_ranks: True: it is raised on all ranks.
    """

    of_all_ranks = True


def agree_by_store(store: dist.Store, placement: Placement, facts: Mapping[str, str], timeout: float) -> None:
    """Compares the settings of all ranks, using only a store: rank 0 reads the settings of each rank, and writes the
    result for all.

    Args:
        store: shared by all ranks.
        placement: of this rank.
        facts: settings by name; or `PROBLEM`, which ends all ranks.
        timeout: seconds within which all ranks must have called this.

    Raises:
        DisagreementError: on all ranks, with the same message.
        RuntimeError: ranks are missing after the time-out.
    """
    store.set(f"facts/{placement.rank}", json.dumps(dict(facts)))
    if placement.rank == 0:
        store.set("facts/verdict", _compare_all(store, placement.size, timeout))
    try:
        store.wait(["facts/verdict"])
    except dist.DistNetworkError:
        raise
    except dist.DistError as error:
        raise RuntimeError(f"rank 0 did not connect within {timeout:g} s ({error})") from error
    verdict = store.get("facts/verdict").decode(errors="replace")
    store.add("facts/read", 1)
    if verdict:
        if placement.rank == 0:  # rank 0 may host the store
            _wait_until(lambda: store.add("facts/read", 0) >= placement.size, timeout)
        raise DisagreementError(verdict)


def _compare_all(store: dist.Store, size: int, timeout: float) -> str:
    """The first difference or problem; empty if there is none."""
    deadline = time.monotonic() + timeout
    first: dict[str, str] | None = None
    for begin in range(0, size, _KEYS_AT_A_TIME):
        ranks = range(begin, min(size, begin + _KEYS_AT_A_TIME))
        keys = [f"facts/{rank}" for rank in ranks]
        if not _wait_until(functools.partial(store.check, keys), deadline - time.monotonic()):
            missing = [rank for rank, key in zip(ranks, keys, strict=True) if not store.check([key])]
            raise RuntimeError(f"ranks {missing[:8]} of {size} did not connect within {timeout:g} s")
        for rank, text in zip(ranks, store.multi_get(keys), strict=True):
            facts = _facts_of(text)
            if PROBLEM in facts:
                return f"rank {rank}: {facts[PROBLEM]}"
            first = facts if first is None else first
            difference = _difference([first, facts], [0, rank])
            if difference is not None:
                return difference
    return ""


def _facts_of(text: bytes) -> dict[str, str]:
    try:
        facts = json.loads(text)
        return {str(name): str(value) for name, value in facts.items()}
    except (ValueError, RecursionError, AttributeError):  # anybody may write to a store
        return {PROBLEM: "its settings in the store have been overwritten"}


def _wait_until(is_so: Callable[[], bool], seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while not is_so():
        if time.monotonic() > deadline:
            return False
        time.sleep(_POLL_SECONDS)
    return True


def together(comm: Comm, action: Callable[[], T]) -> T:
    """Runs an action on every rank; if it fails on one, it fails on all.

    Raises:
        ValueError: on the other ranks, naming the rank that failed, which raises its own error.

    Example:
        >>> mesh = together(comm, lambda: pgccd.Mesh.load("robot.ply"))
    """
    result, error = None, None
    try:
        result = action()
    except Exception as raised:
        error = raised
    errors = enumerate(comm.gather_objects(None if error is None else str(error)))
    first = comm.broadcast_object(next((f"rank {rank}: {text}" for rank, text in errors if text is not None), None))
    if first is None:
        return result  # type: ignore[return-value]
    raise of_all_ranks(error or ValueError(first))


def on_first(comm: Comm, action: Callable[[], T]) -> T:
    """Runs an action on rank 0 and returns its result, as JSON can represent it, on all ranks; if it fails, it fails on
    all.
    """
    return comm.broadcast_object(together(comm, lambda: action() if comm.rank == 0 else None))


def require_agreement(comm: Comm, facts: Mapping[str, Any]) -> None:
    """Compares the settings of all ranks, and the code that they run (`code_facts`).

    Args:
        comm: between the ranks.
        facts: values identified by their `repr`; long ones are sent as digests.

    Raises:
        DisagreementError: on all ranks.

    Example:
        >>> require_agreement(comm, {"--robots": options.robots, "meshes": digest})
    """
    mine = code_facts() | {name: repr(value) for name, value in facts.items()}
    short = {name: text if len(text) <= 80 else _digest(text) for name, text in mine.items()}
    of_ranks = comm.gather_objects(short)
    difference = comm.broadcast_object(_difference(of_ranks, range(len(of_ranks))))
    if difference is not None:
        raise DisagreementError(difference)


def agree_on_step(comm: Comm, settings: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Compares what ranks ask for in one step: a message of eight bytes a rank, unless they differ.

    Args:
        comm: between the ranks.
        settings: checks the arguments of this rank, and returns those that must be equal, as for `require_agreement`.

    Returns:
        The settings.

    Raises:
        DisagreementError: on all ranks.
        Exception: of `settings`, as by `together`.
    """
    error: Exception | None = None
    try:
        facts = settings()
    except Exception as raised:
        error, facts = raised, {PROBLEM: str(raised)}
    digest = hashlib.sha256(repr(sorted(facts.items())).encode()).digest()[:8]
    mine = torch.tensor([int.from_bytes(digest, "little", signed=True)])
    if bool((comm.all_gather(mine) != mine).any()):
        require_agreement(comm, together(comm, settings))
    if error is not None:
        raise of_all_ranks(error)
    return facts


def _difference(of_ranks: Sequence[Mapping[str, str]], ranks: Sequence[int]) -> str | None:
    """Describes the first setting in which a rank differs from the first rank."""
    for name in sorted(set().union(*of_ranks)):
        values = [facts.get(name, "nothing") for facts in of_ranks]
        for rank, value in zip(ranks, values, strict=True):
            if value != values[0]:
                return f"{name}: rank {ranks[0]} has {values[0]}, rank {rank} has {value}"
    return None


def _digest(text: str) -> str:
    return f"{text[:40]}... ({hashlib.sha256(text.encode()).hexdigest()[:16]})"
