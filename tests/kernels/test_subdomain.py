"""Ranks whose cells bodies reach: operators against brute force over all cells, on every device."""

from __future__ import annotations

import itertools

import pytest
import torch
from distributed.partition.test_cells import partitions
from hypothesis import given
from hypothesis import strategies as st

from pgccd import ops
from pgccd.distributed import Cells

SEPARATION = 0.25
DEVICES = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])


def bodies(partition: Cells, count: int, generator: torch.Generator) -> list[torch.Tensor]:
    """Centres and radii of moving bodies in and around the world's box, some larger than the world."""
    lower, upper = (torch.tensor(x, dtype=torch.float64) for x in (partition.lower, partition.upper))
    extent = upper - lower
    start = lower + extent * (1.6 * torch.rand((count, 3), dtype=torch.float64, generator=generator) - 0.3)
    travel = extent * (torch.rand((count, 3), dtype=torch.float64, generator=generator) - 0.5) ** 3
    size = torch.rand(count, dtype=torch.float64, generator=generator) ** 6
    return [start, start + travel, size * extent.min()]


def cells_of_boxes(partition: Cells, centres: list[torch.Tensor]) -> list[set[int]]:
    """The cells that each body's box reaches, one by one."""
    lower, upper = ops.swept_boxes(centres, SEPARATION, 0.0)
    found = []
    for first, last in zip(partition.coordinates(lower).tolist(), partition.coordinates(upper).tolist(), strict=True):
        axes = [range(a, b + 1) for a, b in zip(first, last, strict=True)]
        cells = itertools.product(*axes)
        found.append({(x * partition.grid[1] + y) * partition.grid[2] + z for x, y, z in cells})
    return found


def kept(rows: torch.Tensor, found: torch.Tensor) -> list[int]:
    return rows[: int(found)].tolist()


@given(st.data())
def test_operators_agree_with_brute_force(data: st.DataObject) -> None:
    partition = data.draw(partitions())
    generator = torch.Generator().manual_seed(data.draw(st.integers(0, 999)))
    centres, ghosts = bodies(partition, 14, generator), bodies(partition, data.draw(st.integers(0, 5)), generator)
    owner, ranks = partition.owner.tolist(), partition.ranks
    rank = data.draw(st.integers(0, ranks - 1))
    cells, ghost_cells = cells_of_boxes(partition, centres), cells_of_boxes(partition, ghosts)
    crossing = [any(owner[cell] != rank for cell in reached) for reached in cells]

    lower, upper = ops.swept_boxes(centres, SEPARATION, 0.0)
    ghost_lower, ghost_upper = ops.swept_boxes(ghosts, SEPARATION, 0.0)
    near = []
    for body, reached in enumerate(cells):
        for cell in (cell for cell in reached if owner[cell] == rank):
            inside = [k for k, others in enumerate(ghost_cells) if cell in others]
            low, high = ghost_lower[inside], ghost_upper[inside]
            if inside and bool(((lower[body] <= high.amax(0)) & (upper[body] >= low.amin(0))).all()):
                near.append(body)
                break
    near = sorted({*near, *(body for body, crosses in enumerate(crossing) if crosses)})
    # The first are own bodies, the rest ghosts; the pairs are those with overlapping boxes.
    own_count = data.draw(st.integers(0, len(cells)))
    pairs = torch.combinations(torch.arange(len(cells)))
    corner, other = torch.maximum(*lower[pairs].unbind(1)), torch.minimum(*upper[pairs].unbind(1))
    overlap = (corner <= other).all(1)
    pairs, is_here = pairs[overlap], partition.owner_of(corner)[overlap] == rank
    # The search among own bodies has the pairs of which one reaches no other rank.
    is_elsewhere = (pairs < own_count).all(dim=1) & ~torch.tensor(crossing)[pairs].all(dim=1)
    id = torch.randperm(len(cells), generator=generator)
    boundary = torch.randperm(len(cells), generator=generator)
    at_boundary = torch.argsort(boundary)[pairs]
    turned = torch.where((id[pairs[:, 0]] < id[pairs[:, 1]])[:, None], pairs, pairs.flip(1))
    centre_owner = partition.owner_of(centres[0])
    sources = torch.randint(ranks, (len(cells),), generator=generator).sort().values
    received = torch.bincount(sources, minlength=ranks).tolist()
    capacities = torch.randint(len(cells) + 3, (ranks,), generator=generator).tolist()

    for device in DEVICES:
        subdomain = (partition.frame, partition.owner.to(device), rank)
        here, there = ([column.to(device) for column in columns] for columns in (centres, ghosts))
        reach, at_edge, found = ops.boundary_bodies(here, SEPARATION, 0.0, *subdomain)
        assert reach.tolist() == [int(crosses) for crosses in crossing]
        assert kept(at_edge, found) == [body for body, crosses in enumerate(crossing) if crosses]
        assert bool((at_edge[int(found) :] == -1).all()) and len(at_edge) == len(cells)
        rows = torch.arange(len(cells), device=device).flip(0)
        for came_from in ([], received):
            replica_ranks, counts = ops.replica_ranks(here, SEPARATION, 0.0, *subdomain, rows, came_from, ranks)
            expected = [{owner[cell] for cell in each} - {rank} for each in reversed(cells)]
            if came_from:
                expected = [each | {source} for each, source in zip(expected, sources.tolist(), strict=True)]
            assert [set(torch.nonzero(row)[:, 0].tolist()) for row in replica_ranks] == expected
            by_rank = [
                [row for row, each in zip(rows.tolist(), expected, strict=True) if r in each] for r in range(ranks)
            ]
            assert counts.tolist() == [len(each) for each in by_rank]
            assert ops.rows_by_rank(replica_ranks, rows, counts, counts.tolist()).tolist() == sum(by_rank, [])
            in_rooms = [(each + [-1] * size)[:size] for each, size in zip(by_rank, capacities, strict=True)]
            assert ops.rows_by_rank(replica_ranks, rows, counts, capacities).tolist() == sum(in_rooms, [])
            for capacity in (len(rows), len(rows) - 1):
                for sizes in (capacities, counts.tolist()):
                    short = capacity < len(rows) or any(len(e) > size for e, size in zip(by_rank, sizes, strict=True))
                    messages = ops.counts_to_send(counts, sizes, torch.tensor([len(rows)], device=device), capacity)
                    assert messages.tolist() == [[len(each), int(short)] for each in by_rank]
        # Rows may be padded.
        padded = torch.where(rows % 3 == 1, -1, rows)
        for came_from in ([], received):
            replica_ranks, counts = ops.replica_ranks(here, SEPARATION, 0.0, *subdomain, padded, came_from, ranks)
            expected = [set() if row < 0 else {owner[cell] for cell in cells[row]} - {rank} for row in padded.tolist()]
            if came_from:
                every = zip(padded.tolist(), expected, sources.tolist(), strict=True)
                expected = [each if row < 0 else each | {source} for row, each, source in every]
            assert [set(torch.nonzero(row)[:, 0].tolist()) for row in replica_ranks] == expected
            assert counts.tolist() == [sum(r in each for each in expected) for r in range(ranks)]
        # Padding rows reach no cell, and nothing is near them.
        gone = torch.arange(len(cells)) % 3 == 0
        some = [*here[:2], torch.where(gone.to(device), -torch.inf, here[2])]
        marks, at_edge, found = ops.boundary_bodies(some, SEPARATION, 0.0, *subdomain)
        assert kept(at_edge, found) == [body for body, crosses in enumerate(crossing) if crosses and not gone[body]]
        assert int(marks.sum()) == int(found)
        where = (SEPARATION, 0.0, *subdomain)
        assert kept(*ops.near_ghosts(some, marks, there, *where)) == [body for body in near if not gone[body]]
        none = [*there[:2], torch.full_like(there[2], -torch.inf)]
        assert kept(*ops.near_ghosts(here, reach, none, *where)) == torch.nonzero(reach)[:, 0].tolist()
        assert kept(*ops.near_ghosts(here, reach, there, *where)) == near
        at_edge = [column[boundary.to(device)] for column in here]
        expected = torch.argsort(boundary)[turned[~is_elsewhere & is_here]]
        given_bodies = (boundary.to(device), id.to(device), at_edge, SEPARATION, 0.0, reach[:own_count])
        owned, found = ops.owned_pairs(at_boundary.to(device), *given_bodies, *subdomain)
        assert kept(owned, found) == expected.tolist()
        assert bool((owned[int(found) :] == -1).all()) and len(owned) == len(at_boundary)
        padding = torch.arange(len(id)) % 4 == 2
        gone = centre_owner != rank
        for numbers, is_there in ((None, ~padding | padding), (torch.where(padding, -1, id).to(device), ~padding)):
            found = ops.leaving_and_invalid(here[0], numbers, *subdomain).tolist()
            assert found == [int((gone & is_there).sum()), 0]
            at = here[0].clone()
            at[::3, 1], at[1::3, 2] = torch.nan, 1.1e150
            found = ops.leaving_and_invalid(at, numbers, *subdomain).tolist()
            assert found[1] == int(is_there[::3].sum() + is_there[1::3].sum())
        leaving, by_destination, counts = ops.leaving_bodies(here[0], *subdomain, ranks)
        assert counts.tolist() == torch.bincount(centre_owner[gone], minlength=ranks).tolist()
        rows = torch.nonzero(gone)[:, 0]
        assert leaving[: len(rows)].tolist() == rows.tolist()
        ordered = rows[torch.argsort(centre_owner[rows], stable=True)]
        assert by_destination[: len(rows)].tolist() == ordered.tolist()


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_bodies_whose_boxes_just_touch_a_ghost_are_near(device: torch.device, axis: int, side: float) -> None:
    """A box holds its own faces: bodies that have one coordinate in common with the ghost's box, and no more."""
    partition = Cells.uniform((0.0,) * 3, (1.0,) * 3, 1, axes=1, cells=1)
    ghost = torch.full((1, 3), 0.5, dtype=torch.float64)
    generator = torch.Generator().manual_seed(9)
    radius = 0.01 + 0.1 * torch.rand(200, dtype=torch.float64, generator=generator)
    centre = ghost.repeat(200, 1)
    ghosts, bodies = [ghost, ghost, torch.tensor([0.125], dtype=torch.float64)], [centre, centre, radius]
    low, high = ops.swept_boxes(ghosts, 0.0, 0.0)
    at = (low if side < 0.0 else high)[0, axis]
    lower, upper = ops.swept_boxes(bodies, 0.0, 0.0)
    centre[:, axis] = at + side * 0.5 * (upper - lower)[:, axis]
    lower, upper = ops.swept_boxes(bodies, 0.0, 0.0)
    touching = torch.nonzero((upper if side < 0.0 else lower)[:, axis] == at)[:, 0]
    assert len(touching) > 20
    columns = [[column[rows].to(device) for column in those] for those, rows in ((bodies, touching), (ghosts, [0]))]
    nothing = torch.zeros(len(touching), dtype=torch.uint8, device=device)
    where = (0.0, 0.0, partition.frame, partition.owner.to(device), 0)
    assert kept(*ops.near_ghosts(columns[0], nothing, columns[1], *where)) == list(range(len(touching)))


def test_cells_far_apart_share_a_box_of_ghosts(device: torch.device) -> None:
    """Of more than 64 cells along an axis. More bodies are near then, none fewer."""
    partition = Cells.uniform((0.0,) * 3, (1.0,) * 3, 2, axes=1, cells=150)
    generator = torch.Generator().manual_seed(8)
    partition = partition.with_owner(torch.randint(2, (partition.cell_count,), generator=generator))
    assert max(partition.grid) >= 300 and min(partition.grid[:2]) >= 150
    sizes, columns = (400, 60), []
    for count in sizes:
        start = torch.rand((count, 3), dtype=torch.float64, generator=generator)
        start[:, 2] *= 0.02
        columns.append([start, start + 0.002, torch.full((count,), 0.005, dtype=torch.float64)])
    centres, ghosts = columns
    where = (0.0, 0.0, partition.frame, partition.owner.to(device), 0)
    owner = partition.owner.tolist()

    def cells(those: list[torch.Tensor]) -> list[list[tuple[int, int, int]]]:
        corners = ops.swept_boxes(those, 0.0, 0.0)
        ranges = zip(*(partition.coordinates(corner).tolist() for corner in corners), strict=True)
        axes = ([range(a, b + 1) for a, b in zip(first, last, strict=True)] for first, last in ranges)
        return [list(itertools.product(*each)) for each in axes]

    def near(most: int) -> list[int]:
        """Bodies that overlap the box around the ghosts in cells of rank 0 with equal coordinates modulo `most`."""
        ghost_lower, ghost_upper = ops.swept_boxes(ghosts, 0.0, 0.0)
        around: dict[tuple[int, ...], list[int]] = {}
        for ghost, reached in enumerate(cells(ghosts)):
            for x, y, z in reached:
                if owner[(x * partition.grid[1] + y) * partition.grid[2] + z] == 0:
                    around.setdefault((x % most, y % most, z % most), []).append(ghost)
        lower, upper = ops.swept_boxes(centres, 0.0, 0.0)
        found = []
        for body, reached in enumerate(cells(centres)):
            for cell in {(x % most, y % most, z % most) for x, y, z in reached} & around.keys():
                low, high = ghost_lower[around[cell]].amin(0), ghost_upper[around[cell]].amax(0)
                if bool(((lower[body] <= high) & (upper[body] >= low)).all()):
                    found.append(body)
                    break
        return found

    here, there = ([column.to(device) for column in those] for those in (centres, ghosts))
    nothing = torch.zeros(sizes[0], dtype=torch.uint8, device=device)
    found = kept(*ops.near_ghosts(here, nothing, there, *where))
    assert found == near(64)
    exactly = near(10**6)
    assert 5 < len(exactly) < len(found) and set(exactly) <= set(found)


def test_many_leave_for_many(device: torch.device) -> None:
    """More than there are threads to sort them."""
    partition = Cells.uniform((0.0,) * 3, (1.0,) * 3, 12, cells=3)
    position = torch.rand((30_000, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    owner, rank = partition.owner_of(position), 7
    where = partition.frame, partition.owner.to(device), rank
    leaving, by_destination, counts = ops.leaving_bodies(position.to(device), *where, partition.ranks)
    rows = torch.nonzero(owner != rank)[:, 0]
    assert counts.tolist() == torch.bincount(owner[rows], minlength=partition.ranks).tolist()
    assert torch.equal(leaving[: len(rows)].cpu(), rows)
    assert ops.leaving_and_invalid(position.to(device), None, *where).tolist() == [len(rows), 0]
    assert torch.equal(by_destination[: len(rows)].cpu(), rows[torch.argsort(owner[rows], stable=True)])


def test_positions_that_are_no_numbers_have_a_cell() -> None:
    partition = Cells.uniform((0.0,) * 3, (1.0,) * 3, 2, cells=2)
    wrong = torch.tensor([[torch.nan] * 3, [torch.inf] * 3, [-torch.inf] * 3], dtype=torch.float64)
    *_, counts = ops.leaving_bodies(wrong, *partition.subdomain(5), 2)
    assert int(counts.sum()) == 3


@pytest.mark.parametrize("change", [{"frame": [0.0] * 8}, {"owner": torch.zeros(3, dtype=torch.int64)}])
def test_arguments_are_checked(change: dict) -> None:
    partition = Cells.uniform((0.0,) * 3, (1.0,) * 3, 2, cells=2)
    arguments = {"frame": partition.frame, "owner": partition.owner} | change
    with pytest.raises(RuntimeError, match=next(iter(change))):
        ops.leaving_bodies(torch.zeros((2, 3), dtype=torch.float64), *arguments.values(), 0, 2)
