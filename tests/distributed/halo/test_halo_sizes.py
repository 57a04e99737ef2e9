"""Ghosts in messages of fixed size, of any capacity: steps bitwise equal to one process."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from typing import Any
from unittest import mock

import pytest
from support.ranks import World, on_three

from distributed.comm.test_neighbourhood import OneOf
from distributed.detection.test_share import CONFIG, STEPS, by_one_process, without_times
from pgccd import sim
from pgccd.distributed import Cells, Comm
from pgccd.distributed.comm.neighbourhood import Neighbourhood
from pgccd.distributed.halo import halo_sizes
from pgccd.distributed.halo.ghosts import Halo
from pgccd.distributed.halo.halo_sizes import HaloSizes
from pgccd.distributed.halo.local_bodies import LocalBodies
from pgccd.distributed.steps import rank
from pgccd.sim import Simulation, starting_share

CAPACITIES = ["ample", "usual", "exact", "none", "boundary"]


def by_ranks(comm: Comm, capacities: str) -> tuple[list[dict[str, Any]], list[bool]]:
    """The records, and whether the capacity of each padded halo sufficed."""
    model = sim.Model(CONFIG)
    half = model.half_extent
    partition = Cells.uniform(tuple(-x for x in half), half, comm.size, cells=2)
    enough: list[bool] = []
    wait, padded = Halo.wait, HaloSizes.padded

    def watched(self: Halo) -> LocalBodies:
        was_padded, held = self.is_padded, wait(self)
        if was_padded:
            enough.append(self.is_padded)
        if self.is_padded:  # what was counted is correct, whatever the capacity
            received = held.ghosts_by_source().tolist()
            sizes = self.sizes(0, received)
            assert int((held.ghosts["id"] >= 0).sum()) == sum(received)
            assert int((held.route.rows >= 0).sum()) == sum(sizes.sent)
            assert int((held.boundary >= 0).sum()) == sizes.boundary
        return held

    def cramped(self: HaloSizes, neighbours: Neighbourhood) -> HaloSizes:
        """Capacities in which one rank overflows."""
        return replace(padded(self, neighbours), boundary=self.boundary // 2 if comm.rank == 0 else self.boundary)

    functions = {"ample": lambda count: 4 * count + 500, "exact": lambda count: count, "none": lambda _: 0}
    patches = [
        mock.patch.object(rank, "sends_ahead", lambda comm, *_: comm.size > 1),
        mock.patch.object(Halo, "wait", watched),
    ]
    if capacities in functions:
        patches.append(mock.patch.object(halo_sizes, "padded_count", functions[capacities]))
    if capacities == "boundary":
        patches.append(mock.patch.object(HaloSizes, "padded", cramped))
    with ExitStack() as stack:
        for patch in patches:
            stack.enter_context(patch)
        simulation = Simulation.create(comm, model, partition, starting_share(comm, model))
        records = [without_times(simulation.step(index).record) for index in range(STEPS)]
    return records, enough


@on_three
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
    capacity = HaloSizes(neighbours, [0, 0, 1, 1000, 0], [3, 0, 0, 5_000_000, 0], 12, 7).padded(neighbours)
    for column in (capacity.sent, capacity.received):
        assert column[1] == 0 and column[-1] == 0  # this rank, and all that are not neighbours
    for size, count in zip(
        [capacity.sent[0], *capacity.sent[2:4], capacity.received[0], *capacity.received[2:4], capacity.boundary],
        [0, 1, 1000, 3, 0, 5_000_000, 12],
        strict=True,
    ):
        assert max(1, 1.25 * count) <= size <= 1.25 * count + 320
    assert capacity.near >= 14


def test_sizes_follow_their_neighbours() -> None:
    former, later = (Neighbourhood(OneOf(5, 40), ranks) for ranks in ([2, 5, 7], [2, 3, 5, 7]))
    sizes = HaloSizes(former, [20, 0, 70, 0], [21, 0, 71, 0], 9, 8, [22, 0, 72, 0]).renumbered(later)
    assert (sizes.sent, sizes.received, sizes.common) == (
        [20, 0, 0, 70, 0],
        [21, 0, 0, 71, 0],
        [22, 0, 0, 72, 0],
    )
