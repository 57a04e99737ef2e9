"""Reading of checkpoints; see `pgccd.checkpoint`."""

import hashlib
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from torch import Tensor

from pgccd.checkpoint.files import (
    DTYPES,
    FOLDER,
    INDEX,
    MOST_STEPS,
    POINTER,
    SHARED,
    CheckpointError,
    FileEntry,
    file_entry,
    file_errors,
    orphans,
    rank_file,
    read_bytes,
    read_json,
    read_pointer,
    require_format,
    rows_hash,
    whole_number,
)
from pgccd.checkpoint.regular import open_regular

# Largest sizes of the header of a safetensors file, and of the tensors of a partition, which has at most 2^31 cells.
_MOST_HEADER, _MOST_SHARED = 1 << 27, 1 << 34

#: The name of a checkpoint, and the content of its index.
Index = tuple[str, dict[str, Any]]


class Stored:
    """The newest checkpoint in a folder. The hash of its index has been checked, those of its other files have not: see
    `verify`.

    Args:
        folder: parent of the folder `checkpoints`.
        kind: expected kind of checkpoint.
        index: `index` as another rank has read it; default: it is read.

    Raises:
        CheckpointError: it cannot be read.
    """

    def __init__(self, folder: Path, kind: str, index: Index | None = None) -> None:
        root = folder / FOLDER
        #: The checkpoint's name, and the content of its index.
        self.index = index = _read_index(root, kind) if index is None else index
        name, content = index
        #: The folder of this checkpoint.
        self.folder = root / name
        path = self.folder / INDEX
        require_format(path, content, kind)
        try:
            self.steps_made: int = whole_number(content["steps_made"])
            #: The header, not validated.
            self.header: dict[str, Any] = content["header"]
            #: Entries of the files, one per writing rank.
            self.files = [file_entry(entry) for entry in content["files"]]
            #: Empty columns of each table, by its name.
            self.layout = {table: _no_rows(columns) for table, columns in content["layout"].items()}
            self._shared = file_entry(content["shared"]) if "shared" in content else None
            if not isinstance(self.header, dict) or not all(self.layout.values()):
                raise ValueError("expected a header, and columns in every table")
            if [entry.name for entry in self.files] != [rank_file(rank) for rank in range(len(self.files))]:
                raise ValueError("its list of files is not one")
            if any(list(entry.tables) != list(self.layout) for entry in self.files):
                raise ValueError("files with other tables than it says")
            if self.steps_made >= MOST_STEPS:
                raise ValueError(f"steps_made: expected a number below {MOST_STEPS}")
            for entry in self.files:
                self._require_plausible(entry)
            if self._shared is not None and self._shared.bytes > _MOST_HEADER + _MOST_SHARED:
                raise ValueError(f"{SHARED}: {self._shared.bytes} bytes")
        except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            problem = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise CheckpointError(f"{path} is not the index of a checkpoint: {problem}") from error

    def _require_plausible(self, entry: FileEntry) -> None:
        """A file is not larger than its rows and safetensors' header: its hash is computed before it is read."""
        rows = 0
        for table, columns in self.layout.items():
            bytes_each = sum(column.dtype.itemsize * math.prod(column.shape[1:]) for column in columns.values())
            rows += entry.tables[table].count * bytes_each
        if not rows < entry.bytes <= rows + _MOST_HEADER:
            raise ValueError(f"{entry.name}: {entry.bytes} bytes for {rows} bytes of rows")

    def row_count(self, table: str) -> int:
        """Number of rows of a table, over all files."""
        return sum(entry.tables[table].count for entry in self.files)

    def verify(self, files: Sequence[FileEntry]) -> None:
        """Checks the hashes of files.

        Raises:
            CheckpointError: naming the first file that is missing or damaged.
        """
        for entry in files:
            path = self.folder / entry.name
            with file_errors(path, "read"), open_regular(path) as file:
                size = os.fstat(file.fileno()).st_size
                if size == entry.bytes:
                    digest = hashlib.file_digest(file, "sha256").hexdigest()
            if size != entry.bytes:
                raise CheckpointError(f"{path} is damaged: it has {size} bytes instead of {entry.bytes}")
            if digest != entry.sha256:
                raise CheckpointError(f"{path} is damaged: its hash is not the one in {INDEX}")

    def rows(self, table: str, begin: int, end: int) -> tuple[dict[str, Tensor], int]:
        """Rows [begin, end) of a table, in the order of the files.

        Returns:
            The columns, and the hash of the rows; `require_hash` takes the sum of the hashes of all rows.

        Raises:
            CheckpointError: a file cannot be read.
        """
        names = list(self.layout[table])
        parts: dict[str, list[Tensor]] = {name: [] for name in names}
        total = 0
        for rank, low, high in self._places(table, begin, end):
            columns = self._read(rank, table, names, low, high)
            total += rows_hash(columns, rank, low)
            for name, column in columns.items():
                parts[name].append(column)
        empty = self.layout[table]
        found = {name: torch.cat(each) if len(each) > 1 else [empty[name], *each][-1] for name, each in parts.items()}
        return found, total % 2**64

    def require_hash(self, table: str, total: int) -> None:
        """Raises CheckpointError unless this is the hash over all rows of a table, modulo 2^64."""
        if (total - sum(entry.tables[table].hash for entry in self.files)) % 2**64:
            raise CheckpointError(f"{self.folder} is damaged: rows of {table} do not have the hash in {INDEX}")

    def first_of(self, table: str, begin: int, counts: str, other: str) -> int:
        """Index of the first row of another table that belongs to row `begin` of this one.

        Args:
            table, begin: the row.
            counts: a column (N,) int64 of `table`: the number of rows of `other` that belong to each row.
            other: the other table.

        Raises:
            CheckpointError: a file cannot be read.
        """
        first = 0
        for rank, entry in enumerate(self.files):
            if begin < entry.tables[table].count:
                return first + int(self._read(rank, table, [counts], 0, begin)[counts].sum())
            begin -= entry.tables[table].count
            first += entry.tables[other].count
        return first

    def shared_bytes(self) -> int:
        """Size of the file of the tensors that are equal on all ranks; 0 without one.

        Raises:
            CheckpointError: it cannot be opened.
        """
        if self._shared is None:
            return 0
        path = self.folder / SHARED
        with file_errors(path, "read"), open_regular(path) as file:
            return os.fstat(file.fileno()).st_size

    def shared(self) -> dict[str, Tensor]:
        """The tensors that are equal on all ranks, with their hash checked.

        Raises:
            CheckpointError: they cannot be read.
        """
        if self._shared is None:
            return {}
        path = self.folder / SHARED
        self.verify([FileEntry(SHARED, self._shared.bytes, self._shared.sha256)])
        with file_errors(path, "read"), safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  (no mapping)

    def _places(self, table: str, begin: int, end: int) -> list[tuple[int, int, int]]:
        """(rank, begin, end) of each file that holds some of the rows."""
        found, first = [], 0
        for rank, entry in enumerate(self.files):
            low, high = max(begin - first, 0), min(end - first, entry.tables[table].count)
            first += entry.tables[table].count
            if low < high:
                found.append((rank, low, high))
        return found

    def _read(self, rank: int, table: str, names: Sequence[str], begin: int, end: int) -> dict[str, Tensor]:
        entry = self.files[rank]
        path, columns = self.folder / entry.name, {}
        with file_errors(path, "read"), safe_open(path, framework="pt") as file:
            for name in names:
                part, empty = file.get_slice(f"{table}/{name}"), self.layout[table][name]
                expected = [entry.tables[table].count, *empty.shape[1:]]
                if part.get_shape() != expected:
                    raise CheckpointError(f"{path}: {name!r}: expected shape {expected}, got {part.get_shape()}")
                columns[name] = part[begin:end]
                if columns[name].dtype != empty.dtype:
                    raise CheckpointError(f"{path}: {name!r}: expected {empty.dtype}, got {columns[name].dtype}")
        return columns


def has_checkpoint(folder: Path) -> bool:
    """Whether a folder holds a checkpoint.

    Raises:
        CheckpointError: it holds checkpoints, but not the file that names the newest one.
    """
    root = folder / FOLDER
    if os.path.lexists(root / POINTER):
        return True
    if found := orphans(root):
        raise CheckpointError(f"{root} has lost {POINTER}, but holds {', '.join(found[:2])}")
    return False


def _read_index(root: Path, kind: str) -> Index:
    name, digest = read_pointer(root, kind)
    path = root / name / INDEX
    raw = read_bytes(path)
    if hashlib.sha256(raw).hexdigest() != digest:
        raise CheckpointError(f"{path} is damaged: its hash is not the one in {POINTER}")
    return name, read_json(path, raw)


def _no_rows(columns: Mapping[str, Any]) -> dict[str, Tensor]:
    return {
        name: torch.empty((0, *map(whole_number, shape)), dtype=DTYPES[dtype])
        for name, (dtype, shape) in columns.items()
    }
