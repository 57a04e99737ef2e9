"""Kinematic trees: joints, and the frames that they move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from pgccd.motion import differentiable

JointKind = Literal["fixed", "revolute", "prismatic"]


@dataclass(frozen=True)
class Joint:
    """A joint, and the frame that it moves: its origin is at the joint, and a link is rigidly attached to it.

    Attributes:
        name: of the joint.
        kind: "fixed"; "revolute", also without limits, about `axis`; or "prismatic" along it.
        parent: the frame that it is attached to, an index of a joint before it; -1 for the first, the base.
        position, orientation: (3,) and (4,), unit quaternion (w, x, y, z): of the frame in its parent, at value 0.
        axis: (3,) unit vector in the joint's frame.
        coordinate: the entry of a configuration that it follows; -1 for fixed joints.
        scale, offset: value = scale configuration[coordinate] + offset, in radians or length units.
    """

    name: str
    kind: JointKind
    parent: int
    position: np.ndarray
    orientation: np.ndarray
    axis: np.ndarray
    coordinate: int = -1
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Tree:
    """Joints in an order in which parents come first; the first one is fixed, and places the base in the world.

    Attributes:
        joints: the joints.
    """

    joints: Sequence[Joint]

    def expressions(self, q: Tensor) -> list[tuple[Tensor, Tensor]]:
        """By frame its position (K, 3) and orientation (K, 4) in configurations (K, J), as expressions of torch, for
        gradients. The values of the operators have equal bits on every device; these do not.
        """
        found: list[tuple[Tensor, Tensor]] = []
        for joint in self.joints:
            at, turn, axis = (
                q.new_tensor(of).expand(len(q), -1) for of in (joint.position, joint.orientation, joint.axis)
            )
            if joint.kind != "fixed":
                along = (joint.scale * q[:, joint.coordinate] + joint.offset)[:, None] * axis
                if joint.kind == "revolute":
                    turn = differentiable.product(turn, differentiable.quaternion_of(along))
                else:
                    at = at + differentiable.oriented(along, turn)
            if joint.parent >= 0:
                position, orientation = found[joint.parent]
                at = position + differentiable.oriented(at, orientation)
                turn = differentiable.product(orientation, turn)
            found.append((at, turn))
        return found

    @cached_property
    def distances(self) -> list[float]:
        """Distance of each frame from its parent at value 0, rounded up."""
        return [float(np.linalg.norm(joint.position)) * (1.0 + 2.0**-50) for joint in self.joints]

    @cached_property
    def chains(self) -> list[list[int]]:
        """For each frame, the joints from the base to it, its own included."""
        chains: list[list[int]] = []
        for index, joint in enumerate(self.joints):
            chains.append([*(chains[joint.parent] if joint.parent >= 0 else []), index])
        return chains

    @cached_property
    def crossing(self) -> np.ndarray:
        """(joints, joints): an upper bound, in any configuration, of the sine of the angle between the axes of two
        revolute joints of a chain. Axes of consecutive joints, such as the parallel ones of a shoulder and an elbow,
        have a fixed angle, since a joint turns about its own axis. Angles of other axes are at most the sums of the
        angles between.
        """
        bound = np.ones((len(self.joints), len(self.joints)))
        for chain in self.chains:
            turning = [k for k in chain if self.joints[k].kind == "revolute"]
            last = turning[-1:] if turning and turning[-1] == chain[-1] else []
            for k in last:
                angle = 0.0
                for before, after in zip(turning[-2::-1], turning[:0:-1], strict=True):
                    angle += self._angle(before, after, chain)
                    bound[before, k] = bound[k, before] = 1.0 if angle >= 1.5 else min(1.0, np.sin(angle) + 1e-12)
        return bound

    def _angle(self, before: int, after: int, chain: Sequence[int]) -> float:
        """The angle in [0, pi / 2] between the lines of two revolute axes with no other revolute joint between."""
        axis = self.joints[after].axis
        for k in reversed(chain[chain.index(before) + 1 : chain.index(after) + 1]):
            axis = _rotation_matrix(self.joints[k].orientation) @ axis
        own = self.joints[before].axis
        return float(np.arctan2(np.linalg.norm(np.cross(own, axis)), abs(own @ axis)))


def multiply(p: Tensor, q: Tensor) -> Tensor:
    """Products of quaternions (K, 4): first q, then p. Bits are equal on all devices."""
    a, b, c, d = p.unbind(1)
    w, x, y, z = q.unbind(1)
    rows = (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
    return torch.stack(rows, dim=1)


def quaternion_of(matrix: np.ndarray) -> np.ndarray:
    """(4,) unit quaternion (w, x, y, z) of a rotation matrix (3, 3)."""
    # The largest of four eigenvalue-like sums is well away from zero (Shepperd 1978).
    m, trace = matrix, float(np.trace(matrix))
    sums = np.array([trace, *(2.0 * m[k, k] - trace for k in range(3))])
    largest = int(np.argmax(sums))
    if largest == 0:
        q = np.array([1.0 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    else:
        i, j, k = largest - 1, largest % 3, (largest + 1) % 3
        q = np.zeros(4)
        q[0], q[1 + i] = m[k, j] - m[j, k], 1.0 + 2.0 * m[i, i] - trace
        q[1 + j], q[1 + k] = m[j, i] + m[i, j], m[k, i] + m[i, k]
    return q / np.linalg.norm(q)


def _rotation_matrix(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def turned(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Points (n, 3) or (3,) rotated by a unit quaternion (4,)."""
    return v @ _rotation_matrix(q).T
