"""Runs: log, checkpoints, resuming, interruption."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import time
import tracemalloc
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch

import pgccd
from pgccd import sim
from pgccd.checkpoint import files
from pgccd.checkpoint.lock import FolderError
from pgccd.runtime.stages import StageClock
from pgccd.sim import log as log_module
from pgccd.sim.log import LOG_FILE, StepLog
from pgccd.sim.run_folder import WORLD_FILE
from pgccd.sim.summary import Totals

CONFIG = sim.ModelConfig(robots=200, pattern="skewed", seed=11, speed=0.2)
FIELDS = {"step", "robots", "pcs", "contacts", "contacts_hash", "state_hash", "seconds", "stage_seconds", "candidates"}
FIELDS |= {"unresolved", "touching_at_t0", "stopped", "secondary_contacts", "resolution_rounds"}


def log(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / LOG_FILE).read_text().splitlines()]


def without_times(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{name: value for name, value in record.items() if "seconds" not in name} for record in records]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, sim.Run]:
    folder = tmp_path_factory.mktemp("run") / "new" / "folder"
    return folder, sim.run(CONFIG, 24, folder)


def test_log_has_one_whole_line_a_step(finished: tuple[Path, sim.Run]) -> None:
    folder, run = finished
    records = log(folder)
    assert records == run.records
    assert [record["step"] for record in records] == list(range(24))
    assert all(set(record) == FIELDS for record in records)
    assert all(record["robots"] == 200 and len(record["state_hash"]) == 16 for record in records)
    assert sum(record["contacts"] for record in records) > 20
    assert records[-1]["state_hash"] == f"{sim.state_hash(run.state):016x}"
    assert json.loads((folder / WORLD_FILE).read_text())["pattern"] == "skewed"


def test_ids_are_kept(finished: tuple[Path, sim.Run]) -> None:
    assert torch.equal(finished[1].state.id, torch.arange(200))


def test_same_seed_same_run_other_seed_other_run(finished: tuple[Path, sim.Run], tmp_path: Path) -> None:
    again = sim.run(CONFIG, 24, tmp_path / "a")
    assert without_times(again.records) == without_times(finished[1].records)
    other = sim.run(sim.ModelConfig(robots=200, pattern="skewed", seed=12, speed=0.2), 2, tmp_path / "b")
    assert other.records[0]["state_hash"] != again.records[0]["state_hash"]


def test_resumed_run_equals_an_uninterrupted_one(finished: tuple[Path, sim.Run], tmp_path: Path) -> None:
    sim.run(CONFIG, 9, tmp_path)
    with open(tmp_path / LOG_FILE, "a") as file:  # a step after the checkpoint, and a truncated line
        file.write('{"step": 9}\n{"step": 1')
    resumed = sim.resume(tmp_path, 24)
    assert without_times(log(tmp_path)) == without_times(log(finished[0]))
    for name, column in resumed.state.columns.items():
        assert torch.equal(column, finished[1].state.columns[name])


class StopAfter:
    """Sends this process SIGINT after a number of steps."""

    def __init__(self, steps: int) -> None:
        self.left = steps

    def advance(self, record: dict[str, Any]) -> None:
        self.left -= 1
        if self.left == 0:
            os.kill(os.getpid(), signal.SIGINT)


def test_ctrl_c_leaves_a_checkpoint_that_continues(finished: tuple[Path, sim.Run], tmp_path: Path) -> None:
    handler = signal.getsignal(signal.SIGINT)
    run = sim.run(CONFIG, 24, tmp_path, progress=StopAfter(5))
    # The signal came with the fifth step's record, after the sixth step had been made.
    assert run.interrupted and run.steps_made == 6 and len(log(tmp_path)) == 6
    assert signal.getsignal(signal.SIGINT) is handler
    resumed = sim.resume(tmp_path)
    assert not resumed.interrupted and resumed.steps_made == 24
    assert without_times(log(tmp_path)) == without_times(log(finished[0]))


class CrashError(Exception):
    pass


def test_checkpoints_are_written_on_the_way(
    finished: tuple[Path, sim.Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = files.write_tables

    def write_slowly(*of_rank: Any) -> Any:
        time.sleep(0.5)  # steps 10 to 12 take less
        return write(*of_rank)

    monkeypatch.setattr(files, "write_tables", write_slowly)

    class CrashAfter:
        def advance(self, record: dict[str, Any]) -> None:
            if record["step"] == 12:
                raise CrashError

    with pytest.raises(CrashError):
        sim.run(CONFIG, 24, tmp_path, checkpoint_every=5, progress=CrashAfter())
    assert sim.load_checkpoint(tmp_path).steps_made == 10
    assert len(log(tmp_path)) == 13
    sim.resume(tmp_path)
    assert without_times(log(tmp_path)) == without_times(log(finished[0]))


@pytest.mark.parametrize("on_gpu", [False, True])
def test_lines_of_the_steps_before_a_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, on_gpu: bool) -> None:
    step = sim.Simulation.step

    def fail(simulation: sim.Simulation, index: int, *more: Any) -> Any:
        if index == 7:
            raise RuntimeError("no more")
        return step(simulation, index, *more)

    monkeypatch.setattr(sim.Simulation, "step", fail)
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: on_gpu)
    # Stage times would need a GPU.
    monkeypatch.setattr(StageClock, "stage", lambda *_: nullcontext())
    with pytest.raises(RuntimeError, match="no more"):
        sim.run(CONFIG, 24, tmp_path)
    assert len(log(tmp_path)) == (6 if on_gpu else 7)


def test_a_new_run_replaces_an_earlier_one_only_if_it_may(tmp_path: Path) -> None:
    sim.run(CONFIG, 2, tmp_path)
    with pytest.raises(ValueError, match="^folder: .* holds a run that made 2 of 2 steps; resume it, overwrite it"):
        sim.run(CONFIG, 2, tmp_path)
    assert sim.load_checkpoint(tmp_path).steps_made == 2

    class CrashAtOnce:
        def advance(self, record: dict[str, Any]) -> None:
            raise CrashError

    with pytest.raises(CrashError):
        sim.run(CONFIG, 2, tmp_path, progress=CrashAtOnce(), overwrite=True)
    with pytest.raises(FileNotFoundError, match="no checkpoint"):
        sim.resume(tmp_path)
    sim.run(CONFIG, 1, tmp_path)  # no run to lose


def test_one_job_a_folder(tmp_path: Path) -> None:
    class Second:
        def advance(self, record: dict[str, Any]) -> None:
            if record["step"] < 2:  # no checkpoint is complete yet
                return
            for again in (lambda: sim.run(CONFIG, 2, tmp_path, overwrite=True), lambda: sim.resume(tmp_path)):
                with pytest.raises(ValueError, match=f"in use by another job: process {os.getpid()} on .*, since"):
                    again()

    sim.run(CONFIG, 4, tmp_path, checkpoint_every=1, progress=Second())
    assert sim.resume(tmp_path, 5).steps_made == 5


def test_what_cannot_be_resumed_says_why(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no checkpoint"):
        sim.resume(tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()
    sim.run(CONFIG, 3, tmp_path)
    with pytest.raises(ValueError, match="^steps: .* has made 3 already"):
        sim.resume(tmp_path, 2)
    robot = sim.robot_mesh()
    with pytest.raises(ValueError, match="^meshes: "):
        sim.resume(tmp_path, 4, meshes=[pgccd.Mesh(robot.vertices * 1.5, robot.faces, "centroid")])


def test_a_log_that_lacks_lines_does_not_make_a_checkpoint_useless(
    finished: tuple[Path, sim.Run], tmp_path: Path
) -> None:
    sim.run(CONFIG, 9, tmp_path)
    lines = (tmp_path / LOG_FILE).read_text().splitlines(keepends=True)
    (tmp_path / LOG_FILE).write_text("".join(lines[:7]))
    with pytest.warns(UserWarning, match="lacks 2 of 9 steps"):
        sim.resume(tmp_path, 12)
    expected = without_times(log(finished[0]))
    assert without_times(log(tmp_path)) == expected[:7] + expected[9:12]


def test_the_log_of_another_run_is_refused(finished: tuple[Path, sim.Run], tmp_path: Path) -> None:
    sim.run(CONFIG, 9, tmp_path)
    own = (tmp_path / LOG_FILE).read_bytes()
    sim.run(sim.ModelConfig(robots=200, pattern="skewed", seed=12, speed=0.2), 12, tmp_path / "other")
    shutil.copy(tmp_path / "other" / LOG_FILE, tmp_path)
    said = r"^folder: .*steps.jsonl is not of this checkpoint: the state hash of its step 8 is \w{16}, that of the .*"
    with pytest.raises(FolderError, match=said) as error:
        sim.resume(tmp_path, 12)
    assert len(str(error.value).splitlines()) == 1
    assert (tmp_path / LOG_FILE).read_bytes() == (tmp_path / "other" / LOG_FILE).read_bytes()
    (tmp_path / LOG_FILE).write_bytes(own)
    sim.resume(tmp_path, 12)
    assert without_times(log(tmp_path)) == without_times(log(finished[0]))[:12]


@pytest.mark.parametrize("block", [7, 64, 4096, 1 << 20])
def test_only_the_end_of_the_log_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int) -> None:
    monkeypatch.setattr(log_module, "_BLOCK", block)
    monkeypatch.setattr(log_module, "_LONGEST_LINE", 5000)
    record = {"step": 0, "seconds": 0.5, "stage_seconds": {}, "contacts_hash": "0", "state_hash": "0"}
    record |= dict.fromkeys(log_module._COUNTS, 1)
    record |= {"ranks": {"x": [0] * 20}}
    lines = [json.dumps(record | {"step": step, "state_hash": f"{step}"}) for step in range(40)]
    path = tmp_path / LOG_FILE
    for steps_made in (1, 7, 39, 40):
        for more in ("", "\n", "{", "x" * 900 + "\n", '\n{"step": 5}\n\n'):
            path.write_text("\n".join(lines) + "\n" + more)
            log_module.StepLog(tmp_path, steps_made, f"{steps_made - 1}")._file.close()
            assert path.read_text() == "".join(line + "\n" for line in lines[:steps_made])
    path.write_text(path.read_text() + "x" * 20_000)
    readers: list[Callable[[], object]] = [lambda: sim.read_log(tmp_path)]
    readers += [lambda: StepLog(tmp_path, 40, "39")] * (block < 5000)
    for read in readers:
        with pytest.raises(ValueError, match=r"steps.jsonl cannot be .*: a line has more than 5000 bytes$"):
            read()
    path.write_text("".join(line + "\n" for line in lines))
    found = list(log_module.iterate_log(tmp_path, with_ranks=False))
    assert [each["step"] for each in found] == list(range(40)) and "ranks" not in found[0]


def test_a_log_with_holes_is_refused_at_once(tmp_path: Path, finished: tuple[Path, ...]) -> None:
    """Of a terabyte, wherever they are; fewer zeros at the end are what a crash leaves."""
    own = (Path(finished[0]) / LOG_FILE).read_bytes()
    path, last = tmp_path / LOG_FILE, sim.read_log(finished[0])[-1]
    for before, after in ((own, b""), (b"", b"\n" + own), (own, b"\n" + own)):
        path.write_bytes(before)
        with path.open("r+b") as file:
            file.seek(1 << 40)
            file.write(after)
            file.truncate(max(file.tell(), 1 << 40))
        readers: list[Callable[[], object]] = [lambda: sim.read_log(tmp_path)]
        readers += [lambda: StepLog(tmp_path, last["step"] + 1, last["state_hash"])] * (not after)
        begin = time.process_time()
        for read in readers:
            with pytest.raises(ValueError, match=r"steps.jsonl cannot be (read|written): it has holes$"):
                read()
        assert time.process_time() - begin < 2.0  # reading all takes minutes
    path.write_bytes(own + bytes(5000))
    with StepLog(tmp_path, last["step"] + 1, last["state_hash"]):
        pass
    assert path.read_bytes() == own


def test_nothing_of_the_log_is_kept_in_memory(tmp_path: Path) -> None:
    with StepLog(tmp_path, 0) as written:
        tracemalloc.start()
        for step in range(300):
            written.append({"step": step, "ranks": {"pcs": list(range(1000))}})
        kept, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert kept < 200_000 < (tmp_path / LOG_FILE).stat().st_size


def test_a_run_of_no_steps_is_a_run(tmp_path: Path) -> None:
    run = sim.run(CONFIG, 0, tmp_path)
    assert run.records == [] and run.last_steps == [] and not run.interrupted
    assert sim.load_checkpoint(tmp_path).steps_made == 0


def test_a_damaged_line_of_the_log_costs_no_other(finished: tuple[Path, sim.Run], tmp_path: Path) -> None:
    sim.run(CONFIG, 9, tmp_path)
    lines = (tmp_path / LOG_FILE).read_bytes().splitlines(keepends=True)
    lines[2] = lines[2][:40] + b"\xff" + lines[2][41:]
    lines[5] = lines[5].replace(b'"step": 5', b'"step": -5')
    lines[6] = lines[6].replace(b'"pcs"', b'"pxs"')
    lines[7] = re.sub(rb'"contacts": \d+', b'"contacts": "3"', lines[7])
    lines[8] = re.sub(rb'"plan": [^,}]+', b'"plan": "0"', lines[8])
    (tmp_path / LOG_FILE).write_bytes(b"".join([*lines[:4], lines[1], *lines[4:]]))  # one twice
    with pytest.warns(UserWarning, match="lacks 4 of 9 steps"):  # at the end; only that is read
        run = sim.resume(tmp_path, 12)
    expected = without_times(log(finished[0]))
    assert without_times(sim.read_log(tmp_path)) == [*expected[:2], *expected[3:5], *expected[9:12]]
    assert len(Totals(run).lines) > 7


@pytest.mark.parametrize("replaced", [True, False])
def test_a_log_that_is_removed_meanwhile_ends_the_run(tmp_path: Path, replaced: bool) -> None:
    class Remove:
        def advance(self, record: dict[str, Any]) -> None:
            if record["step"] == 1:
                (tmp_path / LOG_FILE).rename(tmp_path / "elsewhere")
                if replaced:
                    (tmp_path / LOG_FILE).touch()

    why = "has been replaced while the run was writing it" if replaced else "cannot be written: No such file"
    with pytest.raises(FolderError, match=f"^folder: .*{LOG_FILE} {why}"):
        sim.run(CONFIG, 4, tmp_path, checkpoint_every=2, progress=Remove())
    assert len((tmp_path / "elsewhere").read_text().splitlines()) == 2


def test_a_full_disk_is_named(tmp_path: Path) -> None:
    full = StepLog(tmp_path, 0)
    full._file.close()
    full._file = open("/dev/full", "w")  # noqa: SIM115
    with pytest.raises(FolderError, match=f"^folder: .*{LOG_FILE} cannot be written: No space left on device"), full:
        full.append({"step": 0})
    with pytest.raises(FolderError, match="^folder: .* cannot be written to: No space left on device"):
        (tmp_path / "full").mkdir()
        with mock.patch("pgccd.sim.run_folder.replace_text", side_effect=OSError(28, "No space left on device")):
            sim.run(CONFIG, 1, tmp_path / "full")
