"""A sample of the robots of all ranks on rank 0, for pictures."""

from __future__ import annotations

from dataclasses import replace

import torch

from pgccd.detection.contacts import Contacts
from pgccd.distributed.comm.exchange import Columns, make_route, take_rows
from pgccd.distributed.comm.interface import Comm
from pgccd.sim.distributed.simulation import RankStep
from pgccd.sim.model import RobotState
from pgccd.sim.step import Step


def gather_columns(comm: Comm, columns: Columns) -> Columns:
    """All ranks' rows on rank 0, ordered by rank; none on the others."""
    first = next(iter(columns.values()))
    rows = torch.arange(len(first), device=first.device)
    return make_route(comm, rows, torch.zeros_like(rows)).forward(columns).wait()


def gather_sample(
    comm: Comm, state: RobotState, step: RankStep | None = None, one_in: int = 1
) -> tuple[RobotState, Step | None]:
    """An even sample of the robots on rank 0, by ascending id; none on the others. With the step that led to this
    state, also its contacts whose first robot is in the sample; the other robots of these are added.

    Args:
        comm: between the ranks.
        state: of this rank's robots.
        step: the last step, if it was eager.
        one_in: robots whose id is a multiple of this are in the sample.
    """
    contacts, ids = None, torch.empty(0, dtype=torch.int64)
    if step is not None:
        found = step.share.contacts
        columns = found.columns
        columns["pairs"] = step.share.held.id[found.pairs]
        contacts = gather_columns(comm, take_rows(columns, torch.nonzero(columns["pairs"][:, 0] % one_in == 0)[:, 0]))
        ids = comm.broadcast(contacts["pairs"].unique() if one_in > 1 else ids)

    def gather(columns: Columns) -> Columns:
        id = columns["id"]
        chosen = torch.nonzero((id % one_in == 0) | torch.isin(id, ids.to(id.device)))[:, 0]
        gathered = gather_columns(comm, take_rows(columns, chosen))
        return take_rows(gathered, torch.argsort(gathered["id"]))

    after = RobotState(**gather(state.columns))
    if step is None or contacts is None:
        return after, None
    before = gather(step.before.columns | {"fraction": step.resolution.fraction[: len(step.before)].contiguous()})
    resolution = replace(step.resolution, fraction=before.pop("fraction"))
    contacts["pairs"] = torch.searchsorted(before["id"], contacts["pairs"])
    order = torch.argsort(contacts["pairs"][:, 0] * max(1, len(before["id"])) + contacts["pairs"][:, 1])
    whole = Contacts(**take_rows(contacts, order), stats=step.share.contacts.stats)
    return after, Step(step.index, RobotState(**before), resolution, after, lambda: whole, lambda: step.record)
