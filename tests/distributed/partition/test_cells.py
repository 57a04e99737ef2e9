"""The decomposition: every point has one owner, and the ranks that a box reaches equal brute force."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pgccd.distributed import Cells
from pgccd.distributed.partition.cells import factorise
from pgccd.distributed.partition.cut import PARTITIONS, make_partition

counts = st.integers(1, 24)


@st.composite
def partitions(draw: st.DrawFn) -> Cells:
    """Arbitrary boxes, numbers of ranks and cells, and owners."""
    lower = draw(st.tuples(*[st.floats(-1e3, 1e3)] * 3))
    upper = tuple(x + draw(st.floats(0.1, 1e3)) for x in lower)
    cells = draw(st.one_of(st.integers(1, 4), st.tuples(*[st.integers(1, 3)] * 3)))
    partition = Cells.uniform(lower, upper, draw(counts), axes=draw(st.integers(1, 3)), cells=cells)
    if draw(st.booleans()):
        generator = torch.Generator().manual_seed(draw(st.integers(0, 99)))
        owner = torch.randint(partition.ranks, (partition.cell_count,), generator=generator)
        partition = partition.with_owner(owner)
    return partition


@st.composite
def boxes(draw: st.DrawFn, partition: Cells) -> tuple[torch.Tensor, torch.Tensor]:
    """Corners (K, 3) in and around the world's box, some of them points, some larger than the world."""
    generator = torch.Generator().manual_seed(draw(st.integers(0, 999)))
    extent = torch.tensor(partition.upper, dtype=torch.float64) - torch.tensor(partition.lower, dtype=torch.float64)
    lower = torch.tensor(partition.lower) + extent * (3.0 * torch.rand((12, 3), generator=generator) - 1.0)
    size = extent * torch.rand((12, 3), generator=generator) ** 3 * torch.randint(3, (12, 1), generator=generator)
    return lower, lower + size


@given(st.data())
def test_cells_are_monotone_and_hold_every_point(data: st.DataObject) -> None:
    partition = data.draw(partitions())
    lower, upper = data.draw(boxes(partition))
    middle = lower + torch.rand((len(lower), 3), dtype=torch.float64) * (upper - lower)
    first, inner, last = (partition.coordinates(x) for x in (lower, middle, upper))
    assert bool(((first <= inner) & (inner <= last)).all())
    assert bool((first >= 0).all()) and bool((last < torch.tensor(partition.grid)).all())
    assert torch.equal(partition.owner_of(middle), partition.owner[partition.index(inner)])


@given(counts, st.tuples(*[st.floats(0.1, 100.0)] * 3), st.integers(1, 3))
def test_subdomains_multiply_up_and_have_the_least_surface(ranks: int, extent: tuple, axes: int) -> None:
    chosen = factorise(ranks, extent, axes)
    assert math.prod(chosen) == ranks
    if axes == 1:
        assert max(chosen) == ranks
        return
    assert axes == 3 or chosen[2] == 1

    def surface(parts: tuple[int, ...]) -> float:
        x, y, z = (length / count for length, count in zip(extent, parts, strict=True))
        return x * y + y * z + z * x

    for other in itertools.product(range(1, ranks + 1), repeat=3):
        if math.prod(other) == ranks and (axes == 3 or other[2] == 1):
            assert surface(chosen) <= surface(other) * (1.0 + 1e-8)


def test_the_paper_s_decomposition() -> None:
    """n subdomains of m x m cells in X-Y, each initially owned by its rank; points outside belong to the boundary."""
    partition = Cells.uniform((0.0, 0.0, 0.0), (8.0, 8.0, 8.0), 8, cells=4)
    assert partition.subdomains == (2, 2, 2) and partition.grid == (8, 8, 2)
    assert torch.bincount(partition.owner).tolist() == [16] * 8
    points = torch.tensor([[1.0, 1.0, 1.0], [1.0, 1.0, 7.0], [7.0, 1.0, 1.0], [-1e9, 9e9, -5.0], [1e150, 4.0, 8.0]])
    assert partition.owner_of(points).tolist() == [0, 1, 4, 2, 7]
    slabs = Cells.uniform((0.0, 0.0, 0.0), (1.0, 5.0, 1.0), 4, axes=1, cells=1)
    assert slabs.subdomains == (1, 4, 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"upper": (1.0, 1.0, 0.0)}, "^upper: .*volume"),
        ({"lower": (0.0, 0.0, math.nan)}, "^lower: "),
        ({"ranks": 0}, "^ranks: "),
        ({"axes": 4}, "^axes: "),
        ({"cells": 0}, "^cells: "),
        ({"cells": (2, 2)}, "^cells: "),
        ({"cells": 2**18}, "^cells: .*in all"),
    ],
)
def test_mistakes_are_named(change: dict, message: str) -> None:
    good = {"lower": (0.0, 0.0, 0.0), "upper": (1.0, 1.0, 1.0), "ranks": 2, "axes": 3, "cells": 2}
    with pytest.raises(ValueError, match=message):
        Cells.uniform(**{**good, **change})
    partition = Cells.uniform(**good)
    with pytest.raises(ValueError, match="^owner: values in"):
        partition.with_owner(torch.full_like(partition.owner, 2))
    with pytest.raises(ValueError, match="^owner: expected"):
        partition.with_owner(partition.owner[1:])


@pytest.mark.parametrize("kind", PARTITIONS)
@pytest.mark.parametrize(
    ("name", "value"), [("axes", 7), ("axes", 0), ("axes", None), ("cells", -3), ("cells", "x"), ("cells", None)]
)
def test_axes_and_cells_are_checked_for_every_kind(kind: str, name: str, value: Any) -> None:
    box = {"lower": (0.0, 0.0, 0.0), "upper": (8.0, 8.0, 8.0), "ranks": 2, "device": torch.device("cpu")}
    with pytest.raises((TypeError, ValueError), match=f"{name}: expected"):
        make_partition(kind, **{**box, "axes": 3, "cells": 16, name: value})
