"""Replayed steps of a `World` in which contacts may be missing: a response reads contact at the start of the step on
every rank, whichever rank lost them; the step is repeated.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any
from unittest import mock

import pytest
import torch
from support.cases import mostly_slow
from support.graphs import graphs_on
from support.peer_messages import OverConnection
from support.ranks import RankPool
from torch import Tensor

import pgccd
from distributed.world.test_loop import motion, plain_loop, response, spread
from pgccd.distributed import Bodies, CapturedWorld, Comm
from pgccd.distributed.comm.interface import Alone
from pgccd.distributed.detection.share import search_share
from pgccd.distributed.world import world_graphs as captured_world
from pgccd.runtime.sizes import COUNT_ROWS, overflow_flags

STEPS, LOST = 12, 6


def lose(comm: Comm, device: str, where: str, loser: int, over_peers: bool) -> tuple[list[bool], int]:
    """Runs a loop in which one rank loses contacts in step LOST. Returns whether all toi were 0 in each call of the
    response for that step, and the number of replays.
    """
    expected, _ = plain_loop(STEPS)
    seen: list[bool] = []
    now, is_loser = torch.zeros(1, dtype=torch.int64, device=device), comm.rank == loser

    def flags(counts: Tensor) -> list[Tensor]:
        counts = counts.clone()
        if is_loser:
            counts[COUNT_ROWS[f"{where}_overflow"]] += now[0] == LOST
        return overflow_flags(counts)

    def searched(*given: Any, **options: Any) -> Any:
        share, made = search_share(*given, **options)
        return replace(share, overflow=share.overflow + is_loser * (now == LOST).to(torch.int64)), made

    def noted(bodies: Bodies) -> pgccd.RigidMotion:
        nonlocal now
        now = bodies.step
        return motion(bodies)

    def answer(bodies: Bodies, moving: pgccd.RigidMotion, first_toi: Tensor) -> dict[str, Tensor]:
        if device == "cpu" and int(bodies.step) == LOST:
            seen.append(bool((first_toi == 0.0).all()))
        return response(bodies, moving, first_toi)

    with graphs_on(device) as stack:
        name, replacement = ("search_share", searched) if where == "halo" else ("overflow_flags", flags)
        stack.enter_context(mock.patch.object(captured_world, name, replacement))
        if over_peers:
            stack.enter_context(mock.patch.object(comm, "peer_messages", OverConnection(comm)))
        world = spread(comm, torch.device(device), "none", "cells")
        steps = CapturedWorld(world, noted, answer, True).run(STEPS)
        rows = torch.div(world.id.cpu() - 1, 3, rounding_mode="floor")
        for name, column in {"position": world.position, **world.payload}.items():
            assert torch.equal(column.cpu(), expected[name][rows]), name
    return seen, sum(made.replayed for made in steps)


CASES = [(where, over_peers) for where in ("pairs", "traverse", "contacts", "halo") for over_peers in (False, True)]
#: Each place, each way of messages.
QUICK = [("pairs", True), ("traverse", False), ("contacts", True), ("halo", False)]


@pytest.mark.parametrize(("where", "over_peers"), mostly_slow(CASES, QUICK))
def test_lost_on_one_rank(ranks: RankPool, where: str, over_peers: bool) -> None:
    for seen, replayed in ranks.run(2, lose, "cpu", where, 1, over_peers):
        assert seen[0] is True and seen[-1] is False  # in the graph; repeated eagerly
        assert replayed > 3


def test_alone(device: torch.device) -> None:
    for where in ("contacts", "halo"):
        seen, replayed = lose(Alone(), str(device), where, 0, False)
        assert replayed > 3 and (device.type == "cuda" or seen[0] is True and seen[-1] is False)
