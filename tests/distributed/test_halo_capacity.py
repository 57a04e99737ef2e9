"""Ghosts in messages of fixed size, of any capacity: steps bitwise equal to one process."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from typing import Any
from unittest import mock

import pytest
import torch
from torch import Tensor

from distributed.conftest import World
from distributed.test_neighbours import OneOf
from distributed.test_share import CONFIG, STEPS, by_one_process, without_times
from pgccd import sim
from pgccd.distributed import Cells, Comm
from pgccd.distributed.comm.neighbourhood import Neighbourhood
from pgccd.distributed.detection import share
from pgccd.distributed.halo import capacity as halo_capacity
from pgccd.distributed.halo.capacity import HaloCapacity, PaddedHalo
from pgccd.distributed.halo.held import Held
from pgccd.sim.distributed import DistributedSimulation, starting_share

CAPACITIES = ["ample", "usual", "exact", "none", "boundary"]


def by_ranks(comm: Comm, capacities: str) -> tuple[list[dict[str, Any]], list[bool]]:
    """The records, and whether the capacity of each padded halo sufficed."""
    model = sim.Model(CONFIG)
    half = model.half_extent
    partition = Cells.uniform(tuple(-x for x in half), half, comm.size, cells=2)
    enough: list[bool] = []
    wait, after = PaddedHalo.wait, HaloCapacity.after

    def watched(self: PaddedHalo, boundary_count: int) -> Held | None:
        sent = wait(self, boundary_count)
        enough.append(sent is not None)
        if sent is not None:  # the rows are correct, whatever the capacity
            assert sent.route.sent == sent.replicas.counts.tolist() and len(sent.route.rows) == sum(sent.route.sent)
            assert len(sent.ghosts["id"]) == sum(sent.route.received) and len(sent.replicas.table) == boundary_count
        return sent

    def cramped(sent: list[int], received: list[int], boundary: int, neighbours: Neighbourhood) -> HaloCapacity:
        """A capacity in which one rank overflows."""
        ample = after(sent, received, boundary, neighbours)
        return replace(ample, boundary=boundary // 2 if comm.rank == 0 else boundary)

    functions = {"ample": lambda count: 4 * count + 500, "exact": lambda count: count, "none": lambda _: 0}
    patches = [
        mock.patch.object(share, "_sends_ahead", lambda comm, _: comm.size > 1),
        mock.patch.object(PaddedHalo, "wait", watched),
    ]
    if capacities in functions:
        patches.append(mock.patch.object(halo_capacity, "padded_count", functions[capacities]))
    if capacities == "boundary":
        patches.append(mock.patch.object(HaloCapacity, "after", cramped))
    with ExitStack() as stack:
        for patch in patches:
            stack.enter_context(patch)
        simulation = DistributedSimulation.create(comm, model, partition, starting_share(comm, model))
        records = [without_times(simulation.step(index).record) for index in range(STEPS)]
    return records, enough


@pytest.mark.parametrize("capacities", CAPACITIES)
def test_same_bits_for_any_capacity(world: World, capacities: str) -> None:
    expected = by_one_process()
    of_ranks = world(by_ranks, capacities)
    for records, enough in of_ranks:
        assert records == expected
        # In the first step, and when cells have changed owners, the capacity is unknown. An overflow on one rank is one
        # on all ranks.
        assert enough == of_ranks[0][1] and len(enough) < STEPS
    if len(of_ranks) == 1:  # a single rank has no ghosts
        return
    enough = of_ranks[0][1]
    assert len(enough) > 0
    if capacities in ("ample", "usual"):
        assert all(enough) if capacities == "ample" else any(enough)
    else:
        assert not all(enough) if capacities == "exact" else not any(enough)


def test_capacity_exceeds_what_was_needed() -> None:
    neighbours = Neighbourhood(OneOf(5, 40), [2, 5, 7, 9])
    capacity = HaloCapacity.after([0, 0, 1, 1000, 0], [3, 0, 0, 5_000_000, 0], 12, neighbours)
    for column in (capacity.sent, capacity.received):
        assert column[1] == 0 and column[-1] == 0  # this rank, and all that are not neighbours
    for size, count in zip(
        [capacity.sent[0], *capacity.sent[2:4], capacity.received[0], *capacity.received[2:4], capacity.boundary],
        [0, 1, 1000, 3, 0, 5_000_000, 12],
        strict=True,
    ):
        assert max(1, 1.25 * count) <= size <= 1.25 * count + 320


def test_what_filled_the_capacities() -> None:
    rows: Tensor = torch.arange(9)
    assert halo_capacity._filled(rows, [3, 0, 4, 2], [1, 0, 4, 0]).tolist() == [0, 3, 4, 5, 6]
    assert halo_capacity._filled(rows, [3, 0, 4, 2], [0, 0, 0, 0]).tolist() == []
