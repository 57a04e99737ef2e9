"""Row copies against torch's own indexing: any type, any width, on every device."""

from __future__ import annotations

from math import prod

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from pgccd import ops

Kind = tuple[torch.dtype, tuple[int, ...]]
# Whole words, half words, odd bytes, and zero bytes.
KINDS: list[Kind] = [
    (torch.int64, ()),
    (torch.bool, ()),
    (torch.uint8, (3,)),
    (torch.float64, (3,)),
    (torch.float64, (2, 2)),
    (torch.float32, (0,)),
    (torch.int32, (2,)),
    (torch.float32, (3,)),
    (torch.int16, (5,)),
]
kinds = st.lists(st.sampled_from(KINDS), max_size=40)
seeds = st.integers(0, 2**31)
# All examples use the same device.
same_device = settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])


def columns_of(kinds: list[Kind], count: int, generator: torch.Generator) -> list[Tensor]:
    """Columns of random bytes that are valid numbers."""
    columns = []
    for dtype, width in kinds:
        shape = (count, *width)
        if dtype.is_floating_point:
            columns.append(torch.rand(shape, generator=generator, dtype=dtype))
        else:
            columns.append(torch.randint(0, 100, shape, generator=generator).to(dtype))
    return columns


def to(device: torch.device, columns: list[Tensor]) -> list[Tensor]:
    return [column.to(device) for column in columns]


def random_rows(below: int, count: int, generator: torch.Generator) -> Tensor:
    return torch.randint(max(1, below), (count if below else 0,), generator=generator)


def require_equal(found: list[Tensor], expected: list[Tensor], device: torch.device) -> None:
    assert len(found) == len(expected)
    for column, wanted in zip(found, expected, strict=True):
        assert column.device.type == device.type and column.dtype == wanted.dtype and column.is_contiguous()
        assert torch.equal(column.cpu(), wanted)


@same_device
@given(kinds, st.integers(0, 70), st.integers(0, 70), seeds)
def test_packing(device: torch.device, kinds: list[Kind], count: int, wanted: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    columns = columns_of(kinds, count, generator)
    rows = random_rows(count, wanted, generator)
    packed = ops.pack_rows(to(device, columns), rows.to(device))
    expected = [column[rows].numpy().tobytes() for column in columns]
    widths = [prod(column.shape[1:]) * column.element_size() for column in columns]
    assert packed.shape == (len(rows), sum(widths)) and packed.dtype == torch.uint8
    sides = torch.split(packed.cpu(), widths, dim=1) if widths else ()
    assert [side.numpy().tobytes() for side in sides] == expected
    like = [column[:0] for column in to(device, columns)]
    require_equal(ops.unpack_rows(packed, like), [column[rows] for column in columns], device)


@same_device
@given(kinds, st.integers(0, 70), st.none() | st.integers(0, 70), st.integers(0, 150), seeds)
def test_taking(
    device: torch.device, kinds: list[Kind], count: int, more_count: int | None, wanted: int, seed: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    columns, more = (columns_of(kinds, size or 0, generator) for size in (count, more_count))
    if more_count is None:
        more = []
    rows = random_rows(count + (more_count or 0), wanted, generator)
    taken = ops.take_rows(to(device, columns), to(device, more), rows.to(device))
    together = [torch.cat(pair) for pair in zip(columns, more, strict=True)] if more else columns
    require_equal(taken, [column[rows] for column in together], device)


@same_device
@given(kinds, st.integers(0, 300), st.booleans(), seeds)
def test_committing(device: torch.device, kinds: list[Kind], count: int, discards: bool, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    columns, values = (columns_of(kinds, count, generator) for _ in range(2))
    id = torch.randint(-1, 3, (count,), generator=generator)
    written, discard = to(device, columns), torch.tensor([5 * discards], device=device)
    written = [column.clone() for column in written]
    ops.commit_rows(written, to(device, values), id.to(device), discard)
    is_new = (id >= 0) & (not discards)
    expected = [column.clone() for column in columns]
    for column, value in zip(expected, values, strict=True):
        column[is_new] = value[is_new]
    require_equal(written, expected, device)


def test_opcheck_of_committing(device: torch.device) -> None:
    id = torch.tensor([0, -1, 3], device=device)
    columns = [torch.rand(3, 2, device=device), id > 0]
    values, discard = [column.clone() for column in columns], torch.zeros(1, dtype=torch.int64, device=device)
    torch.library.opcheck(torch.ops.pgccd.commit_rows, (columns, values, id, discard))


@st.composite
def changes(draw: st.DrawFn) -> tuple[list[int], list[int], list[int]]:
    """Ids, rows removed, ids added: from a small range, so that ids may precede, interleave, follow or repeat."""
    all_ids = draw(st.sets(st.integers(-20, 20))) | draw(st.just(set()) | st.just(set(range(100, 250))))
    former = sorted(id for id in all_ids if draw(st.booleans()))
    removed = [row for row in range(len(former)) if draw(st.booleans())]
    free = (all_ids - set(former)) | {former[row] for row in removed}
    added = draw(st.permutations(sorted(id for id in free if draw(st.booleans()))))
    return former, removed, list(added)


def require_merged(
    device: torch.device, kinds: list[Kind], former: Tensor, removed: Tensor, added: Tensor, seed: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    columns = [former, *columns_of(kinds, len(former), generator)]
    new = [added, *columns_of(kinds, len(added), generator)]
    packed = ops.pack_rows(to(device, new), torch.arange(len(added), device=device))
    merged = ops.merge_rows(to(device, columns), removed.to(device), packed)
    is_kept = torch.ones(len(former), dtype=torch.bool)
    is_kept[removed] = False
    together = [torch.cat([column[is_kept], row]) for column, row in zip(columns, new, strict=True)]
    order = torch.argsort(together[0])
    require_equal(merged, [column[order] for column in together], device)


@same_device
@given(kinds, changes(), seeds)
def test_merging(
    device: torch.device, kinds: list[Kind], change: tuple[list[int], list[int], list[int]], seed: int
) -> None:
    former, removed, added = (torch.tensor(rows, dtype=torch.int64) for rows in change)
    require_merged(device, kinds, former, removed, added, seed)


@pytest.mark.parametrize("remove", ["none", "some", "all"])
@pytest.mark.parametrize("where", ["nowhere", "before", "between", "after", "in place of those removed"])
def test_merging_many(device: torch.device, remove: str, where: str) -> None:
    count = 20_000
    former = 3 * torch.arange(count)
    share = {"none": 0.0, "some": 0.1, "all": 1.0}[remove]
    generator = torch.Generator().manual_seed(5)
    removed = torch.nonzero(torch.rand(count, generator=generator) < share)[:, 0]
    added = {
        "nowhere": former[:0],
        "before": torch.arange(-9000, 0),
        "between": former[::2] + 1,
        "after": former[-1] + 1 + torch.arange(9000),
        "in place of those removed": former[removed],
    }[where]
    added = added[torch.randperm(len(added), generator=generator)]
    for kinds in (KINDS, KINDS[3:5]):
        require_merged(device, kinds, former, removed, added, 6)


@pytest.mark.parametrize("count", [0, 5])
def test_rows_of_padding_are_zeros(device: torch.device, count: int) -> None:
    rows = torch.tensor([-1, *range(count), -1], device=device)
    columns = to(device, columns_of(KINDS, count, torch.Generator().manual_seed(4)))
    expected = [torch.cat([torch.zeros_like(column.new_empty((1, *column.shape[1:]))), column]) for column in columns]
    expected = [torch.cat([column, column[:1]]) for column in expected]
    packed = ops.pack_rows(columns, rows)
    require_equal(ops.unpack_rows(packed, columns), [column.cpu() for column in expected], device)
    for more in ([], [column[:0] for column in columns]):
        require_equal(ops.take_rows(columns, more, rows), [column.cpu() for column in expected], device)


def test_columns_need_not_be_contiguous(device: torch.device) -> None:
    strided = torch.rand((6, 4), device=device)[:, 1:3]
    rows = torch.tensor([5, 0, 0, 3], device=device)
    assert not strided.is_contiguous()
    assert torch.equal(ops.take_rows([strided], [strided], rows)[0], strided[rows])
    packed = ops.pack_rows([strided], rows)
    assert torch.equal(ops.unpack_rows(packed, [strided])[0], strided[rows])


def test_data_that_are_not_aligned(device: torch.device) -> None:
    """Whole words may only be copied at addresses that are multiples of their length."""
    shifted = torch.arange(90, dtype=torch.int32, device=device)[1:81].view(-1, 2)
    rows = torch.arange(39, -1, -1, device=device)
    assert shifted.is_contiguous() and shifted.data_ptr() % 8
    assert torch.equal(ops.take_rows([shifted], [], rows)[0], shifted[rows])


def test_errors_name_the_argument(device: torch.device) -> None:
    id = torch.arange(4, device=device)
    x, rows = torch.zeros((4, 3), dtype=torch.float64, device=device), id[:2]
    packed = ops.pack_rows([id, x], rows)
    cases = [
        ("rows: wrong dtype", lambda: ops.pack_rows([id], rows.int())),
        ("rows: expected 1 dimensions", lambda: ops.take_rows([id], [], rows[None])),
        (r"columns\[1\]: expected 4 rows as in the first, got 3", lambda: ops.pack_rows([id, x[:3]], rows)),
        (r"columns\[0\]: expected one dimension at least", lambda: ops.pack_rows([id[0]], rows)),
        ("columns: rows of 80000000 bytes", lambda: ops.pack_rows([id.new_zeros((1, 10_000_000))], rows)),
        ("packed: expected size 24 in dimension 1, got 32", lambda: ops.unpack_rows(packed, [x])),
        ("packed: wrong dtype", lambda: ops.unpack_rows(x, [x])),
        ("more: expected 2 tensors, got 1", lambda: ops.take_rows([id, x], [id], rows)),
        (r"more\[0\]: wrong dtype", lambda: ops.take_rows([id], [id.double()], rows)),
        (r"more\[1\]: expected rows of 24 bytes, got 16", lambda: ops.take_rows([id, x], [id, x[:, :2]], rows)),
        (r"values\[0\]: wrong dtype", lambda: ops.commit_rows([x], [x.float()], id, id[:1])),
        ("values: expected 1 tensors, got 0", lambda: ops.commit_rows([x], [], id, id[:1])),
        ("expected a row per id, 4", lambda: ops.commit_rows([x[:3]], [x[:3]], id, id[:1])),
        ("discard: expected size 1", lambda: ops.commit_rows([x], [x], id, id)),
        (r"columns\[0\]: expected a contiguous", lambda: ops.commit_rows([x.repeat(1, 2)[:, :3]], [x], id, id[:1])),
        ("columns: expected ids at least", lambda: ops.merge_rows([], rows, packed)),
        (r"columns\[0\] \(ids\): wrong dtype", lambda: ops.merge_rows([x[:, 0], x], rows, packed)),
        ("packed: expected size 8 in dimension 1", lambda: ops.merge_rows([id], rows, packed)),
        ("removed: wrong dtype", lambda: ops.merge_rows([id, x], rows.int(), packed)),
        ("removed: 5 of 4 rows", lambda: ops.merge_rows([id, x], torch.arange(5, device=device), packed)),
    ]
    for message, call in cases:
        with pytest.raises(RuntimeError, match=message):
            call()


@pytest.mark.cuda
def test_devices_are_not_mixed() -> None:
    here, there = torch.arange(4), torch.arange(4, device="cuda")
    packed = ops.pack_rows([there], there)
    calls = (
        lambda: ops.pack_rows([there], here),
        lambda: ops.take_rows([there, here], [], there),
        lambda: ops.take_rows([there], [here], there),
        lambda: ops.unpack_rows(packed, [here]),
        lambda: ops.merge_rows([there], here, packed),
        lambda: ops.merge_rows([there], there, packed.cpu()),
    )
    for call in calls:
        with pytest.raises(RuntimeError, match=r"(columns|more|like|rows|removed|packed)(\[\d\])?: on another device"):
            call()
