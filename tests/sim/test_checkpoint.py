"""Checkpoints: whole at any moment, refused if anything in them was changed, and never executed."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pgccd import sim
from pgccd.sim import checkpoint_files as module
from pgccd.sim.checkpoint import find_checkpoint
from pgccd.sim.checkpoint_files import FOLDER, POINTER, Owners, new_name, publish, write_robots

CONFIG = sim.ModelConfig(robots=30, pattern="skewed", seed=3)
HEADER = module.Header(CONFIG, 1, 2, "digest")


def start_state() -> sim.RobotState:
    return sim.Model(CONFIG).start()


def write(folder: Path, steps_made: int, ranks: int = 3) -> Path:
    """A checkpoint as many ranks write it."""
    root, name, state = folder / FOLDER, new_name(steps_made), start_state()
    module.make_folder(root / name)
    files = []
    for rank in range(ranks):
        part = {name: column[rank::ranks].clone() for name, column in state.columns.items()}
        files.append(write_robots(root / name, rank, sim.RobotState(**part)))
    header = module.Header(CONFIG, steps_made, 20, "digest")
    return publish(root, name, header, files, Owners([1, 1, 3], [2, 2, 2], torch.arange(24) % 3))


def same(found: sim.RobotState, expected: sim.RobotState) -> bool:
    return all(torch.equal(getattr(found, name), column) for name, column in expected.columns.items())


def read_all(folder: Path) -> sim.Checkpoint:
    """Everything that is in the newest one."""
    stored = find_checkpoint(folder)
    assert stored is not None
    stored.owners()
    return sim.load_checkpoint(folder)


def test_what_was_written_is_read(tmp_path: Path) -> None:
    write(tmp_path, 7)
    found = sim.load_checkpoint(tmp_path)
    assert same(found.state, start_state())
    assert (found.config, found.steps_made, found.steps_wanted, found.meshes) == (CONFIG, 7, 20, "digest")
    stored = find_checkpoint(tmp_path)
    assert stored is not None
    owners = stored.owners()
    assert owners is not None and owners.owner.tolist() == [k % 3 for k in range(24)]
    # The rows of ranks follow one another.
    assert stored.rows(8, 13).id.tolist() == [24, 27, 1, 4, 7] and len(stored.rows(30, 30)) == 0
    sim.save_checkpoint(tmp_path / "again", found)
    assert same(sim.load_checkpoint(tmp_path / "again").state, start_state())
    assert find_checkpoint(tmp_path / "none") is None


def test_only_the_newest_is_kept(tmp_path: Path) -> None:
    first = write(tmp_path, 5)
    again = write(tmp_path, 5)  # of the same step
    assert first != again and not first.exists() and again.exists()
    (tmp_path / FOLDER / "step-000000006-00000000").mkdir()  # of a job that was killed while it wrote
    (tmp_path / FOLDER / "step-000000006-00000000.pointer").touch()
    newest = write(tmp_path, 6)
    assert sorted(path.name for path in (tmp_path / FOLDER).iterdir()) == sorted([POINTER, newest.name])


@pytest.mark.parametrize("call", ["save_file", "_sync", "_write_bytes", "replace"])
@pytest.mark.parametrize("number", range(8))
def test_a_failure_leaves_a_whole_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, number: int) -> None:
    """Of the disk, at any moment."""
    write(tmp_path, 5)
    owner: Any = module.os if call == "replace" else module
    original, calls = getattr(owner, call), 0

    def fail(*arguments: Any, **more: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == number + 1:
            raise OSError(28, "No space left on device")
        return original(*arguments, **more)

    with monkeypatch.context() as patch:
        patch.setattr(owner, call, fail)
        try:
            write(tmp_path, 6)
            failed = False
        except module.CheckpointError as error:
            assert "cannot be written: " in str(error) and "No space left on device" in str(error)
            failed = True
    assert failed == (calls > number)
    # The last thing that may fail is to make sure of the pointer, when it has been replaced.
    is_last = failed and call == "_sync" and number == 6
    assert read_all(tmp_path).steps_made == (5 if failed and not is_last else 6)
    write(tmp_path, 7)
    assert read_all(tmp_path).steps_made == 7 and len(list((tmp_path / FOLDER).iterdir())) == 2


def mutations(raw: bytes, rng: np.random.Generator) -> list[bytes]:
    """One of each kind."""
    at, end = sorted(rng.integers(0, len(raw), 2).tolist())
    flipped = bytearray(raw)
    flipped[at] ^= 1 << int(rng.integers(8))
    noise = rng.integers(0, 256, 7, dtype=np.uint8).tobytes()
    digit = bytearray(raw)
    digits = [k for k, byte in enumerate(raw[:4096]) if chr(byte).isdigit()]
    digit[digits[int(rng.integers(len(digits)))]] = 48 + int(rng.integers(10))
    cut, dropped, repeated = raw[:at], raw[:at] + raw[end:], raw[:end] + raw[at:]
    return [bytes(flipped), cut, dropped, repeated, raw[:at] + noise + raw[at:], raw + noise, bytes(digit)]


def test_any_change_is_refused_in_one_line_or_makes_no_difference(tmp_path: Path) -> None:
    folder, expected = write(tmp_path, 7, ranks=2), start_state()
    files = [tmp_path / FOLDER / POINTER, *folder.iterdir()]
    rng, tried, refused = np.random.default_rng(7), 0, 0
    while tried < 10_000:
        path = files[tried % len(files)]
        raw = path.read_bytes()
        for changed in mutations(raw, rng):
            path.write_bytes(changed)
            tried += 1
            try:
                found = read_all(tmp_path)
            except module.CheckpointError as error:
                refused += 1
                assert str(tmp_path) in str(error) and len(str(error).splitlines()) == 1
            else:
                assert same(found.state, expected) and found.steps_made == 7 and found.config == CONFIG
        path.write_bytes(raw)
    assert refused > 0.9 * tried
    assert same(read_all(tmp_path).state, expected)


@pytest.mark.parametrize("missing", ["index.json", "rank-00001.safetensors", "owners.safetensors", ""])
def test_a_file_that_is_missing_is_named(tmp_path: Path, missing: str) -> None:
    folder = write(tmp_path, 7)
    (folder / missing).unlink() if missing else shutil.rmtree(folder)
    with pytest.raises(module.CheckpointError, match=f"{missing or 'index.json'} cannot be read: No such file"):
        read_all(tmp_path)


class Runs:
    """Makes a folder when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)

    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return os.mkdir, (self.path,)


def test_nothing_in_a_checkpoint_is_executed(tmp_path: Path) -> None:
    folder, proof = write(tmp_path, 7), tmp_path / "executed"
    bomb = pickle.dumps(Runs(proof))
    for path in [*folder.iterdir(), tmp_path / FOLDER / POINTER]:
        raw = path.read_bytes()
        path.write_bytes(bomb)
        with pytest.raises(module.CheckpointError):
            read_all(tmp_path)
        path.write_bytes(raw)
    for path in (folder / ".metadata", tmp_path / "checkpoint.pt"):
        path.write_bytes(bomb)
    assert read_all(tmp_path).steps_made == 7 and not proof.exists()
    pickle.loads(bomb)
    assert proof.exists()


def plant(tmp_path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Changes the index, and the pointer with it."""
    pointer = tmp_path / FOLDER / POINTER
    content = json.loads(pointer.read_text())
    path = tmp_path / FOLDER / content["folder"] / "index.json"
    index = json.loads(path.read_text())
    change(index)
    path.write_text(json.dumps(index))
    content["index_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    pointer.write_text(json.dumps(content))


CHANGES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "elsewhere": lambda index: index["files"][0].update(name="../../outside.safetensors"),
    "absolute": lambda index: index["files"][0].update(name="/etc/passwd"),
    "number of robots": lambda index: index["files"][0].update(robots=11),
    "negative numbers": lambda index: [index["files"][k].update(robots=r) for k, r in enumerate((-10, 20, 20))],
    "no number": lambda index: index.update(robots="30"),
    "all robots": lambda index: index.update(robots=31),
    "fewer files": lambda index: index["files"].pop(),
    "no list": lambda index: index.update(files=None),
    "another key": lambda index: index["files"][0].update(command="rm"),
    "configuration": lambda index: index["config"].update(robots=-4),
    "no configuration": lambda index: index.pop("config"),
    "steps": lambda index: index.update(steps_made="many"),
    "negative steps": lambda index: index.update(steps_made=-1),
    "state": lambda index: index.update(state_hash=5),
    "ids": lambda index: index.update(id_hash="x"),
    "format": lambda index: index.update(format=3),
    "owners": lambda index: index.update(owners=[]),
    "owners' file": lambda index: index["owners"].update(file={}),
}


@pytest.mark.parametrize("change", list(CHANGES))
def test_an_index_that_was_planted(tmp_path: Path, change: str) -> None:
    folder = write(tmp_path, 7)
    shutil.copy(folder / "rank-00000.safetensors", tmp_path / "outside.safetensors")
    plant(tmp_path, CHANGES[change])
    with pytest.raises(module.CheckpointError) as refused:
        read_all(tmp_path)
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize("name", ["../elsewhere", "/tmp", "step-000000007", "", None, 7, "step-000000007-0123456g"])
def test_a_pointer_that_was_planted(tmp_path: Path, name: Any) -> None:
    write(tmp_path, 7)
    pointer = tmp_path / FOLDER / POINTER
    pointer.write_text(json.dumps(json.loads(pointer.read_text()) | {"folder": name}))
    with pytest.raises(module.CheckpointError, match="folder: expected the name of a checkpoint"):
        read_all(tmp_path)


@pytest.mark.parametrize("problem", ["torch.float64", "[30, 3]", "[30]", "missing"])
def test_columns_of_other_types(tmp_path: Path, problem: str) -> None:
    """With the right hashes, as a version with another layout might write them."""
    columns = start_state().columns
    changes = {
        "torch.float64": {"position": columns["position"].float()},
        "[30, 3]": {"position": columns["position"][:, :2].contiguous()},
        "[30]": {"id": columns["id"][:-1].clone()},
    }
    columns |= changes.get(problem, {})
    if problem == "missing":
        del columns["velocity"]
    root, name = tmp_path / FOLDER, new_name(1)
    module.make_folder(root / name)
    publish(root, name, HEADER, [module.write_tensors(root / name / "rank-00000.safetensors", columns, 30, 0, 0)])
    with pytest.raises(module.CheckpointError) as refused:
        read_all(tmp_path)
    assert problem == "missing" or f"expected {problem}" in str(refused.value).replace("expected shape", "expected")
    assert len(str(refused.value).splitlines()) == 1


def test_one_of_an_earlier_version(tmp_path: Path) -> None:
    (tmp_path / "checkpoint.pt").write_bytes(b"")
    with pytest.raises(module.CheckpointError, match="written by an earlier version"):
        sim.resume(tmp_path)
    with pytest.raises(ValueError, match="holds an earlier run .*written by an earlier version"):
        sim.run(CONFIG, 1, tmp_path)
    assert sim.run(CONFIG, 1, tmp_path, overwrite=True).steps_made == 1
    write(tmp_path / "ranks", 3)
    (tmp_path / "ranks" / FOLDER / POINTER).write_text('{"format": 1, "folder": "step-000000003"}')
    with pytest.raises(module.CheckpointError, match="its format is 1, this version reads 2"):
        sim.resume(tmp_path / "ranks")


def test_a_folder_that_cannot_be_written_to(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="^folder: cannot write to .*: Not a directory"):
        sim.run(CONFIG, 1, tmp_path / "file" / "run")
