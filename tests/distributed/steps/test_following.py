"""Fast robots that run into stopped ones, on ranks: equal to the reference, which searches all pairs in every round."""

from __future__ import annotations

from typing import Any

import pytest
from support.following import FAST, follow_plainly
from support.graphs import graphs_on
from support.ranks import World, on_three

from pgccd import sim
from pgccd.distributed import BalanceOptions, Comm, RankOptions
from pgccd.distributed.partition.cut import make_partition
from pgccd.sim import Simulation, starting_share


def follow(comm: Comm, name: str, expected: list[dict[str, Any]], kind: str, replayed: bool) -> int:
    """Compares the log. Returns the number of ghosts of the first step."""
    model = sim.Model(sim.ModelConfig(**FAST[name]))
    half = model.half_extent
    partition = make_partition(kind, tuple(-x for x in half), half, comm.size, 3, 4, "cpu")
    with graphs_on("cpu" if replayed else "none"):
        start, balance = starting_share(comm, model), BalanceOptions("none")
        simulation = Simulation.create(comm, model, partition, start, RankOptions(balance=balance), replayed)
        ghosts = 0
        for index, line in enumerate(expected):
            record = simulation.step(index, more=len(expected) - 1 - index).record
            assert {key: record[key] for key in line} == line
            ghosts += sum(record["ranks"]["ghosts"]) if comm.size > 1 else 0
    return ghosts


@on_three
@pytest.mark.parametrize("replayed", [False, True], ids=["eager", "replayed"])
@pytest.mark.parametrize(("name", "kind"), [("random", "cells"), ("skewed", "bisection")])
def test_fast_robots(world: World, name: str, kind: str, replayed: bool) -> None:
    ghosts = world(follow, name, follow_plainly(name), kind, replayed)
    assert (ghosts[0] > 10) == (len(ghosts) > 1)
