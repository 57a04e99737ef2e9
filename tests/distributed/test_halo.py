"""Boxes of swept spheres: those of bodies that may collide overlap, as computed, at any position; equal on every
device.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support.shapes import directions, tensors

import pgccd
from distributed.conftest import World
from pgccd import ops, sim
from pgccd.distributed import Alone, Cells, Comm
from pgccd.distributed.detection.options import Options, PartEstimates
from pgccd.distributed.detection.share import Share, search_share
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.sim.distributed import DistributedSimulation, starting_share


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
    start, end, radius = touching_spheres(seed, offset, separation)
    pairs = ops.broad_pairs(start, end, radius, None, None, None, None, None, separation, 0.0, 0, -1)
    assert len(pairs) > 50
    lower, upper = ops.swept_boxes(start, end, radius, separation, 0.0)
    i, j = pairs.unbind(dim=1)
    assert bool(((lower[i] <= upper[j]) & (lower[j] <= upper[i])).all())
    # So both bodies reach the cell of the reference point.
    partition = Cells.uniform((-offset - 1.0,) * 3, (offset + 1.0,) * 3, 64, cells=(8, 8, 8))
    cell = partition.coordinates(torch.maximum(lower[i], lower[j]))
    for body in (i, j):
        assert bool((partition.coordinates(lower[body]) <= cell).all())
        assert bool((cell <= partition.coordinates(upper[body])).all())


def test_boxes_hold_their_bodies_and_are_tight(device: torch.device) -> None:
    start, end, radius = touching_spheres(7, 3.0, 0.0)
    lower, upper = (x.cpu() for x in ops.swept_boxes(start.to(device), end.to(device), radius.to(device), 0.5, 0.0))
    reach = radius[:, None] + 0.25
    least, most = torch.minimum(start, end) - reach, torch.maximum(start, end) + reach
    assert bool((lower <= least).all()) and bool((upper >= most).all())
    assert bool(((least - lower) <= 1e-11 * (reach + (end - start).abs().amax(dim=1, keepdim=True))).all())
    on_cpu = ops.swept_boxes(start, end, radius, 0.5, 0.0)
    assert torch.equal(lower, on_cpu[0]) and torch.equal(upper, on_cpu[1])


def test_bad_poses_and_separations_are_named() -> None:
    model = sim.Model(sim.ModelConfig(robots=8))
    state = model.start()
    decomposition = Decomposition(Alone(), Cells.uniform((-1.0,) * 3, (1.0,) * 3, 1))
    bodies = pgccd.MovingBodies.of(model.scene(state.id), model.motion(state), wait=False)

    def search(options: Options) -> Share:
        asked = decomposition, {"id": state.id}, bodies, lambda ghosts: ghosts, options, PartEstimates()
        return search_share(*asked, beside=lambda share: None)[0]

    with pytest.raises(ValueError, match="^min_separation: "):
        search(Options(min_separation=-1.0))
    state.position[3, 1] = torch.nan
    with pytest.raises(ValueError, match="^position: body 3|^position_t0: body 3"):
        search(Options())


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


def spoil(comm: Comm) -> None:
    """A NaN pose on one rank: the error names it there; no rank receives such a body."""
    model = sim.Model(sim.ModelConfig(robots=60))
    half = model.half_extent
    partition = Cells.uniform(tuple(-x for x in half), half, comm.size, cells=2)
    simulation = DistributedSimulation.create(comm, model, partition, starting_share(comm, model))
    if comm.rank == comm.size - 1:
        simulation.state.position[3, 1] = torch.nan
        with pytest.raises(ValueError, match="^position: body 3|^position_t0: body 3"):
            simulation.step(0)


def test_bad_poses_are_named_on_the_rank_that_has_them(ranks: World) -> None:
    ranks.run(1, spoil)
