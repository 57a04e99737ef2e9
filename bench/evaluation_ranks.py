"""One rank of the evaluation; started by the scripts of the figures, with its cases in a folder."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import torch
from support import timing
from support.evaluation import Case, Steps, world_file

from pgccd import distributed, sim
from pgccd.baselines import PCCCD
from pgccd.distributed.partition.balance import Policy

_POLICIES: dict[str, Policy] = {"PGCCD": "none", "PGCCD+LB": "one-cell", "PGCCD, by cost": "cost"}


def main() -> None:
    """Measures all cases; rank 0 writes the rows."""
    folder = Path(sys.argv[1])
    todo = json.loads((folder / "cases.json").read_text())
    steps = Steps(**todo["steps"])
    rows = []
    with distributed.connect(todo["device"]) as comm:
        for case in (Case(**each) for each in todo["cases"]):
            given = torch.load(world_file(folder, case.robots, case.pattern))
            measure = measure_baseline if case.system == "PCCCD" else measure_simulation
            row = vars(case) | measure(comm, case, steps, given)
            rows.append(row | {"transport": comm.transport, "threads_a_rank": torch.get_num_threads()})
            if comm.rank == 0:
                print(
                    f"{case.system}, {case.device}, {case.ranks} ranks, {case.robots:,} robots, {case.pattern}: "
                    f"{row['ms']['median']:.4g} ms",
                    flush=True,
                )
        if comm.rank == 0:
            (folder / "rows.json").write_text(json.dumps(rows))


def measure_simulation(comm: distributed.Comm, case: Case, steps: Steps, given: dict[str, Any]) -> dict[str, Any]:
    """Whole steps of the simulation."""
    device = distributed.choose_device(case.device)
    config = sim.ModelConfig(**given["config"])
    model = sim.Model(config, device=device)
    x, y, z = model.half_extent
    upper = (2.0 * x * case.stretch - x, y, z)
    partition = distributed.Cells.uniform((-x, -y, -z), upper, comm.size, axes=case.axes, device=device)
    mine = {name: column[comm.rank :: comm.size].to(device) for name, column in given["start"].items()}
    policy = _POLICIES[case.system]
    balance = distributed.BalanceOptions(policy, threshold=case.threshold)
    options = distributed.RankOptions(balance=balance)
    simulation = sim.Simulation.create(comm, model, partition, sim.RobotState(**mine), options)
    made, ends = [], []
    comm.barrier()
    end = steps.before + steps.settling + steps.timed
    for index in range(steps.before, end):
        made.append(simulation.step(index, more=end - index))
        ends.append(time.perf_counter())
    records = [step.record for step in made]
    _require_hashes([record["contacts_hash"] for record in records], given["hashes"], case)
    first = steps.settling
    own = [end - begin for begin, end in zip(ends[first - 1 :], ends[first:], strict=False)]
    slowest = comm.all_gather(torch.tensor(own, dtype=torch.float64)).amax(dim=0).tolist()
    timed = records[first:]
    return {
        "ms": timing.summary(slowest),
        "pairs": _mean(record["pcs"] for record in timed),
        "contacts": _mean(record["contacts"] for record in timed),
        "imbalance": timing.rounded(_mean(record["ranks"]["imbalance"] for record in timed)),
        "moved_cells_a_step": timing.rounded(_mean(record["ranks"]["moved_cells"] for record in timed)),
    }


def measure_baseline(comm: distributed.Comm, case: Case, steps: Steps, given: dict[str, Any]) -> dict[str, Any]:
    """Detection by PCCCD; each rank has a block of robots in their initial lattice order."""
    config = sim.ModelConfig(**given["config"])
    model = sim.Model(config)
    begin, end = (rank * case.robots // comm.size for rank in (comm.rank, comm.rank + 1))
    baseline = PCCCD.create(model.meshes.meshes, comm=comm, nonzero_toi=True)
    durations, stages, boxes = [], [], 0
    for number, columns in enumerate(given["states"]):
        mine = sim.RobotState(**{name: column[begin:end] for name, column in columns.items()})
        index = steps.before + steps.settling + number
        motion = model.motion(model.plan(mine, index))
        scene = model.scene(mine.id)
        if number == 0:
            baseline.detect(motion, mine.id, scene.mesh_index)  # creates the voxels
        comm.barrier()
        start = time.perf_counter()
        hits = baseline.detect(motion, mine.id, scene.mesh_index)
        durations.append(time.perf_counter() - start)
        assert baseline.stats is not None and hits.toi is not None
        stages.append(baseline.stats.seconds)
        boxes += baseline.stats.boxes
        first_is_mine = (hits.pairs[:, 0] >= begin) & (hits.pairs[:, 0] < end)  # contacts between two ranks are on both
        part = torch.tensor([sim.contacts_hash(hits.pairs[first_is_mine], hits.toi[first_is_mine]) - 2**63])
        total = sum(value + 2**63 for value in comm.all_gather(part)[:, 0].tolist()) % 2**64
        _require_hashes([f"{total:016x}"], given["hashes"][steps.settling + number :][:1], case)
    slowest = comm.all_gather(torch.tensor(durations, dtype=torch.float64)).amax(dim=0).tolist()
    names = list(stages[0])
    of_ranks = comm.all_gather(torch.tensor([_mean(step[name] for step in stages) for name in names]).double())
    boxes_in_all = int(comm.sum(torch.tensor([boxes])))
    return {
        "ms": timing.summary(slowest),
        "stage_ms": {
            name: timing.rounded(1e3 * value) for name, value in zip(names, of_ranks.amax(dim=0).tolist(), strict=True)
        },
        "boxes_a_triangle": timing.rounded(
            boxes_in_all / len(durations) / (case.robots * len(model.meshes.meshes[0].faces))
        ),
        "voxel_size": timing.rounded(baseline.voxel_size),
    }


def _require_hashes(found: list[str], expected: list[str], case: Case) -> None:
    if found != expected[: len(found)]:
        raise SystemExit(f"{case}: other contacts than those of one process")


def _mean(values: Any) -> float:
    values = list(values)
    return sum(values) / len(values)


if __name__ == "__main__":
    main()
