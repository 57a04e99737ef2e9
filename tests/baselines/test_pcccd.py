"""The voxel-based baseline returns the same contacts as pgccd, bitwise, for any number of ranks and voxel size."""

from __future__ import annotations

import functools
from dataclasses import replace

import pytest
import torch
from support.crowds import Crowd, crowds
from support.ranks import World
from support.same_bits import assert_same
from support.steps import step_of

import pgccd
from pgccd import sim
from pgccd.baselines import PCCCD
from pgccd.distributed import Comm

# Voxels in the box [0, 8]^3: 64, one, and less than one.
SETTINGS = ((2.0, "all"), (8.0, "first"), (800.0, "all"))
# The baseline has no filters, so these bodies do meet.
NAMES = ("met in a third rank's cell", "on corners of many cells", "faster than cells", "all in one cell")
NAMES += ("outside the box", "a terrain under all", "kept apart, filtered")


@functools.cache
def expected(name: str, report: str) -> pgccd.Contacts:
    crowd = crowds()[name]
    motion = crowd.motion(torch.arange(len(crowd.position)))
    return pgccd.detect(pgccd.Scene(crowd.meshes, crowd.mesh_index), motion, report, crowd.min_separation)


def dealt_out(comm: Comm, crowd: Crowd, seed: int) -> torch.Tensor:
    """Rows of this rank's bodies."""
    generator = torch.Generator().manual_seed(seed)
    return torch.nonzero(torch.randint(comm.size, (len(crowd.position),), generator=generator) == comm.rank)[:, 0]


def compare(comm: Comm, name: str, wholes: dict[str, pgccd.Contacts] | None = None) -> int:
    """Compares with the contacts of one process, by report; returns the number of contacts of all bodies."""
    crowd = crowds()[name]
    ids = 10 * torch.arange(len(crowd.position)) + 3
    for index, (size, report) in enumerate(SETTINGS):
        mine = dealt_out(comm, crowd, index).flip(0)  # not sorted
        baseline = PCCCD.create(crowd.meshes, size, comm=comm, report=report, min_separation=crowd.min_separation)
        whole = wholes[report] if wholes else expected(name, report)
        mine_too = torch.isin(whole.pairs, mine).any(dim=1)
        for moved in (False, True) if index == 0 else (False,):
            if moved:
                baseline.balance()
            hits = baseline.detect(crowd.motion(mine), ids[mine], crowd.mesh_index[mine])
            assert_same(hits, replace(whole, pairs=ids[whole.pairs])[mine_too])
    return len(whole)


@pytest.mark.parametrize("name", NAMES)
def test_contacts_of_pgccd(world: World, name: str) -> None:
    wholes = {report: expected(name, report) for report in ("first", "all")}
    assert min(world(compare, name, wholes)) > 0


def compare_robots(comm: Comm, pattern: str) -> int:
    """The model of the evaluation, with a block of robots per rank; returns the total number of contacts."""
    model = sim.Model(sim.ModelConfig(robots=120, pattern=pattern, spacing=2.05, speed=0.15))
    state, contacts = model.start(), 0
    scene = model.scene(state.id)
    begin, end = (rank * len(state) // comm.size for rank in (comm.rank, comm.rank + 1))
    mine = torch.arange(begin, end)
    baseline = PCCCD.create(model.meshes.meshes, comm=comm)
    for index in range(5):
        step = step_of(model, state, index)
        state, whole = step.after, step.contacts
        before = sim.RobotState(**{name: column[mine] for name, column in step.before.columns.items()})
        motion = model.motion(before)
        hits = baseline.detect(motion, mine, scene.mesh_index[mine])
        mine_too = torch.isin(whole.pairs, mine).any(dim=1)
        assert_same(hits, whole[mine_too])
        contacts += len(whole)
    return contacts


@pytest.mark.parametrize("pattern", ["random", "skewed"])
def test_contacts_of_the_simulation(world: World, pattern: str) -> None:
    assert min(world(compare_robots, pattern)) > 10


def voxels_after_balance(comm: Comm) -> tuple[list[int], list[int]]:
    """All bodies are on rank 0; boxes of voxels per rank, before and after balancing."""
    crowd = crowds()["kept apart, filtered"]
    mine = torch.arange(len(crowd.position) if comm.rank == 0 else 0)
    baseline = PCCCD.create(crowd.meshes, 1.0, comm=comm)
    seen = []
    for _ in range(2):
        baseline.detect(crowd.motion(mine), mine, crowd.mesh_index[mine])
        boxes = int(baseline._contents.counts.sum())
        seen.append(comm.all_gather(torch.tensor([boxes]))[:, 0].tolist())
        baseline.balance()
    return seen[0], seen[1]


def test_voxels_live_where_they_were_first_sent_to_until_they_are_moved(world: World) -> None:
    before, after = world(voxels_after_balance)[0]
    assert before[1:] == [0] * (len(before) - 1) and sum(before) == sum(after)
    assert max(after) <= 1.1 * sum(after) / len(after)


def two_that_meet() -> tuple[Crowd, pgccd.RigidMotion]:
    crowd = crowds()[NAMES[0]]
    return crowd, crowd.motion(torch.arange(len(crowd.position)))


def test_what_it_did_is_counted() -> None:
    crowd, motion = two_that_meet()
    baseline = PCCCD.create(crowd.meshes, 1.0)
    hits = baseline.detect(motion, mesh_index=crowd.mesh_index)
    stats = baseline.stats
    assert stats.boxes >= sum(len(crowd.meshes[k].faces) for k in crowd.mesh_index.tolist())
    assert stats.voxels > 1 and stats.candidates >= stats.box_pairs >= stats.body_pairs >= len(hits) > 0
    stages = "contribute locate exchange synchronize bisect fetch narrow report"
    assert set(stats.seconds) == set(stages.split())


def test_nonsense_is_refused_by_name() -> None:
    crowd, motion = two_that_meet()
    for size in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="voxel_size"):
            PCCCD.create(crowd.meshes, size)
    with pytest.raises(TypeError, match="voxel_size"):
        PCCCD.create(crowd.meshes, "a")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="report"):
        PCCCD.create(crowd.meshes, report="any")  # type: ignore[arg-type]
    box = pgccd.Mesh.box([1.0, 1.0, 1.0])
    for other in (pgccd.Mesh.sphere(0.5), pgccd.Mesh.capsule(0.1, 1.0), box.thickened(0.1)):
        with pytest.raises(ValueError, match=r"^meshes: expected triangles alone.* as number 1"):
            PCCCD.create([box, other])
    baseline = PCCCD.create(crowd.meshes)
    with pytest.raises(RuntimeError, match="nothing has been detected"):
        baseline.balance()
    with pytest.raises(TypeError, match="motion"):
        baseline.detect(None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="id"):
        baseline.detect(motion, torch.arange(99), crowd.mesh_index)
    with pytest.raises(ValueError, match="mesh_index"):
        baseline.detect(motion, mesh_index=crowd.mesh_index + 100)
    with pytest.raises(ValueError, match="voxel_size"):
        PCCCD.create(crowd.meshes, 1e-9).detect(motion, mesh_index=crowd.mesh_index)


def test_nothing_to_find() -> None:
    crowd, motion = two_that_meet()
    none = torch.zeros(0, dtype=torch.int64)
    baseline = PCCCD.create(crowd.meshes)
    assert len(baseline.detect(crowd.motion(none), none, none.int())) == 0
    assert len(baseline.detect(crowd.motion(none[:0].new_tensor([0])), mesh_index=crowd.mesh_index[:1])) == 0
