"""A resumed run keeps the balanced partition."""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from support.checkpoint_faults import newest, plant
from support.ranks import World

from pgccd import sim
from pgccd.distributed import BalanceOptions, Bisection, Cells, Comm, Partition, RankOptions
from pgccd.distributed.checkpoint import shared_folder
from pgccd.distributed.checkpoint.partition import load_partition
from pgccd.distributed.checkpoint.shared_folder import sees_mark
from pgccd.distributed.partition.cut import PARTITIONS, make_partition
from pgccd.sim import Simulation, resume, run, runner
from pgccd.sim.pictures import write_pictures
from pgccd.sim.response import respond
from pgccd.sim.run_checkpoint import require_checkpoint
from pgccd.sim.runner import load_robots

CONFIG = sim.ModelConfig(robots=240, pattern="skewed", speed=0.25, seed=5)


EAGER = BalanceOptions("cost", start=0.0, goal=0.0, moving=0.0, deciding=0.0)


def go_on(comm: Comm, folder: str, kind: str = "cells") -> list[dict[str, Any]]:
    """Six steps, then two more; returns the log."""
    options = RankOptions(kind, cells=4, balance=EAGER)
    run(CONFIG, 6, folder, options=options, comm=comm)
    stored = require_checkpoint(Path(folder))
    half = sim.Model(CONFIG).half_extent
    start = make_partition(kind, tuple(-x for x in half), half, comm.size, 3, 4, torch.device("cpu"))
    name = "owner" if kind == "cells" else "planes"
    kept = stored.shared()[name]
    assert not torch.equal(kept, getattr(start, name))
    others = [Cells.uniform(start.lower, half, comm.size + n, cells=5 - n) for n in (0, 1)]
    others += [Bisection.uniform(start.lower, half, comm.size + 1)]
    others += [replace(start, upper=(half[0], half[1], 2.0 * half[2]))]
    for other in others:
        assert load_partition(comm, stored, other) is other

    began, create = [], Simulation.create

    def begin(comm: Comm, model: sim.Model, partition: Partition, *rest: Any) -> Simulation:
        began.append(partition)
        return create(comm, model, partition, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Simulation, "create", begin)
        finished = resume(folder, 8, options=options, comm=comm)
    assert torch.equal(getattr(began[0], name), kept)
    return finished.records


def go_on_as(comm: Comm, folder: str, kind: str) -> list[dict[str, Any]]:
    """Two more steps on another number of ranks; returns the log."""
    options = RankOptions(kind, cells=4, balance=EAGER)
    return resume(folder, 10, options=options, comm=comm).records


@pytest.mark.parametrize("kind", PARTITIONS)
def test_the_partition_is_kept(ranks: World, tmp_path: Path, kind: str) -> None:
    """A resumed run keeps it; another number of ranks begins with a uniform one."""
    records = ranks.run(3, go_on, str(tmp_path / "three"), kind)[0]
    alone = sim.run(CONFIG, 10, tmp_path / "one").records
    assert [record["state_hash"] for record in records] == [record["state_hash"] for record in alone[:8]]
    last = ranks.run(2, go_on_as, str(tmp_path / "three"), kind)[0][-1]
    assert last["state_hash"] == alone[-1]["state_hash"]


def kinds_when_resumed(comm: Comm, folder: str, kind: str) -> list[str]:
    """Three steps with one kind of partition, then one more with each of these options; the kinds used."""
    run(CONFIG, 3, folder, options=RankOptions(kind), comm=comm)
    options = [RankOptions(), RankOptions("cells"), RankOptions("bisection")]
    options += [RankOptions(cells=5), RankOptions(balance=BalanceOptions("one-cell"))]
    began, create = [], Simulation.create

    def begin(comm: Comm, model: sim.Model, partition: Partition, *rest: Any) -> Simulation:
        began.append(type(partition).__name__)
        return create(comm, model, partition, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Simulation, "create", begin)
        for step, option in enumerate(options):
            resume(folder, 4 + step, options=option, comm=comm)
    return began


@pytest.mark.parametrize(("kind", "kept"), [("auto", "Bisection"), ("cells", "Cells"), ("bisection", "Bisection")])
def test_auto_keeps_the_kind_of_partition(ranks: World, tmp_path: Path, kind: str, kept: str) -> None:
    kinds = ranks.run(2, kinds_when_resumed, str(tmp_path), kind)[0]
    assert kinds == [kept, "Cells", "Bisection", "Cells", "Cells"]


def share(comm: Comm, folder: str) -> tuple[list[int], str]:
    """The ids that a rank reads, or its error."""
    try:
        return load_robots(comm, require_checkpoint(Path(folder))).id.tolist(), ""
    except ValueError as error:
        return [], str(error)


def test_any_number_of_ranks_reads_what_another_wrote(ranks: World, tmp_path: Path) -> None:
    ranks.run(3, go_on, str(tmp_path))
    whole = sim.load_checkpoint(tmp_path)
    assert whole.state.id.tolist() == list(range(240)) and whole.steps_made == 8
    for size in (1, 2, 4):
        shares = [ids for ids, _ in ranks.run(size, share, str(tmp_path))]
        assert sorted(sum(shares, [])) == list(range(240))
        assert {len(ids) for ids in shares} == {240 // size}
    # All ranks raise an error for damaged files, whichever rank reads them.
    damaged = newest(tmp_path) / "rank-00001.safetensors"
    content = bytearray(damaged.read_bytes())
    content[-5] ^= 1
    damaged.write_bytes(content)
    for ids, said in ranks.run(4, share, str(tmp_path)):
        assert ids == [] and "rank-00001.safetensors is damaged: its hash" in said


def load(comm: Comm, folder: str, kind: str) -> str:
    """The error of a rank that loads the partition, or an empty string."""
    half = sim.Model(CONFIG).half_extent
    lower = tuple(-x for x in half)
    uniform = make_partition(kind, lower, half, comm.size, 3, 4, torch.device("cpu"))
    try:
        load_partition(comm, require_checkpoint(Path(folder)), uniform)
    except ValueError as error:
        return str(error)
    return ""


def test_the_partition_is_verified(ranks: World, tmp_path: Path) -> None:
    ranks.run(2, go_on, str(tmp_path))
    table = newest(tmp_path) / "shared.safetensors"
    table.write_bytes(table.read_bytes()[:-8])
    for said in ranks.run(2, load, str(tmp_path), "cells"):
        assert re.search(r"shared.safetensors is damaged: it has \d+ bytes", said)


def changed(planes: torch.Tensor, row: int, column: int, value: float) -> dict[str, torch.Tensor]:
    planes = planes.clone()
    planes[row, column] = value
    return {"planes": planes}


#: By fault of the planes of three ranks: the changed planes, and the expected error.
WRONG_PLANES: dict[str, tuple[Callable[[torch.Tensor], dict[str, torch.Tensor]], str]] = {
    "none": (lambda planes: {"owner": torch.zeros(3)}, "it has no 'planes'"),
    "too few": (lambda planes: {"planes": planes[:1].clone()}, r"expected \(2, 4\) float64, got \(1, 4\)"),
    "single": (lambda planes: {"planes": planes.float()}, r"expected \(2, 4\) float64, got \(2, 4\) torch.float32"),
    "nan": (lambda planes: changed(planes, 1, 1, float("nan")), "expected finite numbers"),
    "infinite": (lambda planes: changed(planes, 0, 1, float("inf")), "expected finite numbers"),
    "outside": (lambda planes: changed(planes, 1, 1, 1e6), "1000000.0 is outside of the part"),
    "axis": (lambda planes: changed(planes, 0, 0, 7.0), "expected a tree of 3 parts"),
    "a circle": (lambda planes: changed(planes, 1, 3, 0.0), "expected a tree of 3 parts"),
    "a rank twice": (lambda planes: changed(planes, 1, 3, -2.0), "expected a tree of 3 parts"),
}


@pytest.fixture(scope="module")
def by_three(ranks: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three ranks with planes that have moved."""
    folder = tmp_path_factory.mktemp("three")
    ranks.run(3, go_on, str(folder), "bisection")
    assert ranks.run(3, load, str(folder), "bisection") == [""] * 3
    return folder


@pytest.mark.parametrize("wrong", list(WRONG_PLANES))
def test_planes_that_were_planted(ranks: World, by_three: Path, tmp_path: Path, wrong: str) -> None:
    """With valid hashes."""
    shutil.copytree(by_three, tmp_path, dirs_exist_ok=True)
    path = newest(tmp_path) / "shared.safetensors"
    change, expected = WRONG_PLANES[wrong]
    save_file(change(load_file(path)["planes"]), path)
    raw = path.read_bytes()
    about = {"bytes": len(raw), "sha256": hashlib.sha256(raw).hexdigest()}
    plant(tmp_path, lambda index: index["shared"].update(about))
    for said in ranks.run(3, load, str(tmp_path), "bisection"):
        assert re.search(expected, said) and str(tmp_path) in said and len(said.splitlines()) == 1


#: By kind of a partition: changes of its header, and the expected errors.
WRONG_HEADERS: list[tuple[str, Any, str]] = [
    *((kind, {"ranks": 2}, "ranks: 2, but there are 3 files, one per rank") for kind in PARTITIONS),
    *((kind, {"ranks": 2**60}, f"ranks: {2**60}, but there are 3 files") for kind in PARTITIONS),
    *((kind, {"ranks": wrong}, "expected numbers >= 0") for kind in PARTITIONS for wrong in (-3, 3.0, True, None)),
    ("bisection", {"kind": "voronoi"}, "kind: 'voronoi'"),
    ("cells", {"subdomains": [2, 1, 1]}, r"subdomains, cells: \[2, 1, 1\] of \[4, 4, 1\] for 3 ranks"),
    ("cells", {"subdomains": [3, 1]}, "subdomains, cells"),
    ("cells", {"cells": [2**20, 2**20, 2**20]}, r"\d+ bytes of cells, more than its table has"),
    ("cells", {"cells": [-4, -4, 1]}, "expected numbers >= 0"),
    ("cells", {"cells": None}, "not iterable"),
    ("bisection", [3], "list indices"),
]


def test_partition_headers_that_were_planted(ranks: World, tmp_path: Path) -> None:
    """With valid hashes, read by as many ranks and by others, for which the balance does not count."""
    for kind in PARTITIONS:
        ranks.run(3, go_on, str(tmp_path / kind), kind)
    for number, (kind, change, expected) in enumerate(WRONG_HEADERS):
        folder = tmp_path / str(number)
        shutil.copytree(tmp_path / kind, folder)

        def plant_change(index: dict[str, Any], change: Any = change) -> None:
            header = index["header"]
            header["partition"] = header["partition"] | change if isinstance(change, dict) else change

        plant(folder, plant_change)
        for size in (3, 2):
            for said in ranks.run(size, load, str(folder), kind):
                assert re.search(f"index.json is not .*: its partition: .*{expected}", said), (change, said)
                assert str(folder) in said and len(said.splitlines()) == 1
    for kind in PARTITIONS:
        shutil.copytree(tmp_path / kind, tmp_path / "without" / kind)
        plant(tmp_path / "without" / kind, lambda index: index["header"]["partition"].pop("ranks"))
        for said in ranks.run(2, load, str(tmp_path / "without" / kind), kind):
            assert "its partition: no 'ranks'" in said


def see(comm: Comm, folder: str) -> str:
    """The error of a rank with a separate folder."""
    try:
        run(CONFIG, 1, Path(folder) / str(comm.rank), comm=comm)
    except ValueError as error:
        return str(error)
    return ""


def test_a_folder_that_ranks_do_not_share(ranks: World, tmp_path: Path) -> None:
    for said in ranks.run(2, see_at_once, str(tmp_path)):
        assert re.search(r"folder: .*/1 on .* is not that of rank 0", said)


def see_at_once(comm: Comm, folder: str) -> str:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shared_folder, "sees_mark", lambda folder, name: sees_mark(folder, name, within=0.2))
        patch.setattr(runner._Plan, "agree", lambda *_: None)
        return see(comm, folder)


def draw(comm: Comm, folder: str) -> tuple[int, list[int], list[list[int]]]:
    """Pictures of a world too large for one rank: the sample, and its contacts by ids."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "_MOST_GATHERED", 100)
        finished = run(CONFIG, 6, folder, keep_steps=3, comm=comm)
    (step,) = finished.last_steps  # of a sample only one
    assert torch.equal(step.after.id, step.before.id)
    assert torch.equal(respond(step.before, step.resolution.fraction).position, step.after.position)
    if comm.rank == 0:
        write_pictures(finished, Path(folder))
    return finished.one_in, finished.state.id.tolist(), step.before.id[step.contacts.pairs].tolist()


def test_large_worlds_are_drawn_from_a_sample(ranks: World, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    whole = sim.run(CONFIG, 6, tmp_path / "one")
    pairs = whole.last_steps[0].before.id[whole.last_steps[0].contacts.pairs]
    pairs = pairs[pairs[:, 0] % 3 == 0].tolist()
    assert len(pairs) > 1
    of_ranks = ranks.run(2, draw, str(tmp_path / "two"))  # type: ignore[attr-defined]
    assert of_ranks[0] == (3, sorted({*range(0, 240, 3), *(id for pair in pairs for id in pair)}), pairs)
    assert of_ranks[1] == (3, [], [])
    assert "one in 3 robots is shown" in (tmp_path / "two" / "world.html").read_text()


def keep(comm: Comm, folder: str) -> list[list[list[object]]]:
    finished = run(CONFIG, 9, folder, keep_steps=4, comm=comm)
    return [of_step(step) for step in finished.last_steps]


def of_step(step: sim.Step) -> list[list[object]]:
    columns = (step.before.position, step.before.id, step.resolution.fraction, step.after.position, step.after.velocity)
    contacts = (step.contacts.pairs, step.toi, step.contacts.point)
    return [[step.index], *(column.tolist() for column in (*columns, *contacts))]


def test_last_steps_are_those_of_one_process(ranks: World, tmp_path: Path) -> None:
    whole = sim.run(CONFIG, 9, tmp_path / "one", keep_steps=4)
    expected = [of_step(step) for step in whole.last_steps]
    assert [step[0] for step in expected] == [[5], [6], [7], [8]] and sum(len(step[-1]) for step in expected) > 1
    of_ranks = ranks.run(2, keep, str(tmp_path / "two"))  # type: ignore[attr-defined]
    assert of_ranks[0] == expected
