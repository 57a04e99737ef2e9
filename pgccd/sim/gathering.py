"""A sample of the robots of all ranks on rank 0, for pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from pgccd.contacts.contacts import Contacts
from pgccd.distributed.comm.exchange import Columns, make_route, take_rows
from pgccd.distributed.comm.interface import Comm
from pgccd.sim.model import RobotState
from pgccd.sim.response import respond
from pgccd.sim.step import Step


def gather_columns(comm: Comm, columns: Columns) -> Columns:
    """All ranks' rows on rank 0, ordered by rank; none on the others."""
    first = next(iter(columns.values()))
    rows = torch.arange(len(first), device=first.device)
    return make_route(comm, rows, torch.zeros_like(rows)).forward(columns).wait()


def gather_sample(
    comm: Comm, state: RobotState, steps: Sequence[Step] = (), one_in: int = 1
) -> tuple[RobotState, list[Step]]:
    """An even sample of the robots on rank 0, by ascending id; no robots on other ranks. If the steps that led to this
    state are given, they are gathered too, with those contacts whose first robot is in the sample; the second robots of
    these contacts are added.

    Args:
        comm: between the ranks.
        state: of this rank's robots.
        steps: the last steps, if they were eager; only one if a sample is taken.
        one_in: robots whose id is a multiple of this are in the sample.
    """
    if comm.size == 1 and one_in == 1:
        return state, list(steps)
    if steps:
        gathered = [_gather_step(comm, step, one_in) for step in steps]
        return gathered[-1].after, gathered
    return RobotState(**_gather_robots(comm, state.columns, one_in, torch.empty(0, dtype=torch.int64))), []


def _gather_robots(comm: Comm, columns: Columns, one_in: int, ids: Tensor) -> Columns:
    """The robots of the sample, and those with these ids."""
    id = columns["id"]
    chosen = torch.nonzero((id % one_in == 0) | torch.isin(id, ids.to(id.device)))[:, 0]
    gathered = gather_columns(comm, take_rows(columns, chosen))
    return take_rows(gathered, torch.argsort(gathered["id"]))


def _gather_step(comm: Comm, step: Step, one_in: int) -> Step:
    assert step.share is not None
    found = step.contacts
    columns = found.columns
    columns["pairs"] = step.share.held.id[found.pairs]
    contacts = gather_columns(comm, take_rows(columns, torch.nonzero(columns["pairs"][:, 0] % one_in == 0)[:, 0]))
    ids = torch.empty(0, dtype=torch.int64)
    if one_in > 1:
        ids = comm.broadcast(contacts["pairs"].unique())
    moved = step.before.columns | {"fraction": step.resolution.fraction[: len(step.before)].contiguous()}
    before = _gather_robots(comm, moved, one_in, ids)
    resolution = replace(step.resolution, fraction=before.pop("fraction"))
    contacts["pairs"] = torch.searchsorted(before["id"], contacts["pairs"])
    order = torch.argsort(contacts["pairs"][:, 0] * max(1, len(before["id"])) + contacts["pairs"][:, 1])
    rows: dict[str, Any] = take_rows(contacts, order)
    whole = Contacts(**rows, stats=found.stats)
    planned = RobotState(**before)
    after = respond(planned, resolution.fraction)
    return Step(step.index, planned, resolution, after, lambda: whole, lambda: step.record)
