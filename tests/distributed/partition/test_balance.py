"""Load balancing: number and choice of cells that move, and termination."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pgccd.distributed import BalanceOptions, Cells
from pgccd.distributed.partition.balance import (
    BackOff,
    CellLoads,
    RankLoads,
    imbalance,
    one_cell,
    rank_loads,
    rebalance,
    relative_speeds,
)
from pgccd.distributed.partition.rebalancing import Balancer


@st.composite
def situations(draw: st.DrawFn) -> tuple[Cells, CellLoads]:
    """Arbitrary owners and loads, even and skewed, with empty cells and empty ranks."""
    partition = Cells.uniform((0.0,) * 3, (1.0,) * 3, draw(st.integers(1, 9)), cells=draw(st.integers(1, 4)))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 9999)))
    count = partition.cell_count
    if draw(st.booleans()):
        partition = partition.with_owner(torch.randint(partition.ranks, (count,), generator=generator))
    skew = draw(st.sampled_from([1, 4]))
    bodies = (100.0 * torch.rand(count, generator=generator) ** skew).long()
    pairs = (2.0 * bodies * torch.rand(count, generator=generator)).long()
    return partition, CellLoads(bodies, pairs, pairs // 3)


@given(situations(), st.floats(0.0, 0.5))
def test_one_cell_moves_one_from_the_most_to_the_least_loaded(
    situation: tuple[Cells, CellLoads], threshold: float
) -> None:
    partition, loads = situation
    load = loads.contacts
    before = rank_loads(load, partition.owner, partition.ranks)
    moved = one_cell(partition.owner, load, partition.ranks, threshold)
    after = rank_loads(load, moved, partition.ranks)
    changed = torch.nonzero(moved != partition.owner)[:, 0]
    assert len(changed) <= 1
    if len(changed):
        cell = int(changed[0])
        assert before[partition.owner[cell]] == before.max() and before[moved[cell]] == before.min()
        assert before.max() - before.min() > threshold * before.max()
        assert after[partition.owner[cell]] < before.max() and after[moved[cell]] < before.max()
    elif before.max() - before.min() > threshold * before.max():
        # Then moving any cell of the most loaded rank would not help.
        own = load[(partition.owner == torch.argmax(before)) & (load > 0)]
        assert bool((own >= before.max() - before.min()).all())


@given(situations(), st.sampled_from(["cost", "measured", "one-cell", "none"]))
def test_decisions_are_reproducible_and_never_make_it_worse(situation: tuple[Cells, CellLoads], policy: str) -> None:
    partition, loads = situation
    options = BalanceOptions(policy)
    owner = partition.owner.clone()
    seconds = 0.5 + torch.rand(partition.ranks, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    new, again = (rebalance(partition, loads, options, seconds).owner for _ in range(2))
    assert torch.equal(new, again) and torch.equal(partition.owner, owner)
    load = loads.contacts.double() if policy == "one-cell" else loads.cost.double()
    speed = torch.ones(partition.ranks, dtype=torch.float64)
    if policy == "measured":
        speed = relative_speeds(rank_loads(loads.cost, owner, partition.ranks), seconds)
    before, after = (rank_loads(load, table, partition.ranks) / speed for table in (owner, new))
    assert after.max() <= before.max() * (1.0 + 1e-12)
    if policy == "none":
        assert torch.equal(new, owner)


@given(situations(), st.sampled_from(["cost", "measured", "one-cell"]), st.floats(0.0, 0.3))
def test_ranks_loads_tell_when_cells_need_not_be_looked_at(
    situation: tuple[Cells, CellLoads], policy: str, start: float
) -> None:
    partition, loads = situation
    options = BalanceOptions(policy, start=start, goal=0.0, threshold=start, moving=0.0)
    seconds = 0.5 + torch.rand(partition.ranks, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    columns = [rank_loads(load, partition.owner, partition.ranks) for load in vars(loads).values()]
    if RankLoads(*(column.tolist() for column in columns), seconds.tolist()).are_level(options):
        assert rebalance(partition, loads, options, seconds) is partition
    else:
        load = columns[2].double() if policy == "one-cell" else (columns[0] + 8 * columns[1]).double()
        assert policy == "measured" or imbalance(load) > 1.0


def skewed(ranks: int, cells: int = 16) -> tuple[Cells, CellLoads]:
    """Bodies crowd in one corner: its cell has 20 times the bodies of the opposite one."""
    partition = Cells.uniform((0.0,) * 3, (1.0,) * 3, ranks, cells=cells)
    at = torch.cartesian_prod(*[torch.arange(count) / count for count in partition.grid])
    bodies = (20.0 + 400.0 * torch.exp(-3.0 * at.norm(dim=1))).long()
    return partition, CellLoads(bodies, bodies, bodies // 20)


@pytest.mark.parametrize("ranks", [2, 4, 12])
def test_ten_steps_even_out_a_skewed_world(ranks: int) -> None:
    partition, loads = skewed(ranks)
    assert imbalance(rank_loads(loads.cost, partition.owner, ranks)) > 1.2
    for _ in range(10):
        partition = rebalance(partition, loads, BalanceOptions("cost"))
    assert imbalance(rank_loads(loads.cost, partition.owner, ranks)) <= 1.04
    settled = rebalance(partition, loads, BalanceOptions("cost"))
    assert settled is partition


def test_the_paper_s_policy_gets_below_its_threshold() -> None:
    partition, loads = skewed(4, cells=8)
    for _ in range(100):
        partition = rebalance(partition, loads, BalanceOptions("one-cell"))
    load = rank_loads(loads.contacts, partition.owner, 4)
    assert int(load.max() - load.min()) <= 0.1 * int(load.max())


def test_a_slow_rank_gets_less() -> None:
    partition, loads = skewed(4)
    # Rank 1 takes twice as long for the same work.
    for _ in range(20):
        cost = rank_loads(loads.cost, partition.owner, 4).double()
        partition = rebalance(partition, loads, BalanceOptions("measured"), cost * torch.tensor([1.0, 2.0, 1.0, 1.0]))
    time = rank_loads(loads.cost, partition.owner, 4) * torch.tensor([1.0, 2.0, 1.0, 1.0])
    assert imbalance(time) < 1.05


def test_small_differences_and_dear_moves_are_left_alone() -> None:
    partition = Cells.uniform((0.0,) * 3, (1.0,) * 3, 2, cells=2)
    level = CellLoads(*(torch.full((8,), count) for count in (100, 100, 10)))
    uneven = CellLoads(level.bodies + torch.tensor([9] * 4 + [0] * 4), level.pairs, level.contacts)
    assert rebalance(partition, uneven, BalanceOptions("cost")) is partition
    assert rebalance(partition, uneven, BalanceOptions("cost", start=0.0, goal=0.0)) is partition  # no cell fits
    skew = CellLoads(level.bodies, level.pairs * torch.tensor([4] * 4 + [1] * 4), level.contacts)
    assert rebalance(partition, skew, BalanceOptions("cost")) is not partition
    assert rebalance(partition, skew, BalanceOptions("cost", moving=1e9)) is partition


@pytest.mark.parametrize(
    ("field", "value"),
    [("policy", "fair"), ("threshold", -0.1), ("goal", 0.5), ("horizon", 0), ("every", 0), ("start", float("nan"))],
)
def test_mistakes_are_named(field: str, value: object) -> None:
    with pytest.raises(ValueError, match=f"^{field}: "):
        BalanceOptions(**{field: value})


def test_decisions_that_move_nothing_become_rare() -> None:
    back_off, made = BackOff(), []
    for step in range(400):
        if back_off.is_over(step):
            made.append(step)
            back_off.tried(step, moved=0)
    waits = [later - step for step, later in itertools.pairwise(made)]
    assert waits[:8] == [2, 3, 5, 9, 17, 33, 65, 65] and set(waits[8:]) == {65}
    # After a decision that moves cells, the next step may decide again.
    step = made[-1] + 65
    assert back_off.is_over(step)
    back_off.tried(step, moved=3)
    assert back_off.is_over(step + 1)
    back_off.tried(step + 1, moved=0)
    assert not back_off.is_over(step + 2) and back_off.is_over(step + 3)


@pytest.mark.parametrize("policy", ["cost", "measured", "one-cell"])
def test_a_decision_is_made_once_it_costs_less_than_imbalance(policy: Any) -> None:
    """A small world would spend more on sums over its ranks than it can gain."""
    loads = RankLoads([10, 20, 30, 40], [1, 2, 3, 4], [1, 2, 3, 4], [1.0, 2.0, 3.0, 4.0])
    assert loads.lost == 40 + 8 * 4 - (100 + 8 * 10) / 4
    balancer = Balancer(BalanceOptions(policy, start=0.0, goal=0.0, deciding=10 * loads.lost))
    found = [balancer.is_worthwhile(loads) for _ in range(12)]
    assert policy == "measured" or found == ([True] * 12 if policy == "one-cell" else [False] * 9 + [True] * 3)
    level = RankLoads([10] * 4, [1] * 4, [1] * 4, [1.0] * 4)
    assert not balancer.is_worthwhile(level)
    large = Balancer(BalanceOptions(policy))
    assert large.is_worthwhile(RankLoads([10**6, 10**6, 10**6, 11 * 10**5], *[[1, 1, 1, 9]] * 2, [1.0, 1.0, 1.0, 9.0]))
