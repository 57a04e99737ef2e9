"""Torch's arithmetic on floating-point columns is limited to operations that round alike on every device.

Correctly rounded ones do: a sum, product or quotient of tensors. Others differ between a CPU and CUDA in the last bits:
reductions (their order), transcendental functions, fused operations, and division by a Python number, which CUDA turns
into a multiplication by its reciprocal. Seen without a GPU: the operations of a call are the same on every device.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from support.arms import slider
from support.deforming import crumpled, motion_of
from support.reports import detected
from support.rollouts import tumbling
from support.shapes import approaching
from support.steps import step_of
from torch.utils._python_dispatch import TorchDispatchMode

import pgccd
import pgccd.distributed
from pgccd import robots, sim

#: Operations of torch with one correct result, or none to round.
EXACT = """
    _to_copy _unsafe_view abs add alias amax amin arange as_strided cat ceil clamp clone constant_pad_nd contiguous
    copy detach div empty empty_like empty_strided expand fill floor full full_like gather index index_put
    index_select lift_fresh masked_fill max maximum min minimum mul neg new_empty new_full new_zeros nextafter ones
    ones_like permute repeat repeat_interleave reshape rsub scalar_tensor scatter scatter_reduce select slice sort split
    split_with_sizes nan_to_num sqrt squeeze stack sub transpose unbind unsqueeze view where zero zeros zeros_like set_
"""


class RoundsAlike(TorchDispatchMode):
    """Collects operations with floating-point results that may round differently on another device."""

    def __init__(self) -> None:
        super().__init__()
        self.others: set[str] = set()
        self.seen = 0

    def __torch_dispatch__(
        self, function: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        result = function(*args, **kwargs)
        outputs = result if isinstance(result, (tuple, list)) else (result,)
        if function.namespace != "pgccd" and any(
            isinstance(output, torch.Tensor) and output.is_floating_point() for output in outputs
        ):
            self.seen += 1
            name = function.__name__.split(".")[0].removesuffix("_")
            by_number = name == "div" and not isinstance(args[1], torch.Tensor)
            if name not in EXACT.split() or by_number or kwargs.get("alpha", 1) != 1:
                self.others.add(f"{function}({', '.join(map(str, args[1:]))})")
        return result


def rigid() -> tuple[pgccd.Scene, pgccd.RigidMotion]:
    bodies = approaching(np.random.default_rng(4), (0,) * 6, (1.0,) * 6, turn=2.0)
    margin = torch.full((6,), 0.01, dtype=torch.float64)
    scene = pgccd.Scene(bodies.meshes, margin=margin, world=torch.arange(6, dtype=torch.int32) // 5)
    return scene, bodies.motion()


def along() -> tuple[pgccd.Scene, pgccd.Trajectory]:
    scene, motion = rigid()
    ends = motion.at(torch.tensor([[0.0], [0.25], [0.5], [1.0]]))
    return scene, pgccd.Trajectory(*ends)


def deforming() -> tuple[pgccd.Scene, pgccd.VertexMotion]:
    shapes, ends = crumpled(4)
    return pgccd.Scene(shapes, self_collision=True, margin=torch.full((4,), 0.01)), motion_of(*ends, device="cpu")


def every_report(case: Callable[[], tuple[pgccd.Scene, Any]]) -> None:
    scene, motion = case()
    for report in pgccd.narrow.REPORTS:
        hits = detected(scene, motion, report, 0.02, nonzero_toi=True)
        if report != "any":
            for by in ("scene", "world", "body"):
                hits.first_toi(by)
            hits.earliest()


def turning() -> None:
    scene, motion = rigid()
    rates = torch.from_numpy(np.random.default_rng(0).random((4, 6, 3)))
    start = motion.position_t0, motion.orientation_t0
    path = pgccd.Trajectory.from_velocity(*start, rates, 9.0 * rates, 0.3, margin=0.1 * rates[:, :, 0])
    pgccd.detect(scene, path)


def exits() -> None:
    for case in (rigid, deforming):
        scene, motion = case()
        assert len(pgccd.exit_distance(scene, motion, [0.3, -1.0, 0.2], min_separation=0.4)) > 0


def arms() -> None:
    robot = slider()
    obstacles = robots.Obstacles([pgccd.Mesh.box([0.2] * 3)], torch.tensor([[1.0, 0.5, 0.1]]))
    robot.certify(torch.tensor([[[0.0, 0.0], [1.5, 0.3], [0.0, 0.0]]], dtype=torch.float64), obstacles)
    robot.trajectory(torch.tensor([[0.0, 0.0], [0.5, 0.3]], dtype=torch.float64))
    curve = pgccd.Spline(torch.tensor([[0.0, 0.0], [0.5, 0.3], [0.2, 0.1], [0.1, 0.0]], dtype=torch.float64), 3)
    robot.trajectory(curve)
    robot.clearance(curve, obstacles)


def splines() -> None:
    rng = np.random.default_rng(2)
    curve = pgccd.Spline(torch.tensor(rng.normal(size=(7, 2, 3))), 3)
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(2, 4)
    pgccd.Trajectory.from_spline(curve, upright, rotation=torch.tensor(rng.normal(size=(2, 2, 3))), stray=0.1)
    pgccd.Trajectory.from_spline(curve, stray=0.1)
    curve.at(0.3)


def padded() -> None:
    scene, motion = rigid()
    needed = pgccd.detect(scene, motion, "all").stats.needed
    hits = pgccd.detect(scene, motion, "all", capacity=needed.times(2.0))
    hits.first_toi("body")
    hits.trim()


def motions() -> None:
    scene, motion = rigid()
    motion.at(0.3)
    columns = motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation
    pgccd.RigidMotion.from_velocity(*columns, dt=0.1)
    pgccd.integrate_orientation(motion.orientation_t0, motion.rotation)
    deforming()[1].at(torch.tensor([[0.25], [0.5]]))
    pgccd.MovingBodies.of(scene, motion)


def distributed() -> None:
    for case in (rigid, along):
        scene, motion = case()
        start = motion.position_t0 if isinstance(motion, pgccd.RigidMotion) else motion.position[0]
        world = pgccd.distributed.World.create(scene, start, (-4.0,) * 3, (4.0,) * 3)
        world.first_toi(world.step(motion))


def simulation() -> None:
    model = sim.Model(sim.ModelConfig(robots=60, pattern="random", spacing=2.05, speed=0.15))
    state = model.start()
    for index in range(3):
        state = step_of(model, state, index).after


CALLS = {
    "rigid": lambda: every_report(rigid),
    "deforming": lambda: every_report(deforming),
    "trajectory": lambda: every_report(along),
    "turning": turning,
    "exits": exits,
    "splines": splines,
    "arms": arms,
    "padded": padded,
    "motions": motions,
    "distributed": distributed,
    "simulation": simulation,
}


@pytest.mark.parametrize("name", CALLS)
def test_torch_rounds_alike_on_every_device(name: str) -> None:
    with RoundsAlike() as mode:
        CALLS[name]()
    assert mode.seen > 0 and not mode.others


def test_audits_round_alike_on_every_device() -> None:
    rollout = tumbling(np.random.default_rng(5), 10, 6, 3.0)
    position, orientation = torch.tensor(rollout.position), torch.tensor(rollout.orientation)
    shapes, moving = deforming()
    ends = [torch.lerp(moving.x_t0, moving.x_t1, weight) for weight in (-3.0, 4.0)]
    for scene, path in (
        (rollout.scene(), pgccd.Trajectory(position, orientation)),
        (rollout.scene(), pgccd.Trajectory(position, orientation, "linear")),
        (pgccd.Scene(shapes.meshes), pgccd.Trajectory(torch.stack(ends))),
    ):
        with RoundsAlike() as mode:
            found = pgccd.audit(scene, path)
        assert len(found.passages) > 0 and not mode.others
