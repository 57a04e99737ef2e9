"""A run that goes on keeps what balancing has come to."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

from distributed.conftest import World
from pgccd import sim
from pgccd.distributed import BalanceOptions, Cells, Comm
from pgccd.sim.checkpoint import require_checkpoint
from pgccd.sim.distributed import DistributedOptions, DistributedSimulation, resume, run, runner
from pgccd.sim.distributed.checkpoint import load_share
from pgccd.sim.run_folder import sees_mark
from pgccd.sim.summary import write_pictures

CONFIG = sim.ModelConfig(robots=240, pattern="skewed", speed=0.25, seed=5)


def go_on(comm: Comm, folder: str) -> list[dict[str, Any]]:
    """Six steps, then two more; returns the log."""
    eager = BalanceOptions("cost", start=0.0, goal=0.0, moving=0.0)
    options = DistributedOptions(cells=4, balance=eager)
    run(comm, CONFIG, 6, folder, options=options)
    half = sim.Model(CONFIG).half_extent
    start = Cells.uniform(tuple(-x for x in half), half, comm.size, cells=4)
    owners = require_checkpoint(Path(folder)).owners()
    assert owners is not None and not torch.equal(owners.owner, start.owner)
    for other in (Cells.uniform(start.lower, half, comm.size + n, cells=5 - n) for n in (0, 1)):
        assert runner._owned_as_before(owners, other) is other

    began = []

    def begin(comm: Comm, model: sim.Model, partition: Cells, *rest: Any) -> DistributedSimulation:
        began.append(partition)
        return DistributedSimulation(comm, model, partition, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "DistributedSimulation", begin)
        finished = resume(comm, folder, 8, options=options)
    assert torch.equal(began[0].owner, owners.owner)
    return finished.records


def test_owners_of_cells_are_kept(ranks: World, tmp_path: Path) -> None:
    records = ranks.run(3, go_on, str(tmp_path / "three"))[0]
    alone = sim.run(CONFIG, 8, tmp_path / "one").records
    assert [record["state_hash"] for record in records] == [record["state_hash"] for record in alone]


def share(comm: Comm, folder: str) -> tuple[list[int], str]:
    """The ids that a rank reads, or what it is told."""
    try:
        return load_share(comm, require_checkpoint(Path(folder))).id.tolist(), ""
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
    # What is damaged is refused by all, whichever of them has looked at it.
    (damaged,) = tmp_path.glob("checkpoints/step-*/rank-00001.safetensors")
    content = bytearray(damaged.read_bytes())
    content[-5] ^= 1
    damaged.write_bytes(content)
    for ids, said in ranks.run(4, share, str(tmp_path)):
        assert ids == [] and "rank-00001.safetensors is damaged: its hash" in said


def test_owners_are_verified(ranks: World, tmp_path: Path) -> None:
    ranks.run(2, go_on, str(tmp_path))
    (table,) = tmp_path.glob("checkpoints/step-*/owners.safetensors")
    table.write_bytes(table.read_bytes()[:-8])
    with pytest.raises(ValueError, match=r"owners.safetensors is damaged: it has \d+ bytes"):
        require_checkpoint(tmp_path).owners()


def see(comm: Comm, folder: str) -> str:
    """What a rank is told whose folder is its own."""
    try:
        run(comm, CONFIG, 1, Path(folder) / str(comm.rank))
    except ValueError as error:
        return str(error)
    return ""


def test_a_folder_that_ranks_do_not_share(ranks: World, tmp_path: Path) -> None:
    for said in ranks.run(2, see_at_once, str(tmp_path)):
        assert re.search(r"folder: .*/1 on .* is not that of rank 0", said)


def see_at_once(comm: Comm, folder: str) -> str:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "sees_mark", lambda folder, name: sees_mark(folder, name, within=0.2))
        patch.setattr(runner, "_compare", lambda *_: None)
        return see(comm, folder)


def draw(comm: Comm, folder: str) -> tuple[int, list[int], bool]:
    """Pictures of a world too large for one rank."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "_MOST_GATHERED", 100)
        finished = run(comm, CONFIG, 3, folder, keep_last_step=True)
    if comm.rank == 0:
        write_pictures(finished, Path(folder))
    return finished.one_in, finished.state.id.tolist(), finished.last_step is None


def test_large_worlds_are_drawn_from_a_sample(ranks: World, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    of_ranks = ranks.run(2, draw, str(tmp_path))  # type: ignore[attr-defined]
    assert of_ranks[0] == (3, list(range(0, 240, 3)), True)
    assert of_ranks[1] == (3, [], True)
    assert "one in 3 robots is drawn" in (tmp_path / "world.html").read_text()
