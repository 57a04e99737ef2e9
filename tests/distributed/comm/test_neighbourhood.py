"""Neighbours: by the partition, in the numbers of operators, and as the only ranks that exchange messages."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any
from unittest import mock

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support.crowds import crowds
from support.ranks import World

import pgccd
from pgccd import ops
from pgccd.distributed import Alone, BalanceOptions, Bisection, Cells, Comm, WorldOptions
from pgccd.distributed import World as SharedWorld
from pgccd.distributed.comm.exchange import first_row
from pgccd.distributed.comm.neighbourhood import Neighbourhood
from pgccd.distributed.comm.torch_comm import TorchComm
from pgccd.distributed.partition.decomposition import Decomposition

BOX = (0.0, 0.0, 0.0), (8.0, 6.0, 5.0)


class OneOf(Alone):
    """A rank that cannot send."""

    def __init__(self, rank: int, size: int) -> None:
        super().__init__()
        self.rank, self.size, self.neighbours_above = rank, size, 0


def bisection(ranks: int, seed: int) -> Bisection:
    """Planes that divide random points evenly."""
    points = torch.rand((300, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) ** 2
    points = points * torch.tensor(BOX[1], dtype=torch.float64)
    weights = torch.ones(len(points), dtype=torch.int64)
    return Bisection.uniform(*BOX, ranks).rebalanced(Alone(), points, weights, [1.0] * ranks)


@given(st.integers(1, 24), st.integers(0, 999))
def test_parts_that_touch_are_neighbours(ranks: int, seed: int) -> None:
    partition = bisection(ranks, seed)
    neighbours = [partition.neighbours(rank) for rank in range(ranks)]
    for a, b in itertools.product(range(ranks), repeat=2):
        assert (a in neighbours[b]) == (b in neighbours[a])
        sides = zip(*partition.boxes[a], *partition.boxes[b], strict=True)
        if all(low <= other_high and other_low <= high for low, high, other_low, other_high in sides):
            assert a in neighbours[b]
    # Bodies outside of the world reach the parts at its boundary there.
    points = 30.0 * torch.rand((400, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) - 10.0
    beside = points + 1e-9 * torch.randn(points.shape, generator=torch.Generator().manual_seed(seed))
    for one, other in zip(partition.owner_of(points).tolist(), partition.owner_of(beside).tolist(), strict=True):
        assert one in neighbours[other]


@given(st.integers(1, 9), st.integers(0, 999))
def test_ranks_of_adjacent_cells_are_neighbours(ranks: int, seed: int) -> None:
    partition = Cells.uniform(*BOX, ranks, cells=(2, 3, 1))
    owner = torch.randint(ranks, (partition.cell_count,), generator=torch.Generator().manual_seed(seed))
    partition = partition.with_owner(owner)
    grid, expected = owner.view(partition.grid), [{rank} for rank in range(ranks)]
    for at in itertools.product(*map(range, partition.grid)):
        around = tuple(slice(max(0, place - 1), place + 2) for place in at)
        expected[int(grid[at])] |= set(grid[around].flatten().tolist())
    assert [partition.neighbours(rank) for rank in range(ranks)] == [sorted(each) for each in expected]


@pytest.mark.parametrize("make", [lambda: bisection(23, 4), lambda: Cells.uniform(*BOX, 23, cells=2)])
def test_operators_number_the_neighbours(make: Any, device: torch.device) -> None:
    partition = make()
    generator = torch.Generator().manual_seed(2)
    start = torch.rand((500, 3), dtype=torch.float64, generator=generator) * torch.tensor(BOX[1])
    radius = 3.0 * torch.rand(500, dtype=torch.float64, generator=generator) ** 9
    centres = [column.to(device) for column in (start, start + 0.1, radius)]
    rows = torch.arange(500, device=device)
    for rank in (0, 7, 22):
        decomposition = Decomposition(OneOf(rank, 23), partition)
        ranks, (frame, owners, number) = decomposition.neighbours.ranks, decomposition.subdomain
        assert 1 < len(ranks) < 23 and ranks[number] == rank == ranks[decomposition.neighbours.rank]
        here = frame, owners.to(device), number
        whole = frame, partition.subdomain(rank)[1].to(device), rank
        found, counts = ops.replica_ranks(centres, 0.0, 0.0, *here, rows, [], decomposition.neighbours.size)
        expected, _ = ops.replica_ranks(centres, 0.0, 0.0, *whole, rows, [], 23)
        assert torch.equal(found[:, :-1], expected[:, list(ranks)])
        others = [other for other in range(23) if other not in ranks]
        assert torch.equal(found[:, -1], expected[:, others].amax(dim=1)) and int(counts[-1]) > 0
        for own, other in zip(
            ops.boundary_bodies(centres, 0.0, 0.0, *here), ops.boundary_bodies(centres, 0.0, 0.0, *whole), strict=True
        ):
            assert torch.equal(own, other)


def test_renumbering_keeps_what_both_have() -> None:
    comm = OneOf(5, 9)
    former, later = Neighbourhood(comm, [2, 5, 8]), Neighbourhood(comm, [1, 2, 5, 7])
    assert later.renumber(former, torch.tensor([[20, 50, 80, 0]])).tolist() == [[0, 20, 50, 0, 0]]
    assert former.numbers().tolist() == [3, 3, 0, 3, 3, 1, 3, 3, 2] and Neighbourhood(comm).numbers() is None


def meet_neighbours(comm: Comm) -> set[int]:
    """Two steps of bodies in slabs; returns the ranks to which this one sent anything."""
    assert isinstance(comm, TorchComm)
    comm.neighbours_above = 0
    crowd = crowds()["kept apart, filtered"]
    mine = torch.arange(comm.rank, len(crowd.position), comm.size)
    position, options = 0.5 * crowd.position[mine] + 2.0, WorldOptions(axes=1, balance=BalanceOptions("none"))
    mesh = pgccd.Mesh(0.02 * torch.eye(4, 3, dtype=torch.float64), [[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]])
    scene = pgccd.Scene([mesh], [0] * len(mine))
    world = SharedWorld.create(scene, position, (0.0,) * 3, (8.0,) * 3, id=mine, comm=comm, options=options)
    sent: set[int] = set()
    to_peers = comm._to_peers

    def noted(incoming: Sequence[tuple[int, Any]], outgoing: Sequence[tuple[int, Any]]) -> list[Any]:
        sent.update(peer for peer, _ in outgoing)
        return to_peers(incoming, outgoing)

    with mock.patch.object(comm, "_to_peers", noted):
        for _ in range(2):
            still = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64).repeat(len(world.id), 1)
            towards = torch.full((len(world.id), 3), 0.2, dtype=torch.float64)
            motion = pgccd.RigidMotion.from_velocity(world.position, still, towards, 0.0 * towards, dt=1.0)
            world.step(motion)
            world.move(motion.position_t1)
    return sent


def test_messages_go_to_neighbours_only(ranks: World) -> None:
    for rank, sent in enumerate(ranks.run(4, meet_neighbours)):
        assert sent == {rank - 1, rank + 1} & set(range(4))


def find_first(comm: Comm) -> None:
    for holders in ((), (comm.size - 1,), range(comm.size)):
        has_one = int(comm.rank in holders)
        order = torch.tensor([[7, -comm.rank]] * has_one, dtype=torch.int64).reshape(-1, 2)
        columns = {"x": torch.full((has_one, 3), comm.rank + 0.5), "is": torch.ones(has_one, dtype=torch.bool)}
        found = first_row(comm, order, columns)
        expected = [[comm.size - 0.5] * 3] if holders else []
        assert found["x"].tolist() == expected and found["is"].tolist() == [True] * len(expected)


def test_the_first_row_of_all_ranks(world: World) -> None:
    world(find_first)
