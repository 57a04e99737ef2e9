"""Saved and loaded worlds on any number of ranks: bitwise equal to an uninterrupted one."""

from __future__ import annotations

import shutil
import threading
import time
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest
import torch
from support.cases import mostly_slow
from support.crowds import crowds
from support.ranks import RankPool, to_all
from support.reports import of_contacts

import pgccd
from distributed.world import test_motions
from distributed.world.test_motions import REPORTS, STEPS, alone, require_equal, rows_of, spread, vertices_of
from pgccd.checkpoint.files import FOLDER, CheckpointError
from pgccd.distributed import Alone, BalanceOptions, Comm, World, WorldOptions
from pgccd.distributed.checkpoint import writing
from pgccd.distributed.comm.exchange import take_rows

CPU = torch.device("cpu")
EAGER = BalanceOptions("cost", start=0.0, goal=0.0, moving=0.0, deciding=0.0)
LOOP, SAVED = 6, 3  # steps of the loop, and before the checkpoint
HEADER = {"made by": "a loop", "lengths": [1.0, 2.5]}
CROWD = "kept apart, filtered"


def begin(comm: Comm, partition: str = "cells") -> World:
    """Rigid bodies for a user loop, with payload of several types."""
    crowd = crowds()[CROWD]
    count = len(crowd.position)
    mine = torch.arange(comm.rank, count, comm.size).flip(0)
    columns = {"orientation": crowd.orientation, "velocity": crowd.velocity, "rotation": crowd.rotation}
    columns |= {"tag": 7 * torch.arange(count), "half": torch.arange(count).to(torch.bfloat16)}
    columns |= {"short": torch.arange(count).to(torch.uint16), "low": torch.arange(count).to(torch.float8_e4m3fn)}
    columns |= {"odd": (torch.arange(count) % 2 == 1)[:, None], "none": torch.zeros((count, 0))}
    return World.create(
        crowd.scene(mine),
        crowd.position[mine],
        (0.0,) * 3,
        (8.0,) * 3,
        id=10 * mine + 3,
        payload=take_rows(columns, mine),
        comm=comm,
        options=WorldOptions(nonzero_toi=True, partition=partition, cells=4, balance=EAGER),
    )


def load(comm: Comm, folder: str | Path) -> World:
    # The partition, axes and cells of the checkpoint are kept.
    options = WorldOptions(nonzero_toi=True, balance=EAGER, axes=2, cells=7)
    return World.load(folder, crowds()[CROWD].meshes, comm=comm, options=options)


def numbers(columns: list[torch.Tensor]) -> list[list[float]]:
    wide = [column if column.dim() > 1 else column[:, None] for column in columns]
    return torch.cat([column.double() for column in wide], dim=1).tolist()


def state_of(world: World) -> list[list[float]]:
    """All columns of all bodies, by id; equal on all ranks."""
    dtypes = {"half": torch.bfloat16, "odd": torch.bool, "tag": torch.int64, "short": torch.uint16}
    dtypes["low"] = torch.float8_e4m3fn
    assert {name: column.dtype for name, column in world.payload.items() if name in dtypes} == dtypes
    assert world.payload["none"].shape == (len(world.id), 0)
    columns = [world.columns[name] for name in sorted(world.columns) if name != "id"]
    return sorted(sum(to_all(world.comm, numbers([world.id, *columns])), []))


def go_on(world: World, save: str = "") -> list[Any]:
    """Runs the remaining steps; returns contacts and states after each, equal on all ranks."""
    seen = []
    for step in range(world.steps_made, LOOP):
        at = world.payload
        motion = pgccd.RigidMotion.from_velocity(world.position, at["orientation"], at["velocity"], at["rotation"], 0.2)
        hits = world.step(motion)
        assert hits.toi is not None
        free = torch.isinf(world.first_toi(hits))[:, None]
        # Bodies pass through each other: only results are compared.
        velocity = torch.where(free, at["velocity"], -at["velocity"])
        world.move(motion.position_t1, velocity=velocity, half=at["half"] + 1)
        contacts = sum(to_all(world.comm, numbers([hits.pairs, hits.toi])), [])
        seen.append((sorted({tuple(row) for row in contacts}), state_of(world)))
        if save and step + 1 == SAVED:
            world.save(save, header=HEADER, wait=False)
    world.finish_saving()
    return seen


def whole(comm: Comm) -> list[Any]:
    return go_on(begin(comm))


def save_on_the_way(comm: Comm, folder: str, partition: str) -> list[Any]:
    return go_on(begin(comm, partition), folder)


def load_and_go_on(comm: Comm, folder: str, partition: str, saved_by: int) -> list[Any]:
    world = load(comm, folder)
    assert world.header == HEADER
    kept, name = world.partition, "owner" if partition == "cells" else "planes"
    is_uniform = torch.equal(getattr(kept, name), getattr(begin(comm, partition).partition, name))
    assert is_uniform == (comm.size != saved_by or comm.size == 1)
    assert bool((kept.owner_of(world.position) == comm.rank).all())
    assert world.id.tolist() == sorted(world.id.tolist()) and world.steps_made == SAVED
    seen = go_on(world)
    assert comm.size == 1 or not torch.equal(getattr(world.partition, name), getattr(kept, name))
    return seen


@pytest.fixture(scope="module")
def expected(ranks: RankPool) -> list[Any]:
    seen = ranks.run(1, whole)[0]
    assert sum(len(contacts) for contacts, _ in seen[SAVED:]) > 0
    return seen


NUMBERS = [(1, 1), (1, 3), (2, 1), (2, 2), (2, 3), (3, 3), (4, 2)]
QUICK = [(1, 1, "cells"), (1, 3, "bisection"), (2, 1, "cells"), (3, 3, "cells"), (4, 2, "bisection")]


@pytest.mark.parametrize(
    ("saved_by", "loaded_by", "partition"),
    mostly_slow([(*numbers, kind) for numbers in NUMBERS for kind in ("cells", "bisection")], QUICK),
)
def test_a_loop_goes_on(
    ranks: RankPool, tmp_path: Path, expected: list[Any], partition: str, saved_by: int, loaded_by: int
) -> None:
    assert ranks.run(saved_by, save_on_the_way, str(tmp_path), partition)[0] == expected
    assert ranks.run(loaded_by, load_and_go_on, str(tmp_path), partition, saved_by)[0] == expected[SAVED:]


def test_the_kind_of_partition_is_kept(tmp_path: Path) -> None:
    crowd = crowds()[CROWD]

    def kind(balance: BalanceOptions) -> str:
        return type(World.load(tmp_path, crowd.meshes, options=WorldOptions(balance=balance)).partition).__name__

    scene, box = pgccd.Scene(crowd.meshes, crowd.mesh_index), ((0.0,) * 3, (8.0,) * 3)
    for chosen, kept in (("one-cell", "Cells"), ("cost", "Bisection")):
        options = WorldOptions(balance=BalanceOptions(chosen))
        world = World.create(scene, crowd.position, *box, options=options)
        assert type(world.partition).__name__ == kept
        world.save(tmp_path)
        assert kind(EAGER) == kept and kind(BalanceOptions("one-cell")) == "Cells"


def save_deforming(comm: Comm, folder: str, report: str, partition: str) -> None:
    """Saves after a step, before the bodies move; and again after they moved."""
    world = spread(comm, report, CPU, 0, "cost", partition)
    after = vertices_of(rows_of(world), 1)
    world.step(pgccd.VertexMotion(world.vertex_payload["x"], after))
    assert world.save(folder + "/before").parent == Path(folder, "before", FOLDER)
    world.move(first_vertices(world, after), x=after)
    world.save(folder + "/after")


def first_vertices(world: World, x: torch.Tensor) -> torch.Tensor:
    """Positions of the bodies with these vertices: that of the first vertex."""
    count = world.columns["vertex_count"]
    return x[count.cumsum(0) - count]


def load_deforming(comm: Comm, folder: str, report: str, partition: str) -> int:
    contacts, options = 0, WorldOptions(report=of_contacts(report), min_separation=0.01, balance=EAGER)
    for when in ("before", "after"):
        world = World.load(Path(folder, when), test_motions.meshes().meshes, comm=comm, options=options)
        if when == "before":
            assert torch.equal(world.vertex_payload["x"], vertices_of(rows_of(world), 0))
            after = vertices_of(rows_of(world), 1)
            world.move(first_vertices(world, after), x=after)
        for step in range(1, STEPS):
            rows = rows_of(world)
            before, after = vertices_of(rows, step), vertices_of(rows, step + 1)
            assert torch.equal(world.vertex_payload["x"], before) and torch.equal(world.payload["tag"], 3 * rows)
            found = world.step(pgccd.VertexMotion(before, after))
            require_equal(world, found, alone(report, step), report)
            contacts += len(found)
            world.move(first_vertices(world, after), x=after)
    return contacts


CASES = [
    (1, 2, "cells"),
    (2, 1, "bisection"),
    (2, 2, "cells"),
    (2, 3, "cells"),
    (3, 2, "bisection"),
    (3, 3, "bisection"),
]
QUICK_CASES = [
    (1, 2, "cells", "first"),
    (2, 1, "bisection", "all"),
    (2, 3, "cells", "all"),
    (3, 2, "bisection", "first"),
]


@pytest.mark.parametrize(
    ("saved_by", "loaded_by", "partition", "report"),
    mostly_slow([(*case, report) for case in CASES for report in REPORTS[:2]], QUICK_CASES),
)
def test_deforming_bodies_go_on(
    ranks: RankPool, tmp_path: Path, saved_by: int, loaded_by: int, partition: str, report: str
) -> None:
    ranks.run(saved_by, save_deforming, str(tmp_path), report, partition)
    assert sum(ranks.run(loaded_by, load_deforming, str(tmp_path), report, partition)) > 0


def few(comm: Comm, folder: str, count: int) -> list[int]:
    """A world with bodies on some of the ranks, or on none."""
    mesh, far = crowds()["one body"].meshes[0], 2.0 * torch.arange(3.0 * count, dtype=torch.float64).view(count, 3)
    mine = far if comm.rank == 0 else far[:0]
    scene = pgccd.Scene([mesh], [0] * len(mine))
    world = World.create(scene, mine, (0.0,) * 3, (8.0,) * 3, payload={"v": mine}, comm=comm)
    world.save(folder)
    loaded = World.load(folder, [mesh], comm=comm)
    assert torch.equal(loaded.payload["v"], world.payload["v"]) and torch.equal(loaded.id, world.id)
    return loaded.id.tolist()


@pytest.mark.parametrize("count", [0, 1, 5])
@pytest.mark.parametrize("size", [1, 3])
def test_few_bodies(ranks: RankPool, tmp_path: Path, count: int, size: int) -> None:
    assert sorted(sum(ranks.run(size, few, str(tmp_path), count), [])) == list(range(count))


def test_saving_in_the_background(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is saved are the columns at the call; until it is complete, the one before stays the newest."""
    world, may_write = begin(Alone()), threading.Event()
    world.save(tmp_path, header={"step": 0})
    write = writing.files.write_tables

    def write_later(*given: Any) -> Any:
        assert may_write.wait(60.0)
        return write(*given)

    monkeypatch.setattr(writing.files, "write_tables", write_later)
    before = world.position.clone()
    folder = world.save(tmp_path, keep=2, header={"step": [1, 2.5, None, {"a": "b"}]}, wait=False)
    world.position.add_(1.0)
    world.steps_made = 7
    with pytest.raises(ValueError, match="in use"):
        begin(Alone()).save(tmp_path)
    other = shutil.copytree(tmp_path, tmp_path.parent / "copy")
    assert load(Alone(), other).header == {"step": 0}
    may_write.set()
    world.finish_saving()
    loaded = load(Alone(), tmp_path)
    assert loaded.header == {"step": [1, 2.5, None, {"a": "b"}]} and torch.equal(loaded.position, before)
    assert folder.is_dir() and loaded.steps_made == 0
    world.finish_saving()  # nothing is left to do


def test_a_failure_in_the_background_is_raised_by_the_next_call(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = begin(Alone())
    with monkeypatch.context() as patch:
        patch.setattr(writing.files, "write_tables", lambda *_: 1 / 0)
        world.save(tmp_path, wait=False)
        with pytest.raises(CheckpointError, match="cannot be written: division by zero"):
            world.save(tmp_path, wait=False)
    world.save(tmp_path)
    assert load(Alone(), tmp_path).header is None


@pytest.mark.parametrize(
    "header", [[1], {"a": torch.ones(1)}, {"a": float("inf")}, {1: 2}, {"a": (1, 2)}, "text"], ids=str
)
def test_headers_that_could_not_be_read_back(tmp_path: Path, header: Any) -> None:
    with pytest.raises(TypeError, match="^header: expected a dictionary of plain values"):
        begin(Alone()).save(tmp_path, header=header)


def different_headers(comm: Comm, folder: str) -> None:
    with pytest.raises(ValueError, match="header"):
        begin(comm).save(folder, header={"rank": comm.rank})


def test_ranks_save_equal_headers(ranks: RankPool, tmp_path: Path) -> None:
    ranks.run(2, different_headers, str(tmp_path))


def test_columns_that_share_memory(tmp_path: Path) -> None:
    world = begin(Alone())
    v = world.position.clone()
    world.move(v, velocity=v, rotation=v)
    world.save(tmp_path)
    loaded = load(Alone(), tmp_path)
    assert torch.equal(loaded.position, v) and torch.equal(loaded.payload["rotation"], v)


@pytest.mark.parametrize("far", [2e150, -torch.inf, torch.nan])
def test_no_position_that_a_checkpoint_cannot_hold(far: float) -> None:
    world = begin(Alone())
    former = world.position.clone()
    with pytest.raises(ValueError, match=r"^position: row \d+: expected finite numbers up to 1e\+150"):
        world.move(torch.where(world.id[:, None] == 3, far, former))
    assert torch.equal(world.position, former)
    world.move(torch.where(world.id[:, None] == 3, 1e150, former))


def test_the_thread_that_writes_has_ended_when_save_returns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If Python exits while it frees tensors, C++ ends the process."""

    class Slow(Future[Any]):
        def set_result(self, result: Any) -> None:
            super().set_result(result)
            time.sleep(0.3)

    monkeypatch.setattr(writing, "Future", Slow)
    begin(Alone()).save(tmp_path)
    assert "pgccd-checkpoint" not in [thread.name for thread in threading.enumerate()]
