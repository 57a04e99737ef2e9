"""Checkpoints of a run, as they are read, and as one process writes them; see `pgccd.sim.checkpoint_files`."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from pgccd.sim.checkpoint_files import (
    FOLDER,
    FORMAT,
    INDEX,
    OWNERS,
    POINTER,
    CheckpointError,
    FileEntry,
    Header,
    Owners,
    make_folder,
    new_name,
    publish,
    write_robots,
)
from pgccd.sim.hashing import id_hash, state_hash
from pgccd.sim.model import ModelConfig, RobotState

_FORMER = "checkpoint.pt"  # of format 1
_NAME = re.compile(r"step-\d{9,12}-[0-9a-f]{8}")
_ROBOTS_FILE = re.compile(r"rank-\d{5,9}\.safetensors")
_WIDTHS = {"position": 3, "orientation": 4, "velocity": 3, "angular_velocity": 3}  # of float64; others are int64


@dataclass
class Checkpoint(Header):
    """A run between two steps."""

    state: RobotState  #: of all robots, ids ascending, on the CPU


class StoredCheckpoint:
    """The newest checkpoint in a run's folder. Its index has been compared with its hash, its other files have not: see
    `verify`.

    Raises:
        CheckpointError: it cannot be read.
    """

    def __init__(self, run_folder: Path) -> None:
        root = run_folder / FOLDER
        pointer = _read_json(root / POINTER, _read_bytes(root / POINTER))
        _require_format(root / POINTER, pointer)
        name, digest = pointer.get("folder"), pointer.get("index_sha256")
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise CheckpointError(f"{root / POINTER}: folder: expected the name of a checkpoint, got {name!r}")
        self.folder = root / name
        path = self.folder / INDEX
        raw = _read_bytes(path)
        if hashlib.sha256(raw).hexdigest() != digest:
            raise CheckpointError(f"{path} is damaged: its hash is not the one in {POINTER}")
        content = _read_json(path, raw)
        _require_format(path, content)
        try:
            config = content["config"] | {"stay_steps": tuple(content["config"]["stay_steps"])}
            #: The run.
            self.header = Header(
                ModelConfig(**config), content["steps_made"], content["steps_wanted"], content["meshes"]
            )
            #: Number of robots.
            self.robots: int = content["robots"]
            self._hashes = content["id_hash"], content["state_hash"]
            self.files = [FileEntry(**entry) for entry in content["files"]]
            self._owners = content.get("owners")
            numbers = [self.header.steps_made, self.header.steps_wanted, self.robots, *self._hashes]
            numbers += [number for entry in self.files for number in (entry.bytes, entry.robots)]
            if not all(type(number) is int and number >= 0 for number in numbers):
                raise ValueError("expected numbers >= 0")
            named = [_ROBOTS_FILE.fullmatch(entry.name) is not None for entry in self.files]
            if not all(named) or sum(entry.robots for entry in self.files) != self.robots:
                raise ValueError("its list of files is not one")
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise CheckpointError(f"{path} is not the index of a checkpoint: {error}") from error

    def verify(self, files: Sequence[FileEntry]) -> None:
        """Compares files with their hashes.

        Raises:
            CheckpointError: naming the first that is missing or not what was written.
        """
        for entry in files:
            path = self.folder / entry.name
            try:
                size = path.stat().st_size
                if size == entry.bytes:
                    with open(path, "rb") as file:
                        digest = hashlib.file_digest(file, "sha256").hexdigest()
            except OSError as error:
                raise CheckpointError(f"{path} cannot be read: {error.strerror or error}") from error
            if size != entry.bytes:
                raise CheckpointError(f"{path} is damaged: it has {size} bytes instead of {entry.bytes}")
            if digest != entry.sha256:
                raise CheckpointError(f"{path} is damaged: its hash is not the one in {INDEX}")

    def rows(self, begin: int, end: int) -> RobotState:
        """Robots [begin, end) in the order of the files.

        Raises:
            CheckpointError: a file cannot be read.
        """
        parts: dict[str, list[Tensor]] = {field.name: [] for field in fields(RobotState)}
        first = 0
        for entry in self.files:
            low, high = max(begin - first, 0), min(end - first, entry.robots)
            first += entry.robots
            if low < high:
                for name, column in self._read(entry, low, high).items():
                    parts[name].append(column)
        empty = _columns_of_none()
        return RobotState(**{name: torch.cat(each) if each else empty[name] for name, each in parts.items()})

    def require_hashes(self, ids: int, states: int) -> None:
        """Raises CheckpointError unless these are the hashes of all robots together."""
        if (ids % 2**64, states % 2**64) != self._hashes:
            raise CheckpointError(f"{self.folder} is damaged: its robots do not have the hashes in {INDEX}")

    def owners(self) -> Owners | None:
        """Of the cells, if it was made by many ranks.

        Raises:
            CheckpointError: they cannot be read.
        """
        if self._owners is None:
            return None
        path = self.folder / OWNERS
        try:
            entry = FileEntry(**self._owners["file"])
            self.verify([FileEntry(OWNERS, entry.bytes, entry.sha256)])
            with safe_open(path, framework="pt") as file:
                return Owners(self._owners["subdomains"], self._owners["cells"], file.get_tensor("owner"))
        except (KeyError, TypeError, SafetensorError) as error:
            raise CheckpointError(f"{path} does not contain the owners of cells: {error}") from error

    def _read(self, entry: FileEntry, begin: int, end: int) -> dict[str, Tensor]:
        path, columns = self.folder / entry.name, {}
        try:
            with safe_open(path, framework="pt") as file:
                for name, empty in _columns_of_none().items():
                    part = file.get_slice(name)
                    expected = [entry.robots, *empty.shape[1:]]
                    if part.get_shape() != expected:
                        raise CheckpointError(f"{path}: {name}: expected shape {expected}, got {part.get_shape()}")
                    columns[name] = part[begin:end]
                    if columns[name].dtype != empty.dtype:
                        raise CheckpointError(f"{path}: {name}: expected {empty.dtype}, got {columns[name].dtype}")
        except (OSError, SafetensorError) as error:
            raise CheckpointError(f"{path} cannot be read: {error}") from error
        return columns


def find_checkpoint(run_folder: Path) -> StoredCheckpoint | None:
    """The newest checkpoint in a run's folder; None if there is none.

    Raises:
        CheckpointError: there is one that cannot be read.
    """
    if (run_folder / FOLDER / POINTER).exists():
        return StoredCheckpoint(run_folder)
    if (run_folder / _FORMER).exists():
        raise CheckpointError(
            f"{run_folder / _FORMER} was written by an earlier version of pgccd (format 1), which must continue the run"
        )
    return None


def require_checkpoint(run_folder: Path) -> StoredCheckpoint:
    """The newest checkpoint.

    Raises:
        FileNotFoundError: there is none.
        CheckpointError: it cannot be read.
    """
    found = find_checkpoint(run_folder)
    if found is None:
        raise FileNotFoundError(f"no checkpoint at {run_folder}")
    return found


def save_checkpoint(run_folder: str | Path, checkpoint: Checkpoint) -> Path:
    """Writes a checkpoint of one process, and makes it the newest one.

    Returns:
        Its folder.

    Raises:
        CheckpointError: it cannot be written; the one before is still there.

    Example:
        >>> pgccd.sim.save_checkpoint("out/copy", pgccd.sim.load_checkpoint("out/try"))
    """
    root = Path(run_folder) / FOLDER
    name = new_name(checkpoint.steps_made)
    make_folder(root / name)
    entry = write_robots(root / name, 0, checkpoint.state.to("cpu"))
    return publish(root, name, checkpoint, [entry])


def load_checkpoint(run_folder: str | Path) -> Checkpoint:
    """The newest checkpoint of a run, whatever number of ranks wrote it; whole, on the CPU.

    Raises:
        FileNotFoundError: there is none.
        CheckpointError: it cannot be read, or is not what was written.

    Example:
        >>> state = pgccd.sim.load_checkpoint("out/try").state
    """
    stored = require_checkpoint(Path(run_folder))
    stored.verify(stored.files)
    state = stored.rows(0, stored.robots)
    stored.require_hashes(id_hash(state.id), state_hash(state))
    order = torch.argsort(state.id)
    ordered = RobotState(**{name: column[order] for name, column in state.columns.items()})
    return Checkpoint(**vars(stored.header), state=ordered)


def forget_checkpoints(run_folder: Path) -> None:
    """Removes all that an earlier run left to continue from."""
    (run_folder / _FORMER).unlink(missing_ok=True)
    root = run_folder / FOLDER
    if root.is_dir():
        (root / POINTER).unlink(missing_ok=True)  # first: what it names is whole as long as it is there
        shutil.rmtree(root)


def _columns_of_none() -> dict[str, Tensor]:
    """Columns of no robots."""
    columns = {}
    for name in (field.name for field in fields(RobotState)):
        shape = (0, _WIDTHS[name]) if name in _WIDTHS else (0,)
        columns[name] = torch.empty(shape, dtype=torch.float64 if name in _WIDTHS else torch.int64)
    return columns


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror or error}") from error


def _read_json(path: Path, raw: bytes) -> dict[str, Any]:
    try:
        content = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{path} cannot be read as JSON: {error}") from error
    if not isinstance(content, dict):
        raise CheckpointError(f"{path}: expected an object, got {type(content).__name__}")
    return content


def _require_format(path: Path, content: Mapping[str, Any]) -> None:
    if content.get("format") != FORMAT:
        raise CheckpointError(f"{path}: its format is {content.get('format')!r}, this version reads {FORMAT}")
