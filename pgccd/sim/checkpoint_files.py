"""Checkpoints of a run: robots in safetensors files, all else in JSON. Nothing in them is executed or unpickled.

    checkpoints/newest.json                      names the newest whole one, and the hash of its index; replaced last
    checkpoints/step-000000020-1f0c9a27/
        index.json                               the run, its robots' number and hashes; size and hash of each file
        rank-00000.safetensors, ...              columns of robots, one file a rank that wrote
        owners.safetensors                       of many ranks: the owner of each cell

Every checkpoint is a new folder. Its files are on the disk before the index, and that before `newest.json`; the one
named before is removed last. So there is a whole checkpoint at any moment after the first. What is read is first
compared with its hash: a file that was changed, cut off or exchanged is refused.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from pgccd.sim.hashing import id_hash, state_hash
from pgccd.sim.model import ModelConfig, RobotState

FOLDER = "checkpoints"
POINTER = "newest.json"
FORMAT = 2
INDEX = "index.json"
OWNERS = "owners.safetensors"


class CheckpointError(ValueError):
    """A checkpoint cannot be read or written; the message names the file."""


@dataclass
class Header:
    """A run between two steps, without its robots."""

    config: ModelConfig
    steps_made: int
    steps_wanted: int
    meshes: str  #: their `meshes_digest`


@dataclass(frozen=True)
class Owners:
    """The owner of each cell, and how space was cut."""

    subdomains: Sequence[int]
    cells: Sequence[int]
    owner: Tensor  #: (cells,) int64


@dataclass(frozen=True)
class FileEntry:
    """What the index says of a file."""

    name: str
    bytes: int
    sha256: str
    robots: int = 0
    id_hash: int = 0  #: of its robots, modulo 2^64
    state_hash: int = 0


def new_name(steps_made: int) -> str:
    """Of the folder of a checkpoint; no two are alike."""
    return f"step-{steps_made:09d}-{secrets.token_hex(4)}"


def make_folder(folder: Path) -> None:
    """Makes the folder of a checkpoint.

    Raises:
        CheckpointError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise CheckpointError(f"{folder} cannot be made: {error.strerror or error}") from error


def write_robots(folder: Path, rank: int, state: RobotState) -> FileEntry:
    """Writes one rank's robots, whose columns are on the CPU. They are on the disk when it returns.

    Raises:
        CheckpointError: it cannot be written.
    """
    columns = {name: column.contiguous() for name, column in state.columns.items()}
    hashes = id_hash(state.id), state_hash(state)
    return write_tensors(folder / f"rank-{rank:05d}.safetensors", columns, len(state), *hashes)


def publish(root: Path, name: str, header: Header, files: Sequence[FileEntry], owners: Owners | None = None) -> Path:
    """Completes a checkpoint whose robots have been written, makes it the newest one, and removes all others.

    Args:
        root: the run's folder `checkpoints`.
        name: of the checkpoint's folder in it.
        header: the run.
        files: of all ranks.
        owners: of many ranks.

    Raises:
        CheckpointError: it cannot be written; the one before is still there.
    """
    folder = root / name
    content: dict[str, Any] = {"format": FORMAT, **_plain(header)}
    content |= {"robots": sum(entry.robots for entry in files), "files": [asdict(entry) for entry in files]}
    content |= {each: sum(getattr(entry, each) for entry in files) % 2**64 for each in ("id_hash", "state_hash")}
    if owners is not None:
        entry = write_tensors(folder / OWNERS, {"owner": owners.owner.cpu().contiguous()})
        cut = {"subdomains": list(owners.subdomains), "cells": list(owners.cells)}
        content["owners"] = {**cut, "file": asdict(entry)}
    try:
        index = json.dumps(content, indent=1).encode()
        _write_bytes(folder / INDEX, index)
        _sync(folder)
        _sync(root)  # which names the folder
        pointer = {"format": FORMAT, "folder": name, "index_sha256": hashlib.sha256(index).hexdigest()}
        unfinished = root / f"{name}.pointer"
        _write_bytes(unfinished, json.dumps(pointer).encode())
        os.replace(unfinished, root / POINTER)
        _sync(root)
    except OSError as error:
        raise CheckpointError(f"{folder} cannot be written: {error.strerror or error}") from error
    _remove_others(root, name)
    return folder


def _plain(header: Header) -> dict[str, Any]:
    counts = {"steps_made": header.steps_made, "steps_wanted": header.steps_wanted}
    return {"config": asdict(header.config), "meshes": header.meshes, **counts}


def write_tensors(path: Path, tensors: Mapping[str, Tensor], *about_robots: int) -> FileEntry:
    """Writes a file, and waits until it is on the disk. about_robots: the last fields of its entry."""
    try:
        save_file(dict(tensors), path)
        _sync(path)
        with open(path, "rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        return FileEntry(path.name, path.stat().st_size, digest, *about_robots)
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path} cannot be written: {error}") from error


def _write_bytes(path: Path, content: bytes) -> None:
    with open(path, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync(path: Path) -> None:
    """Waits until a file, or the names in a folder, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _remove_others(root: Path, kept: str) -> None:
    """Checkpoints that are not named any more, and what was left of unfinished ones."""
    for other in root.iterdir():
        if other.name not in (kept, POINTER) and other.name.startswith("step-"):
            if other.is_dir() and not other.is_symlink():
                shutil.rmtree(other, ignore_errors=True)
            else:
                other.unlink(missing_ok=True)
