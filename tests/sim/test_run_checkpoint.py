"""Checkpoints: complete at any time, rejected if modified, and never executed."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import pickle
import re
import shutil
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from support.checkpoint_faults import Runs, changes_by_chance, files_of, newest, plant

from pgccd import sim
from pgccd.checkpoint import files as module
from pgccd.checkpoint.files import FOLDER, POINTER
from pgccd.sim.run_checkpoint import KIND, ROBOTS, Header, find_checkpoint
from pgccd.sim.run_folder import mesh_files

CONFIG = sim.ModelConfig(robots=30, pattern="skewed", seed=3)


def start_state() -> sim.RobotState:
    return sim.Model(CONFIG).start()


def write(folder: Path, steps_made: int, ranks: int = 3, keep: int = module.KEEP) -> Path:
    """A checkpoint as written by many ranks."""
    root, state = folder / FOLDER, start_state()
    name = module.make_folder(root, KIND, steps_made)
    files = []
    for rank in range(ranks):
        part = {name: column[rank::ranks].clone() for name, column in state.columns.items()}
        files.append(module.write_tables(root / name, rank, {ROBOTS: part}))
    header = Header(CONFIG, steps_made, 20, "digest")
    content = module.Content(KIND, steps_made, header.plain, {"owner": torch.arange(24) % 3})
    return module.publish(root, name, content, module.layout_of({ROBOTS: part}), files, keep)


def same(found: sim.RobotState, expected: sim.RobotState) -> bool:
    return all(torch.equal(getattr(found, name), column) for name, column in expected.columns.items())


def read_all(folder: Path) -> sim.Checkpoint:
    """Reads everything in the newest checkpoint."""
    stored = find_checkpoint(folder)
    assert stored is not None
    stored.shared()
    return sim.load_checkpoint(folder)


def test_what_was_written_is_read(tmp_path: Path) -> None:
    write(tmp_path, 7)
    found = sim.load_checkpoint(tmp_path)
    assert same(found.state, start_state())
    assert (found.config, found.steps_made, found.steps_wanted, found.meshes) == (CONFIG, 7, 20, "digest")
    stored = find_checkpoint(tmp_path)
    assert stored is not None
    assert stored.shared()["owner"].tolist() == [k % 3 for k in range(24)]
    # Rows are concatenated by rank.
    parts = [stored.rows(ROBOTS, begin, end) for begin, end in ((0, 8), (8, 13), (13, 30), (30, 30))]
    assert parts[1][0]["id"].tolist() == [24, 27, 1, 4, 7] and parts[3][0]["position"].shape == (0, 3)
    stored.require_hash(ROBOTS, sum(total for _, total in parts))
    assert find_checkpoint(tmp_path / "none") is None


@pytest.mark.parametrize("keep", [1, 2, 3])
def test_only_the_newest_are_kept(tmp_path: Path, keep: int) -> None:
    written = [write(tmp_path, 5, keep=keep), write(tmp_path, 5, keep=keep)]  # of the same step
    assert written[0] != written[1]
    for steps_made in (6, 7, 8):
        (tmp_path / FOLDER / "step-000000006-00000000").mkdir()  # of a job killed while writing it
        (tmp_path / FOLDER / "step-000000006-00000000.pointer").touch()
        written.append(write(tmp_path, steps_made, keep=keep))
        kept = [path.name for path in written[-keep:]]
        assert sorted(path.name for path in (tmp_path / FOLDER).iterdir()) == sorted([POINTER, *kept])
    assert read_all(tmp_path).steps_made == 8
    # One before it, if the newest is damaged.
    (written[-1] / "index.json").write_text("{}")
    with pytest.raises(module.CheckpointError, match="is damaged"):
        read_all(tmp_path)
    if keep > 1:
        shutil.copy(written[-2] / POINTER, tmp_path / FOLDER)
        assert read_all(tmp_path).steps_made == 7


def test_the_number_kept_is_checked(tmp_path: Path) -> None:
    for keep in (0, -1, 1.5, True):
        with pytest.raises((ValueError, TypeError), match="^keep: expected a number of checkpoints >= 1"):
            sim.run(CONFIG, 1, tmp_path / "run", keep=keep)


def test_files_that_are_not_seen_make_no_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a rank that writes to a folder of its own."""
    monkeypatch.setattr(module, "_SEEN_WITHIN", 0.2)
    write(tmp_path, 5)
    written = module.write_tables

    def elsewhere(folder: Path, rank: int, tables: Any) -> Any:
        entry = written(folder, rank, tables)
        if rank == 1:
            (folder / entry.name).unlink()
        return entry

    monkeypatch.setattr(module, "write_tables", elsewhere)
    said = r"rank-00001.safetensors, which rank 1 has written, is not seen by rank 0$"
    with pytest.raises(module.CheckpointError, match=said):
        write(tmp_path, 6)
    assert read_all(tmp_path).steps_made == 5
    # A file may be seen late.
    monkeypatch.setattr(module, "_SEEN_WITHIN", 20.0)

    def late(folder: Path, rank: int, tables: Any) -> Any:
        entry = written(folder, rank, tables)
        hidden = folder / f"{rank}"
        (folder / entry.name).rename(hidden)
        threading.Timer(0.3, lambda: hidden.rename(folder / entry.name)).start()
        return entry

    monkeypatch.setattr(module, "write_tables", late)
    write(tmp_path, 7)
    assert read_all(tmp_path).steps_made == 7


@pytest.mark.parametrize("name", [POINTER, "index.json", "rank-00000.safetensors", "lock", "log"])
@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "sparse", "link to a pipe", "long"])
@pytest.mark.timeout(60)  # of one that waits
def test_what_is_no_sane_file_is_refused_at_once(tmp_path: Path, name: str, kind: str) -> None:
    """Neither waits for a writer nor fills the memory."""
    sim.run(CONFIG, 7, tmp_path)
    folder = newest(tmp_path)
    places = {POINTER: tmp_path / FOLDER / POINTER, "lock": tmp_path / "lock", "log": tmp_path / "steps.jsonl"}
    path = places.get(name, folder / name)
    path.unlink(missing_ok=True)
    if kind in ("pipe", "link to a pipe"):
        os.mkfifo(tmp_path / "pipe")
        (tmp_path / "pipe").rename(path) if kind == "pipe" else path.symlink_to(tmp_path / "pipe")
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    elif kind == "long":
        path.write_text(json.dumps({"folder": "x\n" * 10_000, "format": "y" * 10_000, "kind": 3}))
    else:
        with open(path, "wb") as file:
            file.truncate(1 << 40)
    begin = time.process_time()
    is_harmless = (name == "lock" and kind in ("long", "sparse")) or (name == "log" and kind == "long")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the log lacks lines
            sim.resume(tmp_path, 7)
    except ValueError as error:
        assert not is_harmless, error
        assert not isinstance(error, FileNotFoundError) and str(path.name) in str(error)
        assert len(str(error)) < 300 + len(str(tmp_path)) and len(str(error).splitlines()) == 1
    else:
        assert is_harmless
    assert time.process_time() - begin < 10.0


@pytest.mark.parametrize("name", [POINTER, "index.json"])
@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("NaN", "expected finite numbers, got NaN"),
        ("infinity", "expected finite numbers, got 1e999"),
        ("repeated", "the key 'kind' is repeated"),
        ("UTF-16", "codec can't decode"),
        ("deep", "recursion"),
        ("digits", "Exc"),
        ("many", r"it has \d+ bytes, more than \d+"),
    ],
)
def test_json_that_two_readers_may_read_differently(tmp_path: Path, name: str, kind: str, said: str) -> None:
    """Or that takes more memory or depth than any checkpoint does; with valid hashes."""
    folder = write(tmp_path, 7)
    path = tmp_path / FOLDER / POINTER if name == POINTER else folder / name
    values = {"NaN": "NaN", "infinity": "1e999", "deep": "[" * 20_000 + "]" * 20_000, "digits": "9" * 5_000}
    values |= {"many": "[" + "[]," * (1 << 24) + "0]"}
    key = "kind" if kind == "repeated" else "more"
    text = f'{{"{key}": {values.get(kind, "0")}, {path.read_text().lstrip()[1:]}'
    raw = text.encode("utf-16" if kind == "UTF-16" else "utf-8")
    path.write_bytes(raw)
    if name != POINTER:
        pointer = tmp_path / FOLDER / POINTER
        digest = {"index_sha256": hashlib.sha256(raw).hexdigest()}
        pointer.write_text(json.dumps(json.loads(pointer.read_text()) | digest))
    begin = time.monotonic()
    with pytest.raises(module.CheckpointError, match=said) as refused:
        read_all(tmp_path)
    assert name in str(refused.value) and len(str(refused.value).splitlines()) == 1 and len(str(refused.value)) < 300
    assert time.monotonic() - begin < 10.0


@pytest.mark.parametrize("name", ["rank-00001.safetensors", "shared.safetensors"])
def test_a_file_that_is_larger_than_its_rows(tmp_path: Path, name: str) -> None:
    """A terabyte of holes, with its size in the index: refused before its hash is computed."""
    with open(write(tmp_path, 7) / name, "r+b") as file:
        file.truncate(1 << 40)
    is_shared = name.startswith("shared")
    plant(tmp_path, lambda index: (index["shared"] if is_shared else index["files"][1]).update(bytes=1 << 40))
    begin = time.monotonic()
    with pytest.raises(module.CheckpointError, match=f"{name}: {1 << 40} bytes"):
        read_all(tmp_path)
    assert time.monotonic() - begin < 5.0


@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "link to nothing"])
@pytest.mark.parametrize("name", ["rank-00002.safetensors", "shared.safetensors", ""])
def test_files_of_many_ranks_that_are_none(tmp_path: Path, name: str, kind: str) -> None:
    """And in place of the checkpoint's folder."""
    path = write(tmp_path, 7) / name
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero" if kind == "device" else tmp_path / "nothing")
    with pytest.raises(module.CheckpointError) as refused:
        read_all(tmp_path)
    assert str(path) in str(refused.value) and len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize(
    "kind", ["pipe", "device", "folder", "sparse", "NaN", "repeated", "UTF-16", "deep", "a number"]
)
def test_a_description_of_a_run_that_is_none(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "world.json"
    texts = {"NaN": '{"a": NaN}', "repeated": '{"a": 1, "a": 2}', "deep": "[" * 20_000, "a number": "3"}
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    elif kind == "sparse":
        path.touch()
        os.truncate(path, 1 << 40)
    else:
        path.write_text(texts.get(kind, "{}"), encoding="utf-16" if kind == "UTF-16" else "utf-8")
    with pytest.raises(ValueError, match="world.json") as refused:
        mesh_files(tmp_path)
    assert len(str(refused.value).splitlines()) == 1 and len(str(refused.value)) < 300


def fail_at(patch: pytest.MonkeyPatch, call: str, number: int, error: BaseException) -> Iterator[int]:
    """Makes a call of a function fail, counted from 0. Returns the counter, whose next value is the number of calls."""
    owner: Any = module.os if call == "replace" else module
    original, calls = getattr(owner, call), itertools.count()

    def fail(*arguments: Any, **more: Any) -> Any:
        if next(calls) == number:
            raise error
        return original(*arguments, **more)

    patch.setattr(owner, call, fail)
    return calls


@pytest.mark.parametrize("call", ["save_file", "_sync", "_write_bytes", "replace"])
@pytest.mark.parametrize("number", range(8))
def test_a_failure_leaves_a_whole_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, number: int) -> None:
    """A disk failure at any time."""
    write(tmp_path, 5)
    with monkeypatch.context() as patch:
        calls = fail_at(patch, call, number, OSError(28, "No space left on device"))
        try:
            write(tmp_path, 6)
            failed = False
        except module.CheckpointError as error:
            assert "cannot be written: " in str(error) and "No space left on device" in str(error)
            failed = True
    assert failed == (next(calls) > number)
    # The last operation that may fail is the sync of the pointer, after it has been replaced.
    is_last = failed and call == "_sync" and number == 6
    assert read_all(tmp_path).steps_made == (5 if failed and not is_last else 6)
    write(tmp_path, 7)
    assert read_all(tmp_path).steps_made == 7 and len(list((tmp_path / FOLDER).iterdir())) == 3


@pytest.mark.parametrize("count", [2_000, pytest.param(10_000, marks=pytest.mark.slow)])
def test_any_change_is_refused_in_one_line_or_makes_no_difference(tmp_path: Path, count: int) -> None:
    write(tmp_path, 7, ranks=2)
    expected, refused = start_state(), 0
    for _ in changes_by_chance(tmp_path, count):
        try:
            found = read_all(tmp_path)
        except module.CheckpointError as error:
            refused += 1
            assert str(tmp_path) in str(error) and len(str(error).splitlines()) == 1 and len(str(error)) < 300
        else:
            assert same(found.state, expected) and found.steps_made == 7 and found.config == CONFIG
    assert refused > 0.9 * count
    assert same(read_all(tmp_path).state, expected)


@pytest.mark.parametrize("missing", ["index.json", "rank-00001.safetensors", "shared.safetensors", ""])
def test_a_file_that_is_missing_is_named(tmp_path: Path, missing: str) -> None:
    folder = write(tmp_path, 7)
    (folder / missing).unlink() if missing else shutil.rmtree(folder)
    with pytest.raises(module.CheckpointError, match=f"{missing or 'index.json'} cannot be read: No such file"):
        read_all(tmp_path)


def test_nothing_in_a_checkpoint_is_executed(tmp_path: Path) -> None:
    folder, proof = write(tmp_path, 7), tmp_path / "executed"
    bomb = pickle.dumps(Runs(proof))
    for path in files_of(tmp_path):
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


CHANGES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "elsewhere": lambda index: index["files"][0].update(name="../../outside.safetensors"),
    "absolute": lambda index: index["files"][0].update(name="/etc/passwd"),
    "number of robots": lambda index: index["files"][0]["tables"]["robots"].update(count=11),
    "negative numbers": lambda index: [
        index["files"][k]["tables"]["robots"].update(count=r) for k, r in enumerate((-10, 20, 20))
    ],
    "no number": lambda index: index["files"][0]["tables"]["robots"].update(count="10"),
    "no bytes": lambda index: index["files"][0].update(bytes=None),
    "all robots": lambda index: index["header"]["config"].update(robots=31),
    "fewer files": lambda index: index["files"].pop(),
    "no list": lambda index: index.update(files=None),
    "another key": lambda index: index["files"][0].update(command="rm"),
    "another table": lambda index: index["files"][0]["tables"].update(more={"count": 0, "hash": 0}),
    "no table": lambda index: index["files"][0]["tables"].clear(),
    "configuration": lambda index: index["header"]["config"].update(robots=-4),
    "no configuration": lambda index: index["header"].pop("config"),
    "no header": lambda index: index.update(header=[]),
    "steps": lambda index: index.update(steps_made="many"),
    "too many steps": lambda index: index.update(steps_made=10**12),
    "a step of 30 digits": lambda index: index.update(steps_made=10**30),
    "bytes of 30 digits": lambda index: index["files"][0].update(bytes=10**30),
    "too few bytes": lambda index: index["files"][0].update(bytes=8),
    "negative steps": lambda index: index.update(steps_made=-1),
    "steps wanted": lambda index: index["header"].update(steps_wanted="many"),
    "state": lambda index: index["files"][1]["tables"]["robots"].update(hash=5),
    "no hash": lambda index: index["files"][1]["tables"]["robots"].update(hash="x"),
    "format": lambda index: index.update(format=2),
    "kind": lambda index: index.update(kind="world"),
    "no layout": lambda index: index.update(layout={}),
    "a layout without columns": lambda index: index["layout"].update(robots={}),
    "another layout": lambda index: index["layout"]["robots"].update(position=["float64", [2]]),
    "more columns": lambda index: index["layout"]["robots"].update(mood=["float64", []]),
    "an unknown type": lambda index: index["layout"]["robots"].update(position=["object", [3]]),
    "a large layout": lambda index: index["layout"]["robots"].update(position=["float64", [2**80]]),
    "the rows of another": lambda index: index["files"].reverse(),
    "shared": lambda index: index.update(shared=[]),
    "shared file": lambda index: index.update(shared={}),
    "a field of the model is missing": lambda index: index["header"]["config"].pop("stopping_round"),
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


def write_columns(folder: Path, columns: dict[str, torch.Tensor], told: dict[str, torch.Tensor]) -> None:
    """A checkpoint whose index declares other columns than its file holds."""
    root = folder / FOLDER
    name = module.make_folder(root, KIND, 1)
    entry = module.write_tables(root / name, 0, {ROBOTS: columns})
    content = module.Content(KIND, 1, Header(CONFIG, 1, 2, "digest").plain)
    module.publish(root, name, content, module.layout_of({ROBOTS: told}), [entry])


@pytest.mark.parametrize("problem", ["float64", "[30, 3]", "[30]", "missing"])
def test_columns_of_other_types(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, problem: str) -> None:
    """Columns that differ from those in the index."""
    told = start_state().columns
    columns = {
        "float64": {**told, "position": told["position"].float()},
        "[30, 3]": {**told, "position": told["position"][:, :2].contiguous()},
        "[30]": {**told, "target": told["target"][:-1].clone()},
        "missing": {name: column for name, column in told.items() if name != "velocity"},
    }[problem]
    with monkeypatch.context() as patch:
        patch.setattr(module, "rows_hash", lambda *_: 0)
        write_columns(tmp_path, columns, told)
    with pytest.raises(module.CheckpointError) as refused:
        read_all(tmp_path)
    assert len(str(refused.value).splitlines()) == 1
    if problem != "missing":
        assert f"expected {problem}" in re.sub("shape |torch.", "", str(refused.value))


@pytest.mark.parametrize("problem", ["single", "flat", "missing", "more"])
def test_columns_of_another_version(tmp_path: Path, problem: str) -> None:
    """With valid hashes."""
    columns = start_state().columns
    columns = {
        "single": {**columns, "position": columns["position"].float()},
        "flat": {**columns, "position": columns["position"][:, :2].contiguous()},
        "missing": {name: column for name, column in columns.items() if name != "velocity"},
        "more": {**columns, "mood": columns["id"]},
    }[problem]
    write_columns(tmp_path, {name: column.clone() for name, column in columns.items()}, columns)
    with pytest.raises(module.CheckpointError, match="index.json: expected the columns of robots, and no others"):
        read_all(tmp_path)


@pytest.mark.parametrize("kind", ["world", None])
def test_one_of_another_kind(tmp_path: Path, kind: Any) -> None:
    """A checkpoint of another kind is neither read nor replaced."""
    folder = write(tmp_path, 7)
    pointer = tmp_path / FOLDER / POINTER
    pointer.write_text(json.dumps(json.loads(pointer.read_text()) | {"kind": kind}))
    for call in (read_all, lambda path: write(path, 8)):
        with pytest.raises(module.CheckpointError, match=f"expected the checkpoint of a simulation, .* kind {kind!r}"):
            call(tmp_path)
    assert [path.name for path in (tmp_path / FOLDER).glob("step-*")] == [folder.name]


def test_folders_of_others_stay(tmp_path: Path) -> None:
    for name in ("step-1", "step-000000001-pictures", "other"):
        (tmp_path / FOLDER / name).mkdir(parents=True)
    write(tmp_path, 7)
    assert len(list((tmp_path / FOLDER).iterdir())) == 5


def test_one_of_an_earlier_version(tmp_path: Path) -> None:
    (tmp_path / "checkpoint.pt").write_bytes(b"")
    with pytest.raises(module.CheckpointError, match="written by an earlier version"):
        sim.resume(tmp_path)
    with pytest.raises(ValueError, match="holds an earlier run .*written by an earlier version"):
        sim.run(CONFIG, 1, tmp_path)
    assert sim.run(CONFIG, 1, tmp_path, overwrite=True).steps_made == 1
    write(tmp_path / "ranks", 3)
    (tmp_path / "ranks" / FOLDER / POINTER).write_text('{"format": 1, "folder": "step-000000003"}')
    with pytest.raises(module.CheckpointError, match="its format is 1, this version reads 3"):
        sim.resume(tmp_path / "ranks")


def test_a_checkpoint_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sim.run(CONFIG, 1, tmp_path)
    for call in ("save_file", "_write_bytes"):
        with monkeypatch.context() as patch:
            patch.setattr(module, call, raise_full)
            with pytest.raises(module.CheckpointError, match="No space left on device"):
                sim.resume(tmp_path, 2)
        assert len(list((tmp_path / FOLDER).iterdir())) == 2


def raise_full(*_: Any) -> None:
    raise OSError(28, "No space left on device")


def test_a_folder_that_cannot_be_written_to(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="^folder: cannot write to .*: Not a directory"):
        sim.run(CONFIG, 1, tmp_path / "file" / "run")


@pytest.mark.parametrize("kind", ["a file", "a folder in which no file can be made"])
def test_a_run_that_could_write_no_checkpoint_ends_before_its_first_step(tmp_path: Path, kind: str) -> None:
    root = tmp_path / "run" / FOLDER
    root.parent.mkdir()
    root.touch() if kind == "a file" else root.symlink_to("/proc/self")
    with pytest.raises(module.CheckpointError, match=f"{FOLDER} cannot be written to: ") as refused:
        sim.run(CONFIG, 3, tmp_path / "run")
    assert len(str(refused.value).splitlines()) == 1
    assert not (tmp_path / "run" / "steps.jsonl").exists()


def test_checkpoints_without_a_pointer_are_not_deleted(tmp_path: Path) -> None:
    kept = write(tmp_path, 7)
    pointer = tmp_path / FOLDER / POINTER
    pointer.rename(tmp_path / "elsewhere")
    with pytest.raises(module.CheckpointError, match=f"has lost {POINTER}, but holds {kept.name}"):
        sim.resume(tmp_path)
    with pytest.raises(ValueError, match=f"holds an earlier run .*has lost {POINTER}.*; overwrite it, or take another"):
        sim.run(CONFIG, 1, tmp_path)
    pointer.symlink_to(tmp_path / "nowhere")
    for call in (lambda: sim.resume(tmp_path), lambda: sim.run(CONFIG, 1, tmp_path)):
        with pytest.raises(ValueError, match=f"{POINTER} cannot be read: No such file"):
            call()
    assert kept.exists()
    pointer.unlink()
    (tmp_path / "elsewhere").rename(pointer)
    assert read_all(tmp_path).steps_made == 7
    pointer.unlink()
    assert sim.run(CONFIG, 1, tmp_path, overwrite=True).steps_made == 1 and not kept.exists()


@pytest.mark.parametrize("call", ["_write_bytes", "replace"])
@pytest.mark.parametrize("number", range(3))
def test_a_first_checkpoint_that_is_interrupted_does_not_block_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, number: int
) -> None:
    """The process is killed before a file is written or renamed."""
    with monkeypatch.context() as patch:
        calls = fail_at(patch, call, number, SystemExit())
        try:
            write(tmp_path, 6)
        except SystemExit:
            assert find_checkpoint(tmp_path) is None
            sim.run(CONFIG, 1, tmp_path)
        else:
            assert next(calls) <= number
            assert read_all(tmp_path).steps_made == 6


def test_files_of_others_stay_when_a_run_is_overwritten(tmp_path: Path) -> None:
    write(tmp_path, 7)
    for name in ("thesis.pt", "step-1", "step-000000001-pictures"):
        (tmp_path / FOLDER / name).touch()
    sim.run(CONFIG, 1, tmp_path, overwrite=True)
    assert len(list((tmp_path / FOLDER).iterdir())) == 5 and len(list((tmp_path / FOLDER).glob("step-*"))) == 3
    # Checkpoints may be on another disk.
    shutil.move(tmp_path / FOLDER, tmp_path / "disk")
    (tmp_path / FOLDER).symlink_to(tmp_path / "disk")
    sim.run(CONFIG, 2, tmp_path, overwrite=True)
    assert sim.load_checkpoint(tmp_path).steps_made == 2 and (tmp_path / "disk" / "thesis.pt").exists()


@pytest.mark.parametrize(
    "name", ["lock", "world.json", "world.json.unfinished", "steps.jsonl", "steps.jsonl.unfinished"]
)
def test_links_that_were_planted_are_not_followed(tmp_path: Path, name: str) -> None:
    precious = tmp_path / "precious"
    precious.write_text("precious")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / name).symlink_to(precious)
    if name == "lock":
        with pytest.raises(ValueError, match="^folder: cannot write to .*: Too many levels of symbolic links"):
            sim.run(CONFIG, 1, tmp_path / "run")
    else:
        sim.run(CONFIG, 1, tmp_path / "run")
    assert precious.read_text() == "precious"
