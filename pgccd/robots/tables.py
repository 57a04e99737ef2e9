"""Robots and their obstacles as the operators read them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pgccd import ops
from pgccd.geometry.scene import Scene
from pgccd.motion.differentiable import any_differentiated, with_gradient_of
from pgccd.robots.kinematics import Tree

#: The largest value of a joint with poses, radians or length units.
LARGEST_VALUE = 1e6
#: Radians that a link may turn between two waypoints, the turns of all joints added.
LONGEST_TURN = 1e4
#: The bound of how far links stray from arcs holds for links that turn by at most this many radians, added in the same
#: way: see docs/explanation/exactness.md, section 14.
MOST_TURN = 1.0
_KINDS = {"fixed": 0, "revolute": 1, "prismatic": 2}
# Rounding of a sum of turns.
_ROUNDING = 1.0 + 2.0**-40


class ArmTables:
    """A tree of joints with bodies on its frames.

    Args:
        tree: the joints.
        frames: (N) the frame of each body.
        reaches: (N) how far points of a body are from the origin of its frame, at most.
    """

    def __init__(self, tree: Tree, frames: Sequence[int], reaches: Sequence[float]) -> None:
        self._tree, self._frames = tree, list(frames)
        self.chains = [tree.chains[frame] for frame in frames]
        joints = [(joint.parent, _KINDS[joint.kind], joint.coordinate) for joint in tree.joints]
        places = [
            [*joint.position, *joint.orientation, *joint.axis, joint.scale, joint.offset, distance]
            for joint, distance in zip(tree.joints, tree.distances, strict=True)
        ]
        begin = [0]
        for chain in self.chains:
            begin.append(begin[-1] + len(chain))
        tensors = [
            torch.tensor(joints, dtype=torch.int32),
            torch.tensor(places, dtype=torch.float64),
            torch.tensor(tree.crossing, dtype=torch.float64),
            torch.tensor(begin, dtype=torch.int32),
            torch.tensor(sum(self.chains, []), dtype=torch.int32),
            torch.tensor(reaches, dtype=torch.float64),
        ]
        self._on = {tensors[0].device: tensors}

    def on(self, device: torch.device) -> list[Tensor]:
        """The operators' argument `arm`, on a device."""
        if device not in self._on:
            self._on[device] = [tensor.to(device) for tensor in self._on[torch.device("cpu")]]
        return self._on[device]

    def poses(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """World poses (K, N, 3) and (K, N, 4) of the bodies in configurations (K, J), with gradients of q."""
        found = ops.arm_poses(self.on(q.device), q.detach())
        if not any_differentiated(q):
            return found
        expressions = self._tree.expressions(q)
        position, orientation = (
            with_gradient_of(value, torch.stack([expressions[frame][k] for frame in self._frames], dim=1), name)
            for k, (value, name) in enumerate(zip(found, ("position", "orientation"), strict=True))
        )
        return position, orientation

    def turns(self, step: Tensor) -> Tensor:
        """(K,): the most that bodies turn in steps (K, J), all joints added, rounded up; on a CPU."""
        steps = step.cpu()
        joints = self._tree.joints
        most = steps.new_zeros(len(steps))
        for chain in self.chains:
            turn = steps.new_zeros(len(steps))
            for joint in (joints[k] for k in chain if joints[k].kind == "revolute"):
                turn = turn + (steps[:, joint.coordinate] * joint.scale).abs()
            most = torch.maximum(most, turn)
        return most * _ROUNDING

    def shared(self, i: int, j: int) -> int:
        """The number of frames with which the chains of two bodies begin."""
        return sum(one == other for one, other in zip(self.chains[i], self.chains[j], strict=False))


def scene_tables(scene: Scene, tables: ArmTables) -> list[Tensor]:
    """The operators' argument `bodies` of a robot's bodies in a scene, followed by its obstacles: with the pairs that
    the scene's filters let pass.
    """
    count, bodies = scene.body_count, len(tables.chains)
    may_meet = torch.ones((bodies, count), dtype=torch.bool).triu(1)
    if scene.exclude is not None:
        may_meet[tuple(scene.exclude.T)] = False
    if scene.static is not None:
        is_static = scene.static.bool()
        may_meet &= ~(is_static[:bodies, None] & is_static)
    pairs = torch.nonzero(may_meet)
    shared = torch.zeros(len(pairs), dtype=torch.int64)
    of_robot = torch.nonzero(pairs[:, 1] < bodies).flatten()
    shared[of_robot] = torch.tensor([tables.shared(i, j) for i, j in pairs[of_robot].tolist()], dtype=torch.int64)
    thickness = scene._thickness
    return [
        scene.mesh_index.to(torch.int32),
        scene.radius,
        torch.zeros(count, dtype=torch.float64) if thickness is None else thickness.contiguous(),
        torch.cat([pairs, shared[:, None]], dim=1).to(torch.int32),
    ]
