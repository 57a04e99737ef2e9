"""How far links stray from arcs while joints move at constant rates: see docs/explanation/exactness.md, section 14."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pgccd.robots.kinematics import Poses, Tree

#: The bound holds for links that turn by at most so many radians in a step, the turns of all joints added.
MOST_TURN = 1.0
# Of the rate and the angle, in units of the change of the rate: see the proof.
_RATE = 0.7625
_ANGLE = 0.25625
# Rounding of the sums and products of a bound.
_ROUNDING = 1.0 + 2.0**-40
# Error of a computed pose, in units of the length of the chain and for each joint and radian.
_POSE_ERROR = 2.0**-46


def stray_bound(tree: Tree, frames: Sequence[int], reach: Sequence[float], start: Poses, end: Poses) -> Tensor:
    """(K, N): how far a point within `reach` of the origin of a frame is from its place on the arc between both poses
    of the frame, at most, at any equal time of a step in which all joints move at constant rates.

    Args:
        tree: the joints.
        frames: (N,) the frames.
        reach: (N,) lengths.
        start, end: K configurations at both ends of the step; links turn by at most `MOST_TURN` between them.
    """
    steps = list((end.value - start.value).abs())
    turn, bend = _turns(tree, steps)
    columns = []
    for frame, far in zip(frames, reach, strict=True):
        origin = _acceleration(tree, frame, steps, turn, start, end) / _scalar(8.0, steps[0])
        s = turn[frame]
        share = torch.minimum((1.0 + 2.0 * _RATE * s + _ANGLE * (s * s)) * 0.125, torch.full_like(s, _ANGLE))
        columns.append(origin + far * (bend[frame] * share))
    return torch.stack(columns, dim=1) * _ROUNDING


def pose_error(tree: Tree, frames: Sequence[int], reach: Sequence[float], q: Tensor) -> Tensor:
    """(K, N): how far points within `reach` of frames are from their exact places, at most, for rounding of
    configurations and poses.

    Args:
        tree, frames, reach: as for `stray_bound`.
        q: (K, J) configurations, of which the largest magnitudes of all ends.
    """
    columns = []
    for frame, far in zip(frames, reach, strict=True):
        length, joints = torch.full_like(q[:, 0], far), torch.full_like(q[:, 0], 1.0)
        for k in tree.chains[frame]:
            joint = tree.joints[k]
            length = length + tree.distances[k]
            joints = joints + 1.0
            if joint.kind == "fixed":
                continue
            size = q[:, joint.coordinate].abs() * abs(joint.scale) + abs(joint.offset)
            if joint.kind == "revolute":
                joints = joints + size
            else:
                length = length + size
        columns.append(_POSE_ERROR * (joints * length))
    return torch.stack(columns, dim=1)


def turns(tree: Tree, frames: Sequence[int], step: Tensor) -> Tensor:
    """(K,): by how much the links of these frames turn at most, the turns of all joints added, rounded up.

    Args:
        tree, frames: as for `stray_bound`.
        step: (K, J) changes of configurations.
    """
    most = torch.zeros_like(step[:, 0])
    for frame in frames:
        total = torch.zeros_like(most)
        for k in tree.chains[frame]:
            joint = tree.joints[k]
            if joint.kind == "revolute":
                total = total + (step[:, joint.coordinate] * joint.scale).abs()
        most = torch.maximum(most, total)
    return most * _ROUNDING


def _turns(tree: Tree, steps: Sequence[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
    """By frame the turn of all its joints, and the bound of the change of its rate, sum over pairs of joints of
    |d_j| |d_k| sin(angle between their axes).
    """
    turn: list[Tensor] = []
    bend: list[Tensor] = []
    for k, joint in enumerate(tree.joints):
        zero = torch.zeros_like(steps[k])
        own, bent = (turn[joint.parent], bend[joint.parent]) if joint.parent >= 0 else (zero, zero)
        if joint.kind == "revolute":
            crossed = zero
            for j in tree.chains[k][:-1]:
                if tree.joints[j].kind == "revolute":
                    crossed = crossed + steps[j] * float(tree.crossing[j, k])
            own, bent = own + steps[k], bent + steps[k] * crossed
        turn.append(own)
        bend.append(bent)
    return turn, bend


def _acceleration(
    tree: Tree, frame: int, steps: Sequence[Tensor], turn: Sequence[Tensor], start: Poses, end: Poses
) -> Tensor:
    """(K,): a bound of the acceleration of a frame's origin."""
    chain, total = tree.chains[frame], torch.zeros_like(steps[0])
    ends = _distances(start, frame, chain) + _distances(end, frame, chain)
    # From the frame back to the base: length of the chain behind a joint, and speed of the frame seen from there.
    length, speed = torch.zeros_like(total), torch.zeros_like(total)
    for place in range(len(chain) - 1, -1, -1):
        k = chain[place]
        joint = tree.joints[k]
        if joint.kind != "fixed":
            before = turn[joint.parent]
            if joint.kind == "prismatic":
                total = total + 2.0 * (steps[k] * before)
                speed = speed + steps[k]
                length = length + torch.maximum(start.value[k].abs(), end.value[k].abs())
            else:
                # The distance from the joint changes by at most `speed`, so it is at most halfway above both ends.
                away = torch.minimum(length, 0.5 * (ends[place] + speed))
                total = total + away * (steps[k] * (steps[k] + 2.0 * before))
                speed = speed + steps[k] * away
        length = length + tree.distances[k]
    return total


def _distances(poses: Poses, frame: int, others: Sequence[int]) -> Tensor:
    """(n, K): of a frame from n others."""
    x, y, z = (poses.position[list(others)] - poses.position[frame]).unbind(2)
    return (x * x + y * y + z * z).sqrt()


def _scalar(value: float, like: Tensor) -> Tensor:
    return torch.full((), value, dtype=torch.float64, device=like.device)
