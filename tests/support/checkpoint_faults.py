"""Damage to the files of a checkpoint: random changes of bytes, a planted index, a pickle that runs code."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pgccd.checkpoint.files import FOLDER, POINTER


def newest(folder: Path) -> Path:
    """The folder of the newest checkpoint."""
    return folder / FOLDER / json.loads((folder / FOLDER / POINTER).read_text())["folder"]


def files_of(folder: Path) -> list[Path]:
    """The pointer, and all files of the newest checkpoint but the copy of the pointer, which is not read."""
    return [folder / FOLDER / POINTER, *(path for path in sorted(newest(folder).iterdir()) if path.name != POINTER)]


def mutations(raw: bytes, rng: np.random.Generator) -> list[bytes]:
    """One mutation of each kind."""
    at, end = sorted(rng.integers(0, len(raw), 2).tolist())
    flipped = bytearray(raw)
    flipped[at] ^= 1 << int(rng.integers(8))
    noise = rng.integers(0, 256, 7, dtype=np.uint8).tobytes()
    digit = bytearray(raw)
    digits = [k for k, byte in enumerate(raw[:4096]) if chr(byte).isdigit()]
    digit[digits[int(rng.integers(len(digits)))]] = 48 + int(rng.integers(10))
    cut, dropped, repeated = raw[:at], raw[:at] + raw[end:], raw[:end] + raw[at:]
    return [bytes(flipped), cut, dropped, repeated, raw[:at] + noise + raw[at:], raw + noise, bytes(digit)]


def changes_by_chance(folder: Path, count: int) -> Iterator[None]:
    """Changes one of the files at a time, and restores it afterwards."""
    files, rng, tried = files_of(folder), np.random.default_rng(7), 0
    while tried < count:
        path = files[tried % len(files)]
        raw = path.read_bytes()
        for changed in mutations(raw, rng):
            path.write_bytes(changed)
            tried += 1
            yield
        path.write_bytes(raw)


def plant(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Changes the index, and the pointer accordingly."""
    pointer, path = folder / FOLDER / POINTER, newest(folder) / "index.json"
    index = json.loads(path.read_text())
    change(index)
    path.write_text(json.dumps(index))
    content = json.loads(pointer.read_text())
    content["index_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    pointer.write_text(json.dumps(content))


class Runs:
    """Creates a folder when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)

    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return os.mkdir, (self.path,)
