"""Faults of world checkpoints: the same one-line error on all ranks; the previous checkpoint is kept."""

from __future__ import annotations

import json
import pickle
import re
import resource
import shutil
import signal
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
from support.checkpoint_faults import Runs, changes_by_chance, files_of, newest, plant
from support.crowds import crowds
from support.ranks import RankPool

import pgccd
from distributed.world import test_motions
from distributed.world.test_motions import spread
from distributed.world.test_world_checkpoint import CROWD, begin, load, save_on_the_way, state_of
from pgccd.checkpoint import files
from pgccd.checkpoint.files import FOLDER, POINTER
from pgccd.checkpoint.lock import hold
from pgccd.distributed import Alone, BalanceOptions, CheckpointError, Comm, World, WorldOptions
from pgccd.distributed.checkpoint import shared_folder

CPU = torch.device("cpu")


def test_a_type_that_files_cannot_hold(tmp_path: Path) -> None:
    begin(Alone()).save(tmp_path)
    position = torch.zeros((1, 3), dtype=torch.float64)
    scene = pgccd.Scene(crowds()[CROWD].meshes[:1])
    for payload in ({"z": position.to(torch.complex128)}, {"\ud800": position}):
        world = World.create(scene, position, (0.0,) * 3, (8.0,) * 3, payload=payload)
        with pytest.raises(CheckpointError, match=r"^/.*/rank-00000.safetensors cannot be written: "):
            world.save(tmp_path)
    assert state_of(load(Alone(), tmp_path)) == state_of(begin(Alone()))  # the previous one


def told(comm: Comm, folder: str, what: str = "load") -> str:
    """The error of a rank; its communication works afterwards."""
    world = begin(comm) if what == "save" else None
    try:
        load(comm, folder) if world is None else world.save(folder)
    except (ValueError, FileNotFoundError) as error:
        assert len(str(error).splitlines()) == 1
        comm.barrier()
        return f"{type(error).__name__}: {error}"
    return ""


def told_of(comm: Comm, folder: str, where: str, rank: int, error: Exception) -> str:
    """The error of `World.save` if a function of checkpoints raises another error on one rank."""
    world = begin(comm)
    world.save(folder)
    failing = mock.patch(f"pgccd.{where}", side_effect=error) if comm.rank == rank else nullcontext()
    with failing, pytest.raises(CheckpointError) as refused:
        world.save(folder)
    comm.barrier()
    assert state_of(load(comm, folder)) == state_of(world)
    return str(refused.value)


@pytest.mark.parametrize(
    ("where", "rank", "error"),
    [
        ("distributed.checkpoint.writing.copies_of", 1, torch.OutOfMemoryError("no room\nat all")),
        ("checkpoint.files.write_tables", 1, MemoryError("no room\nat all")),
        ("checkpoint.files.publish", 0, RuntimeError()),
    ],
)
def test_errors_of_any_kind_reach_all_ranks(
    ranks: RankPool, tmp_path: Path, where: str, rank: int, error: Exception
) -> None:
    reason = str(error).split("\n")[0] or "RuntimeError"
    for said in ranks.run(2, told_of, str(tmp_path), where, rank, error):
        assert re.fullmatch(rf"{tmp_path}/checkpoints/step-\S+ cannot be written: {reason}", said)


def test_previous_checkpoints_that_cannot_be_removed(tmp_path: Path) -> None:
    world = begin(Alone())
    first = world.save(tmp_path)
    with (
        mock.patch.object(files, "_remove_others", side_effect=OSError("stale")),
        pytest.warns(UserWarning, match="previous checkpoints cannot be removed: stale"),
    ):
        second = world.save(tmp_path)
    assert first.exists() and state_of(load(Alone(), tmp_path)) == state_of(world)
    third = world.save(tmp_path)
    assert third.exists() and second.exists() and not first.exists()
    fourth = world.save(tmp_path, keep=1)
    assert fourth.exists() and not second.exists() and not third.exists()


def same_told(of_ranks: list[str]) -> str:
    """The error of all ranks, which is the same except for the rank in it."""
    (said,) = {re.sub(r"^(ValueError: rank \d+|\w+Error): ", "", said) for said in of_ranks}
    return said


@pytest.mark.parametrize("count", [500, pytest.param(2_000, marks=pytest.mark.slow)])
def test_any_change_is_refused_in_one_line_or_makes_no_difference(tmp_path: Path, count: int) -> None:
    world, refused = begin(Alone()), 0
    world.save(tmp_path)
    expected = state_of(world)
    for _ in changes_by_chance(tmp_path, count):
        try:
            found = load(Alone(), tmp_path)
        except CheckpointError as error:
            refused += 1
            assert str(tmp_path) in str(error) and len(str(error).splitlines()) == 1
        else:
            assert state_of(found) == expected
    assert refused > 0.9 * count


@pytest.fixture(scope="module")
def saved_by_two(ranks: RankPool, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The checkpoint of two ranks."""
    folder = tmp_path_factory.mktemp("saved")
    ranks.run(2, save_on_the_way, str(folder), "cells")
    return folder


@pytest.mark.parametrize("name", ["index.json", "rank-00000.safetensors", "rank-00001.safetensors"])
@pytest.mark.parametrize("fault", ["flipped", "cut off", "missing"])
def test_a_fault_is_told_to_all_ranks(
    ranks: RankPool, saved_by_two: Path, tmp_path: Path, name: str, fault: str
) -> None:
    shutil.copytree(saved_by_two, tmp_path, symlinks=True, dirs_exist_ok=True)
    path = newest(tmp_path) / name
    raw = bytearray(path.read_bytes())
    raw[-3] ^= 4
    path.unlink() if fault == "missing" else path.write_bytes(raw if fault == "flipped" else raw[:-9])
    for size in (1, 3):
        said = same_told(ranks.run(size, told, str(tmp_path)))
        assert (
            said.startswith(str(path)) and ("cannot be read: No such file" if fault == "missing" else "damaged") in said
        )


def test_no_checkpoint(ranks: RankPool, tmp_path: Path) -> None:
    assert set(ranks.run(2, told, str(tmp_path))) == {f"FileNotFoundError: folder: no checkpoint at {tmp_path}"}
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_executed(tmp_path: Path) -> None:
    begin(Alone()).save(tmp_path)
    bomb = pickle.dumps(Runs(tmp_path / "executed"))
    for path in files_of(tmp_path):
        raw = path.read_bytes()
        path.write_bytes(bomb)
        with pytest.raises(CheckpointError):
            load(Alone(), tmp_path)
        path.write_bytes(raw)
    (newest(tmp_path) / "more.safetensors").write_bytes(bomb)
    load(Alone(), tmp_path)
    assert not (tmp_path / "executed").exists()


#: By fault: the planted change, and the expected error.
CHANGES: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "no meshes": (lambda index: index["header"].pop("meshes"), "meshes: the world in .* was saved with others"),
    "no cut": (lambda index: index["header"].pop("cut"), "is not the checkpoint of a world"),
    "an unknown partition": (lambda index: index["header"]["cut"].update(partition="x"), "partition: expected one of"),
    "no box": (lambda index: index["header"]["cut"].update(upper=[0, 0, 0]), "upper: "),
    "a large box": (lambda index: index["header"]["cut"].update(upper=[10**400] * 3), "checkpoint of a world"),
    "another axis": (lambda index: index["header"]["cut"].update(axes=7), "axes: expected 1, 2 or 3"),
    "many cells": (lambda index: index["header"]["cut"].update(cells=2**30), "cells: expected integers"),
    "no ids": (lambda index: index["layout"]["bodies"].pop("id"), r"without \['id'\]"),
    "an unknown column": (lambda index: index["layout"]["bodies"].update(x=["int64", []]), r"unknown columns \['x'\]"),
    "an unknown table": (
        lambda index: [
            index["layout"].update(more={"x": ["int64", []]}),
            index["files"][0]["tables"].update(more={"count": 0, "hash": 0}),
        ],
        "unknown columns .* or tables",
    ),
    "vertices of no number": (
        lambda index: [
            index["layout"].update(vertices={".x": ["int64", []]}),
            index["files"][0]["tables"].update(vertices={"count": 0, "hash": 0}),
        ],
        r"without \['vertex_count'\]",
    ),
    "another kind": (lambda index: index.update(kind="simulation"), "expected the checkpoint of a world"),
    "another hash": (lambda index: index["files"][0]["tables"]["bodies"].update(hash=1), "rows of bodies do not have"),
    "no partition": (lambda index: index.pop("shared"), "cells: .* in each subdomain, more than its table of owners"),
    "gigabytes of cells": (
        lambda index: index["header"]["cut"].update(partition="cells", cells=4000),
        "cells: 16000000 in each subdomain, more than its table of owners",
    ),
}


@pytest.mark.parametrize("change", list(CHANGES))
def test_an_index_that_was_planted(tmp_path: Path, change: str) -> None:
    begin(Alone()).save(tmp_path)
    planted, expected = CHANGES[change]
    plant(tmp_path, planted)
    with pytest.raises(ValueError, match=expected) as refused:
        load(Alone(), tmp_path)
    assert str(tmp_path) in str(refused.value) and len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("column", "value", "expected"),
    [
        ("id", lambda c: torch.zeros_like(c), "id: 0 is given to more than one body"),
        ("id", lambda c: c - 100, "id: expected numbers >= 0"),
        ("mesh_index", lambda c: c + 1000, "mesh_index: "),
        ("position", lambda c: c[:, :2].contiguous(), "position: expected shape"),
        ("world", lambda c: c - 5, "world: body 0: expected an id in"),
    ],
)
def test_columns_that_were_planted(
    tmp_path: Path, column: str, value: Callable[[torch.Tensor], torch.Tensor], expected: str
) -> None:
    """With valid hashes."""
    world = begin(Alone())
    world.columns[column] = value(world.columns[column])
    world.save(tmp_path)
    with pytest.raises(CheckpointError, match=f"is not the checkpoint of a world: {expected}") as refused:
        load(Alone(), tmp_path)
    assert str(tmp_path) in str(refused.value) and len(str(refused.value).splitlines()) == 1


def test_vertices_that_were_planted(ranks: RankPool, tmp_path: Path) -> None:
    ranks.run(2, plant_vertices, str(tmp_path))
    for size in (1, 3):
        of_ranks = ranks.run(size, told_of_vertices, str(tmp_path))
        assert all(re.search("rows of vertices do not have the hash|vertex_payload", said) for said in of_ranks)


def plant_vertices(comm: Comm, folder: str) -> None:
    world = spread(comm, "first", CPU)
    world.columns["vertex_count"] = world.columns["vertex_count"] - 2**40
    world.save(folder)


def told_of_vertices(comm: Comm, folder: str) -> str:
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        World.load(folder, test_motions.meshes().meshes, comm=comm)
    return str(caught.value)


@pytest.mark.parametrize("call", ["save_file", "_sync", "_write_bytes", "replace"])
@pytest.mark.parametrize("number", range(4))  # the fifth `_sync` follows the replacement of the pointer
def test_a_failure_leaves_the_one_before(tmp_path: Path, call: str, number: int) -> None:
    """A disk failure at any time."""
    world = begin(Alone())
    before = world.save(tmp_path)
    owner: Any = files.os if call == "replace" else files
    effects = [mock.DEFAULT] * number + [OSError(28, "No space left on device")] + [mock.DEFAULT] * 9
    world.steps_made = 1
    with mock.patch.object(owner, call, side_effect=effects, wraps=getattr(owner, call)) as called:
        try:
            world.save(tmp_path)
            assert called.call_count <= number
        except CheckpointError as error:
            assert re.search("^/.* cannot be written: .*No space left on device", str(error))
            assert newest(tmp_path) == before and load(Alone(), tmp_path).steps_made == 0
            assert sorted(path.name for path in (tmp_path / FOLDER).iterdir()) == sorted([POINTER, before.name])
    world.save(tmp_path)
    assert load(Alone(), tmp_path).steps_made == 1 and len(list((tmp_path / FOLDER).iterdir())) == 3


def fill_the_disk(comm: Comm, folder: str) -> str:
    """The disk of rank 1 is full; there is a previous checkpoint."""
    world = begin(comm)
    before = world.save(folder)
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    if comm.rank == 1:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1024, limit[1]))
    try:
        with pytest.raises(CheckpointError) as caught:
            world.save(folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert newest(Path(folder)) == before and len(list(before.parent.iterdir())) == 2
    assert state_of(load(comm, folder)) == state_of(world)
    assert world.save(folder) != before
    return str(caught.value)


def test_a_full_disk(ranks: RankPool, tmp_path: Path) -> None:
    (said,) = set(ranks.run(3, fill_the_disk, str(tmp_path)))
    assert re.search(f"^{tmp_path}/.*/rank-00001.safetensors cannot be written: .*File too large", said)
    assert len(said.splitlines()) == 1
    assert len(list((tmp_path / FOLDER).iterdir())) == 3  # two of them, and the pointer


def test_a_folder_that_cannot_be_written(ranks: RankPool, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    folder = tmp_path / "file" / "world"
    said = same_told(ranks.run(2, told, str(folder), "save"))
    assert said == f"folder: cannot write to {folder}: Not a directory"


def save_without_mark(comm: Comm, folder: str) -> str:
    """Saves where the mark cannot be created: its name is that of a file in a missing folder."""
    with mock.patch.object(shared_folder.secrets, "token_hex", lambda _: "missing/mark"):
        return told(comm, folder, "save")


def test_a_mark_that_cannot_be_written(ranks: RankPool, tmp_path: Path) -> None:
    said = same_told(ranks.run(2, save_without_mark, str(tmp_path)))
    assert said == f"folder: cannot write to {tmp_path}: No such file or directory"


def test_a_folder_that_another_job_holds(ranks: RankPool, tmp_path: Path) -> None:
    with hold(tmp_path):
        said = same_told(ranks.run(2, told, str(tmp_path), "save"))
    assert said.startswith(f"folder: {tmp_path} is in use by another job: process ")
    assert not (tmp_path / FOLDER).exists()


def save_apart(comm: Comm, folder: str) -> str:
    """Saves to a separate folder per rank."""
    look = shared_folder.sees_mark

    def see(path: Path, mark: str) -> bool:
        return look(Path(folder, "elsewhere") if comm.rank == 1 else path, mark, within=0.2)

    with mock.patch.object(shared_folder, "sees_mark", see):
        return told(comm, folder, "save")


def test_a_folder_that_ranks_do_not_share(ranks: RankPool, tmp_path: Path) -> None:
    said = same_told(ranks.run(3, save_apart, str(tmp_path)))
    assert re.search(f"^folder: {tmp_path} on .* is not that of rank 0", said)
    assert [path.name for path in tmp_path.iterdir()] == ["lock"]


def test_folders_that_differ(ranks: RankPool, tmp_path: Path) -> None:
    (said,) = set(ranks.run(2, save_to_two, str(tmp_path)))
    assert said == f"folder: rank 0 has '{tmp_path}/0', rank 1 has '{tmp_path}/1'"
    assert list(tmp_path.iterdir()) == []


def save_to_two(comm: Comm, folder: str) -> str:
    return told(comm, f"{folder}/{comm.rank}", "save").removeprefix("DisagreementError: ")


def test_a_run_of_the_simulation_is_not_replaced(tmp_path: Path) -> None:
    pgccd.sim.run(pgccd.sim.ModelConfig(robots=20), 1, tmp_path)
    for call in (lambda: begin(Alone()).save(tmp_path), lambda: load(Alone(), tmp_path)):
        with pytest.raises(CheckpointError, match="expected the checkpoint of a world, it is of kind 'simulation'"):
            call()
    assert pgccd.sim.resume(tmp_path, 2).steps_made == 2
    begin(Alone()).save(tmp_path / "world")
    with pytest.raises(CheckpointError, match="expected the checkpoint of a simulation, it is of kind 'world'"):
        pgccd.sim.resume(tmp_path / "world")


def test_a_pointer_that_was_planted(tmp_path: Path) -> None:
    begin(Alone()).save(tmp_path)
    pointer = tmp_path / FOLDER / POINTER
    shutil.copytree(newest(tmp_path), tmp_path / "elsewhere")
    pointer.write_text(json.dumps(json.loads(pointer.read_text()) | {"folder": "../elsewhere"}))
    with pytest.raises(CheckpointError, match="folder: expected the name of a checkpoint, got '../elsewhere'"):
        load(Alone(), tmp_path)


def mistakes(comm: Comm, folder: str) -> list[str]:
    """Errors of arguments that do not match the checkpoint, or differ between ranks."""
    begin(comm).save(folder)
    right = crowds()[CROWD].meshes
    wrong = [pgccd.Mesh(mesh.vertices * 2.0, mesh.faces) for mesh in right]
    said = []
    for meshes, more in (
        (wrong, {}),
        (wrong if comm.rank == 1 else right, {}),
        (right[:1], {}),
        (right, {"min_separation": 0.1 * comm.rank}),
        (right, {"balance": BalanceOptions("cost" if comm.rank else "none")}),
    ):
        with pytest.raises(ValueError) as caught:  # noqa: PT011
            World.load(folder, meshes, comm=comm, options=WorldOptions(**more))
        said.append(str(caught.value))
    return said


def test_mistakes_are_named(ranks: RankPool, tmp_path: Path) -> None:
    first, second = ranks.run(2, mistakes, str(tmp_path))
    assert first[0] == second[0] == f"meshes: the world in {tmp_path} was saved with others"
    assert first[1] == f"rank 1: {second[1]}" and second[1] == first[0]
    assert first[2] == second[2] == first[0]
    assert first[3] == second[3] and first[3].startswith("min_separation: rank 0 has")
    assert first[4] == second[4] and first[4].startswith("balance.policy: rank 0 has")


def test_no_path() -> None:
    """An empty path would be the current folder."""
    with pytest.raises(TypeError, match="^folder: expected a path, got ''"):
        begin(Alone()).save("")


def test_one_cell_needs_cells(tmp_path: Path) -> None:
    begin(Alone(), "bisection").save(tmp_path)
    with pytest.raises(ValueError, match="^balance: .*one-cell"):
        options = WorldOptions(balance=BalanceOptions("one-cell"))
        World.load(tmp_path, crowds()[CROWD].meshes, options=options)
