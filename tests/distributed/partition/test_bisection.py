"""Recursive bisection: monotone, complete, balanced for any distribution of bodies; results equal to one process."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support.ranks import World

from distributed.steps import test_rank
from distributed.world import test_motions
from pgccd import ops
from pgccd.distributed import Alone, Bisection, Comm
from pgccd.distributed.partition.balance import imbalance, rank_loads

BOX = (0.0, 0.0, 0.0), (8.0, 4.0, 2.0)


def random_planes(seed: int, ranks: int) -> Bisection:
    """Planes balanced for a skewed distribution of points."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand((500, 3), generator=generator, dtype=torch.float64) ** 3 * torch.tensor(BOX[1])
    weights = torch.randint(1, 9, (500,), generator=generator)
    return Bisection.uniform(*BOX, ranks).rebalanced(Alone(), points.double(), weights, [1.0] * ranks)


@given(st.integers(0, 99), st.integers(1, 17))
def test_every_point_has_the_owner_whose_box_holds_it(seed: int, ranks: int) -> None:
    partition = random_planes(seed, ranks)
    assert partition.ranks == ranks and len(partition.boxes) == ranks
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand((200, 3), generator=generator, dtype=torch.float64) * torch.tensor(BOX[1]).double()
    points = torch.cat([points, partition.planes[:, 1:2].expand(-1, 3)])  # including points on planes
    points = torch.minimum(points, torch.tensor(BOX[1]).double())
    owner = partition.owner_of(points)
    for rank, (low, high) in enumerate(partition.boxes):
        lower, upper = (torch.tensor(corner, dtype=torch.float64) for corner in (low, high))
        inside = (points >= lower) & ((points < upper) | (upper == torch.tensor(BOX[1]).double()))
        assert torch.equal(owner == rank, inside.all(dim=1))
    volume = sum(float(np.prod(np.subtract(high, low))) for low, high in partition.boxes)
    assert volume == pytest.approx(64.0)


@pytest.mark.parametrize("seed", range(12))
def test_operators_reach_the_ranks_whose_boxes_a_body_touches(seed: int, device: torch.device) -> None:
    ranks = 2 + seed
    partition = random_planes(seed, ranks)
    there = replace(partition, planes=partition.planes.to(device))
    generator = torch.Generator().manual_seed(seed)
    count = 60
    start = torch.rand((count, 3), generator=generator, dtype=torch.float64) * torch.tensor(BOX[1]).double()
    end = start + 0.5 * torch.randn((count, 3), generator=generator, dtype=torch.float64)
    radius = torch.rand(count, generator=generator, dtype=torch.float64)
    centres = start, end, radius
    lower, upper = ops.swept_boxes(centres, 0.0, 0.0)
    everything = torch.arange(count)
    low, high = (torch.tensor([box[side] for box in partition.boxes], dtype=torch.float64) for side in (0, 1))
    # The outer parts extend to infinity.
    low = torch.where(low == torch.tensor(BOX[0]).double(), -torch.inf, low)
    high = torch.where(high == torch.tensor(BOX[1]).double(), torch.inf, high)
    expected = ((upper[:, None] >= low) & (lower[:, None] < high)).all(dim=2)
    on_device = [column.to(device) for column in centres]
    assert torch.equal(there.owner_of(on_device[0]).cpu(), partition.owner_of(start))
    for rank in range(ranks):
        where = on_device, 0.0, 0.0, *there.subdomain(rank)
        reached, counts = ops.replica_ranks(*where, everything.to(device), [], ranks)
        others = expected.clone()
        others[:, rank] = False
        assert torch.equal(reached.cpu().bool(), others) and torch.equal(counts.cpu(), others.sum(dim=0))
        reach, rows, found = ops.boundary_bodies(*where)
        assert torch.equal(reach.cpu().bool(), others.any(dim=1))
        assert torch.equal(rows[: int(found)].cpu(), torch.nonzero(others.any(dim=1))[:, 0])
        leaving, _, to = ops.leaving_bodies(on_device[0], *there.subdomain(rank), ranks)
        away = partition.owner_of(start) != rank
        assert torch.equal(leaving[: int(away.sum())].cpu(), torch.nonzero(away)[:, 0])
        assert torch.equal(to.cpu(), torch.bincount(partition.owner_of(start)[away], minlength=ranks))


def test_a_box_that_ends_on_a_plane_reaches_what_is_above() -> None:
    """A point on the plane is above it; so a box that touches the plane with its upper side reaches above, but with its
    lower side not below.
    """
    centres = [torch.tensor([[1.0, 1.0, 1.0]], dtype=torch.float64)] * 2 + [torch.ones(1, dtype=torch.float64)]
    rows = torch.zeros(1, dtype=torch.int64)
    lower, upper = ops.swept_boxes(centres, 0.0, 0.0)
    for axis in range(3):
        for at, reached in ((upper[0, axis], [True, True]), (lower[0, axis], [False, True])):
            planes = torch.tensor([[float(axis), float(at), -1.0, -2.0]], dtype=torch.float64)
            partition = Bisection((0.0,) * 3, (8.0,) * 3, planes)
            on_plane = torch.full((1, 3), float(at), dtype=torch.float64)
            assert partition.owner_of(on_plane).tolist() == [1]
            for rank in (0, 1):
                found, _ = ops.replica_ranks(centres, 0.0, 0.0, *partition.subdomain(rank), rows, [], 2)
                expected = [other and there for other, there in zip((rank != 0, rank != 1), reached, strict=True)]
                assert found[0].bool().tolist() == expected


def test_planes_that_are_none_are_refused() -> None:
    centres = [torch.zeros((1, 3), dtype=torch.float64)] * 2 + [torch.ones(1, dtype=torch.float64)]
    rows = torch.zeros(1, dtype=torch.int64)
    for wrong in ([0.0, 0.5, 0.0, -1.0], [0.0, 0.5, -1.0, 1.0], [3.0, 0.5, -1.0, -2.0], [0.0, 0.5, -1.0, -3.0]):
        planes = torch.tensor([wrong], dtype=torch.float64)
        frame = [0.0] * 3 + [1.0] * 3 + [4.0] * 3
        with pytest.raises(ValueError, match="^owner: row 0"):
            ops.replica_ranks(centres, 0.0, 0.0, frame, planes, 0, rows, [], 2)


def even_out(comm: Comm) -> list[float]:
    """Imbalances for loads concentrated in a millionth of the world, outside of it, in a single point, and empty."""
    found = []
    generator = torch.Generator().manual_seed(comm.rank)
    crowds = [
        torch.tensor([5.0, 1.0, 1.5]) + 0.02 * torch.randn((4000, 3), generator=generator),
        torch.rand((4000, 3), generator=generator) ** 4 * torch.tensor(BOX[1]),
        1e3 * torch.randn((4000, 3), generator=generator),  # outside of the world
        torch.ones((4000, 3)),
        torch.zeros((0, 3)),
    ]
    for points in crowds:
        weights = torch.randint(1, 9, (len(points),), generator=generator)
        partition = Bisection.uniform(*BOX, comm.size).rebalanced(comm, points.double(), weights, [1.0] * comm.size)
        assert comm.broadcast_object(partition.planes.tolist()) == partition.planes.tolist()
        loads = comm.sum(rank_loads(weights, partition.owner_of(points.double()), comm.size))
        found.append(imbalance(loads))
    return found


@pytest.mark.parametrize("size", [2, 3, 4])
def test_hot_spots_are_divided(ranks: World, size: int) -> None:
    crowd, skewed, outside, _, _ = ranks.run(size, even_out)[0]  # type: ignore[attr-defined]
    assert crowd < 1.02 and skewed < 1.02
    assert outside <= size  # clamped to the boundary, so the balance is not specified


def test_planes_outside_of_their_part_by_rounding() -> None:
    """Planes outside of their parts, as `_PlaneSearch` may find them."""
    partition = Bisection.uniform(*BOX, 2)
    planes = partition.planes.clone()
    high = partition.upper[int(planes[0, 0])]
    planes[0, 1] = torch.tensor(high, dtype=torch.float64).nextafter(torch.tensor(torch.inf, dtype=torch.float64))
    assert torch.equal(partition.with_planes(planes).planes, planes)
    planes[0, 1] = high + 1e-6
    with pytest.raises(ValueError, match="is outside of the part"):
        partition.with_planes(planes)


def test_shares_that_are_not_equal() -> None:
    points = torch.rand((20_000, 3), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    weights, shares = torch.ones(20_000, dtype=torch.int64), [1.0, 2.0, 1.0, 4.0, 2.0]
    partition = Bisection.uniform((0, 0, 0), (1, 1, 1), 5).rebalanced(Alone(), points, weights, shares)
    loads = rank_loads(weights, partition.owner_of(points), 5)
    assert torch.allclose(loads.double(), 2000.0 * torch.tensor(shares).double(), atol=10.0)


@pytest.mark.parametrize(
    ("name", "policy"),
    [
        pytest.param("random", "cost", marks=pytest.mark.slow),
        ("skewed", "cost"),
        pytest.param("skewed", "measured", marks=pytest.mark.slow),
    ],
)
def test_the_simulation_has_the_same_bits(world: World, name: str, policy: str) -> None:
    seen = world(test_rank.follow_bisected, test_rank.single_run(name, test_rank.STEPS), name, policy)
    assert seen[0]["contacts"] > 100
    if len(seen) > 1 and name == "skewed":
        assert seen[0]["moved cells"] > 0


def test_replays_have_the_same_bits(ranks: World) -> None:
    run, alone = test_rank.follow_bisected, test_rank.single_run("skewed", test_rank.STEPS)
    assert ranks.run(3, run, alone, "skewed", "cost", True)[0]["contacts"] > 100  # type: ignore[attr-defined]


@pytest.mark.parametrize("report", ["first", "all"])
def test_worlds_have_the_same_bits(world: World, report: str) -> None:
    world(test_motions.deform_bisected, report)
