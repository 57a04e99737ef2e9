"""A run that goes on keeps what balancing has come to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from distributed.conftest import World
from pgccd import sim
from pgccd.distributed import BalanceOptions, Comm, Partition
from pgccd.sim.distributed import DistributedOptions, DistributedSimulation, resume, run, runner
from pgccd.sim.distributed.checkpoint import read_owners

CONFIG = sim.ModelConfig(robots=240, pattern="skewed", speed=0.25, seed=5)


def go_on(comm: Comm, folder: str) -> list[dict[str, Any]]:
    """Six steps, then two more; returns the log."""
    eager = BalanceOptions("cost", start=0.0, goal=0.0, moving=0.0)
    options = DistributedOptions(cells=4, balance=eager)
    run(comm, CONFIG, 6, folder, options=options)
    half = sim.Model(CONFIG).half_extent
    lower = tuple(-x for x in half)
    start = Partition.uniform(lower, half, comm.size, cells=4)
    owners = read_owners(Path(folder), start)
    assert owners is not None and owners != start.owner.tolist()
    assert read_owners(Path(folder), Partition.uniform(lower, half, comm.size, cells=5)) is None
    assert read_owners(Path(folder), Partition.uniform(lower, half, comm.size + 1, cells=4)) is None

    began = []

    def begin(comm: Comm, model: sim.Model, partition: Partition, *rest: Any) -> DistributedSimulation:
        began.append(partition)
        return DistributedSimulation(comm, model, partition, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "DistributedSimulation", begin)
        finished = resume(comm, folder, 8, options=options)
    assert torch.equal(began[0].owner, torch.tensor(owners))
    return finished.records


def test_owners_of_cells_are_kept(ranks: World, tmp_path: Path) -> None:
    records = ranks.run(3, go_on, str(tmp_path / "three"))[0]
    alone = sim.run(CONFIG, 8, tmp_path / "one").records
    assert [record["state_hash"] for record in records] == [record["state_hash"] for record in alone]


def test_a_broken_table_is_named(ranks: World, tmp_path: Path) -> None:
    ranks.run(3, go_on, str(tmp_path))
    (table,) = tmp_path.glob("checkpoints/step-*/owners.json")
    table.write_text("{}")
    with pytest.raises(ValueError, match="does not contain the owners of cells"):
        read_owners(tmp_path, Partition.uniform((0.0,) * 3, (1.0,) * 3, 3))
