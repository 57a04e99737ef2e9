"""The files of checkpoints: columns of any type, order of rows, and validation of the index."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from support.checkpoint_faults import newest, plant

from pgccd.checkpoint import files
from pgccd.checkpoint.files import DTYPES, FOLDER, POINTER, CheckpointError, rows_hash
from pgccd.checkpoint.stored import Stored, has_checkpoint

KIND = "table"


def columns_of(rows: int, dtype: torch.dtype) -> dict[str, torch.Tensor]:
    raw = torch.arange(rows * 6 * dtype.itemsize) % (2 if dtype == torch.bool else 251)
    wide = raw.to(torch.uint8).view(dtype).view(rows, 2, 3)
    return {"wide": wide, "single": wide[:, 0, 0].contiguous(), "none": wide[:, :0], "id": torch.arange(rows)}


def write(folder: Path, tables: list[dict[str, dict[str, torch.Tensor]]]) -> Path:
    """A checkpoint with one rank per element of `tables`."""
    root = folder / FOLDER
    name = files.make_folder(root, KIND, 3)
    entries = [files.write_tables(root / name, rank, each) for rank, each in enumerate(tables)]
    content = files.Content(KIND, 3, {"mood": "good"}, {"shared": torch.arange(4)})
    return files.publish(root, name, content, files.layout_of(tables[0]), entries)


def bits(column: torch.Tensor) -> torch.Tensor:
    return column.contiguous().view(-1).view(torch.uint8) if column.numel() else column.reshape(-1)


@pytest.mark.parametrize("dtype", list(DTYPES))
def test_columns_of_all_types(tmp_path: Path, dtype: str) -> None:
    assert not has_checkpoint(tmp_path)
    columns = columns_of(9, DTYPES[dtype])
    parts = [{name: column[rows] for name, column in columns.items()} for rows in (slice(4), slice(4, 4), slice(4, 9))]
    write(tmp_path, [{"rows": part} for part in parts])
    stored = Stored(tmp_path, KIND)
    assert (stored.steps_made, stored.header, stored.row_count("rows")) == (3, {"mood": "good"}, 9)
    assert stored.shared()["shared"].tolist() == [0, 1, 2, 3] and has_checkpoint(tmp_path)
    total = 0
    for begin, end in ((0, 2), (2, 5), (5, 5), (5, 9)):
        found, part = stored.rows("rows", begin, end)
        total += part
        for name, column in columns.items():
            assert found[name].dtype == column.dtype and found[name].shape == column[begin:end].shape
            assert torch.equal(bits(found[name]), bits(column[begin:end]))
    stored.require_hash("rows", total)


def test_hashes_are_of_rows_at_their_places(monkeypatch: pytest.MonkeyPatch) -> None:
    columns = columns_of(9, torch.int16)
    whole = rows_hash(columns, 2, 0)
    parts = [
        ({name: column[rows] for name, column in columns.items()}, rows.start) for rows in (slice(0, 4), slice(4, 9))
    ]
    assert sum(rows_hash(part, 2, begin) for part, begin in parts) % 2**64 == whole
    monkeypatch.setattr(files, "_BLOCK", 2)
    assert rows_hash(columns, 2, 0) == whole == rows_hash(dict(reversed(columns.items())), 2, 0)
    swapped = torch.arange(9)
    swapped[:2] = swapped[:2].flip(0)
    others = [(columns, 1, 0), (columns, 2, 1), ({name: column[swapped] for name, column in columns.items()}, 2, 0)]
    others += [({**columns, "single": columns["single"] ^ 1}, 2, 0)]
    assert whole not in [rows_hash(*other) for other in others]


CHANGES: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "no header": (lambda index: index.update(header=[]), "expected a header"),
    "a table without columns": (lambda index: index["layout"].update(rows={}), "columns in every table"),
    "too large a column": (lambda index: index["layout"]["rows"].update(wide=["int64", [2**62, 2**62]]), "overflow"),
    "another list of files": (lambda index: index["files"].reverse(), "its list of files"),
}


@pytest.mark.parametrize("change", list(CHANGES))
def test_what_an_index_must_have(tmp_path: Path, change: str) -> None:
    write(tmp_path, [{"rows": columns_of(3, torch.int64)}] * 2)
    planted, expected = CHANGES[change]
    plant(tmp_path, planted)
    with pytest.raises(CheckpointError, match=f"index.json is not the index of a checkpoint: .*{expected}") as refused:
        Stored(tmp_path, KIND)
    assert len(str(refused.value).splitlines()) == 1


def test_what_could_not_be_completed_is_removed(tmp_path: Path) -> None:
    """Except a checkpoint that the pointer names, or may name."""
    kept = write(tmp_path, [{"rows": columns_of(3, torch.int64)}])
    root = tmp_path / FOLDER
    name = files.make_folder(root, KIND, 4)
    (root / f"{name}.pointer").touch()
    files.discard(root, name)
    assert sorted(path.name for path in root.iterdir()) == sorted([POINTER, kept.name])
    files.discard(root, kept.name)
    assert newest(tmp_path).exists()
    name = files.make_folder(root, KIND, 4)
    for pointer in ("{", json.dumps([name])):
        (root / POINTER).write_text(pointer)
        files.discard(root, name)
        assert (root / name).exists()
    (root / POINTER).unlink()
    files.discard(root, name)
    assert not (root / name).exists()
