"""Boxes of swept spheres: those of bodies that may collide overlap, as computed, at any position; equal on every
device.
"""

from __future__ import annotations

from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support.crowds import crowds
from support.ranks import World
from support.shapes import directions, tensors

import pgccd
from pgccd import ops, sim
from pgccd.distributed import Alone, Cells, Comm
from pgccd.distributed import World as SharedWorld
from pgccd.distributed.detection.options import PassEstimates, SearchOptions
from pgccd.distributed.detection.share import Share, search_share
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.search import bodies as moving
from pgccd.sim import Simulation, starting_share


def touching_spheres(seed: int, offset: float, separation: float) -> list[torch.Tensor]:
    """Pairs of moving spheres that just touch, to rounding, at t0, at t1, or in between: centres and radii."""
    rng = np.random.default_rng(seed)
    count = 200
    radius = 10.0 ** rng.uniform(-2, 2, (2, count))
    # Along an axis the boxes just touch too.
    axis = np.eye(3)[rng.integers(3, size=count)] * rng.choice([-1.0, 1.0], (count, 1))
    towards = np.where(rng.random((count, 1)) < 0.7, axis, directions(rng, count))
    gap = (radius.sum(axis=0) + separation)[:, None] * (1.0 + rng.choice([-1e-15, 0.0, 1e-15], (count, 1)))
    first = offset * rng.uniform(-1, 1, (count, 3))
    travel = rng.normal(size=(count, 3)) * rng.choice([0.0, 1.0, 30.0], (count, 1))
    away = rng.choice([0.0, 1.0], (count, 1)) * towards
    second = first + gap * towards
    ends = np.concatenate([first + travel, second + travel + away])
    return tensors(np.concatenate([first, second]), ends, radius.reshape(-1))


@given(st.integers(0, 10**6), st.sampled_from([0.0, 1.0, 1e4, 1e9]), st.sampled_from([0.0, 0.3]))
def test_boxes_of_potentially_colliding_pairs_overlap(seed: int, offset: float, separation: float) -> None:
    spheres = start, end, radius = touching_spheres(seed, offset, separation)
    pairs = ops.broad_pairs(spheres, separation, 0.0, 0, -1)
    assert len(pairs) > 50
    lower, upper = ops.swept_boxes(spheres, separation, 0.0)
    i, j = pairs.unbind(dim=1)
    assert bool(((lower[i] <= upper[j]) & (lower[j] <= upper[i])).all())
    # So both bodies reach the cell of the reference point.
    partition = Cells.uniform((-offset - 1.0,) * 3, (offset + 1.0,) * 3, 64, cells=(8, 8, 8))
    cell = partition.coordinates(torch.maximum(lower[i], lower[j]))
    for body in (i, j):
        assert bool((partition.coordinates(lower[body]) <= cell).all())
        assert bool((cell <= partition.coordinates(upper[body])).all())


def test_boxes_hold_their_bodies_and_are_tight(device: torch.device) -> None:
    spheres = start, end, radius = touching_spheres(7, 3.0, 0.0)
    lower, upper = (x.cpu() for x in ops.swept_boxes([x.to(device) for x in spheres], 0.5, 0.0))
    reach = radius[:, None] + 0.25
    least, most = torch.minimum(start, end) - reach, torch.maximum(start, end) + reach
    assert bool((lower <= least).all()) and bool((upper >= most).all())
    assert bool(((least - lower) <= 1e-11 * (reach + (end - start).abs().amax(dim=1, keepdim=True))).all())
    on_cpu = ops.swept_boxes(spheres, 0.5, 0.0)
    assert torch.equal(lower, on_cpu[0]) and torch.equal(upper, on_cpu[1])


def test_bad_poses_and_separations_are_named() -> None:
    model = sim.Model(sim.ModelConfig(robots=8))
    state = model.start()
    decomposition = Decomposition(Alone(), Cells.uniform((-1.0,) * 3, (1.0,) * 3, 1))

    def search(options: SearchOptions) -> Share:
        bodies = pgccd.MovingBodies.of(model.scene(state.id), model.motion(state), wait=False)
        asked = decomposition, {"id": state.id}, bodies, lambda ghosts: ghosts, options, PassEstimates()
        return search_share(*asked, concurrent_work=lambda share: None)[0]

    with pytest.raises(ValueError, match="^min_separation: "):
        search(SearchOptions(min_separation=-1.0))
    state.position[3, 1] = torch.nan
    with pytest.raises(ValueError, match="^position: body 3|^position_t0: body 3"):
        search(SearchOptions())


def test_motion_from_rotation_is_the_motion_it_was_made_of() -> None:
    model = sim.Model(sim.ModelConfig(robots=50))
    state = model.start()
    motion = model.motion(state)
    rows = torch.tensor([4, 17, 33])
    columns = (motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation)
    part = pgccd.RigidMotion.from_rotation(*(column[rows] for column in columns))
    for name in ("position_t0", "orientation_t0", "position_t1", "rotation"):
        assert torch.equal(getattr(part, name), getattr(motion, name)[rows])
    with pytest.raises(ValueError, match="^rotation: body 1"):
        pgccd.RigidMotion.from_rotation(*columns[:3], torch.tensor([[0.0], [1e7]]).expand(2, 3).repeat(25, 1).double())
    with pytest.raises(ValueError, match="^rotation: expected shape"):
        pgccd.RigidMotion.from_rotation(*columns[:3], motion.rotation[1:])


@pytest.mark.parametrize("path", ["rigid", "linear"])
def test_bodies_of_columns_are_those_of_scene_and_motion(path: Any) -> None:
    """Off-centre meshes, margins and filters."""
    crowd = crowds()["about joints outside of them"]
    count = len(crowd.position)
    margin = 0.01 * torch.rand(count, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    scene = pgccd.Scene(crowd.meshes, crowd.mesh_index, margin=margin, group=torch.arange(count) % 4 + 1)
    motion = crowd.motion(torch.arange(count))
    motion = pgccd.RigidMotion.from_rotation(**motion.columns(), path=path)
    bodies = pgccd.MovingBodies.of(scene, motion)
    again = pgccd.MovingBodies.of_columns(scene.meshes, bodies.columns, path == "linear")
    assert again.linear_path == bodies.linear_path and not scene.meshes.is_centred
    for one, other in zip(bodies.tensors, again.tensors, strict=True):
        assert torch.equal(one, other)
    for one, other in zip(bodies.swept_spheres, again.swept_spheres, strict=True):
        assert torch.equal(one, other)
    assert torch.equal(pgccd.broad.sweep(again), pgccd.broad.sweep(bodies))


def test_ghosts_of_the_simulation_move_as_robots() -> None:
    model = sim.Model(sim.ModelConfig(robots=50, speed=0.3, spin=0.5))
    partition = Cells.uniform((-1.0,) * 3, (1.0,) * 3, 1)
    simulation = Simulation.create(Alone(), model, partition, starting_share(Alone(), model))
    planned = model.plan(model.start(), 3)
    found = simulation._complete(planned.moving_columns)
    expected = model.motion(planned).columns() | {"mesh_index": model.scene(planned.id).mesh_index}
    assert found.keys() == expected.keys()
    for name, column in expected.items():
        assert torch.equal(found[name], column), name


def validations(comm: Comm) -> tuple[int, int]:
    """How often columns of a motion are checked in a step of a `World`, and number of ghosts."""
    mine = torch.arange(comm.rank, 60, comm.size)
    position = torch.rand((60, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(5))[mine]
    mesh = pgccd.Mesh(0.05 * torch.eye(4, 3).double(), [[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]])
    scene = pgccd.Scene([mesh], [0] * len(mine))
    world = SharedWorld.create(scene, position, (0.0,) * 3, (1.0,) * 3, id=mine, comm=comm)
    turn = torch.eye(4).double()[:1].repeat(len(world.id), 1)
    motion = pgccd.RigidMotion.from_velocity(world.position, turn, turn[:, :3], turn[:, :3], dt=0.1)
    with mock.patch.object(moving.ops, "sound_radii", wraps=moving.ops.sound_radii) as checked:
        world.step(motion)
    assert world.found is not None
    return checked.call_count, world.found.held.ghost_count


def test_poses_are_validated_once(ranks: World) -> None:
    for size in (1, 2):
        for checked, ghosts in ranks.run(size, validations):
            assert checked == 1 and (ghosts > 0) == (size > 1)


def spoil(comm: Comm) -> None:
    """A NaN pose on one rank: the error names it there; no rank receives such a body."""
    model = sim.Model(sim.ModelConfig(robots=60))
    half = model.half_extent
    partition = Cells.uniform(tuple(-x for x in half), half, comm.size, cells=2)
    simulation = Simulation.create(comm, model, partition, starting_share(comm, model))
    if comm.rank == comm.size - 1:
        simulation.state.position[3, 1] = torch.nan
        with pytest.raises(ValueError, match="^position: body 3|^position_t0: body 3"):
            simulation.step(0)


def test_bad_poses_are_named_on_the_rank_that_has_them(ranks: World) -> None:
    ranks.run(1, spoil)
