"""Kinematic trees: poses of the frames of a robot from its joint values, for many configurations at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from pgccd.motion import differentiable
from pgccd.motion.differentiable import any_differentiated, with_gradient_of
from pgccd.motion.rotation import rotated

JointKind = Literal["fixed", "revolute", "prismatic"]
# Of K configurations, (K,), or of all of them a number. One arithmetic for all of these has one result.
Component: TypeAlias = Tensor | np.ndarray | float
Components: TypeAlias = tuple[Any, ...]
# So many configurations are faster in NumPy.
_FEW = 64


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
class Poses:
    """Poses of all frames in K configurations.

    Attributes:
        position, orientation: (F, K, 3) and (F, K, 4).
        value: (F, K) of the joints, radians or length units; zero for fixed ones.
    """

    position: Tensor
    orientation: Tensor
    value: Tensor

    def split(self, count: int) -> tuple[Poses, Poses]:
        """Those of the first configurations, and of the others."""
        first, second = (
            Poses(*(column[:, rows] for column in vars(self).values())) for rows in (slice(count), slice(count, None))
        )
        return first, second


@dataclass(frozen=True)
class Tree:
    """Joints in an order in which parents come first; the first one is fixed, and places the base in the world.

    Attributes:
        joints: the joints.
    """

    joints: Sequence[Joint]

    def forward(self, q: Tensor) -> Poses:
        """Poses of all frames. Only operations that round alike on every device.

        Args:
            q: (K, J) float64 configurations; with gradients, if they require grad.
        """
        if q.device.type == "cpu" and len(q) <= _FEW and not any_differentiated(q):
            return self._forward_of_few(q)
        count = len(q)
        position, orientation, value = self._components(q.unbind(1), _integrated)

        def stacked(rows: Sequence[Components]) -> Tensor:
            return torch.stack([_joined(row, count, q) for row in rows])

        return Poses(stacked(position), stacked(orientation), stacked([(own,) for own in value])[..., 0])

    def _forward_of_few(self, q: Tensor) -> Poses:
        """As `forward`, in NumPy, whose calls are shorter: with few configurations they are all the time."""
        count, frames = len(q), len(self.joints)
        position, orientation = np.empty((frames, 3, count)), np.empty((frames, 4, count))
        value = np.empty((frames, count))
        # Components may be numbers, which fill their rows.
        for frame, (at, turn, own) in enumerate(zip(*self._components(q.numpy().T, _integrated_few), strict=True)):
            for row, component in zip((*position[frame], *orientation[frame]), (*at, *turn), strict=True):
                row[...] = component
            value[frame] = own
        x, r, v = (torch.from_numpy(column) for column in (position, orientation, value))
        return Poses(x.transpose(1, 2).contiguous(), r.transpose(1, 2).contiguous(), v)

    def _components(
        self, q: Sequence[Any] | np.ndarray, integrated: Callable[[Components, Components, Any], Components]
    ) -> tuple[list[Components], list[Components], list[Component]]:
        """By frame the components of its position and orientation, and the value of its joint.

        Args:
            q: (K,) of each joint.
            integrated: orientation after a rotation vector; also given an entry of q.
        """
        position: list[Components] = []
        orientation: list[Components] = []
        value: list[Component] = []
        for joint, (at, turn, axis) in zip(self.joints, self._constants, strict=True):
            if joint.parent >= 0:
                of_parent = orientation[joint.parent]
                offset = _rotate(of_parent, at)
                at = tuple(x + dx for x, dx in zip(position[joint.parent], offset, strict=True))
                turn = _multiply(of_parent, turn)
            own: Component = 0.0
            if joint.kind != "fixed":
                own = q[joint.coordinate] * joint.scale + joint.offset
                along = tuple(own * component for component in _rotate(turn, axis))
                if joint.kind == "revolute":
                    turn = integrated(turn, along, own)
                else:
                    at = tuple(x + dx for x, dx in zip(at, along, strict=True))
            position.append(at)
            orientation.append(turn)
            value.append(own)
        return position, orientation, value

    @cached_property
    def _constants(self) -> list[tuple[Components, Components, Components]]:
        """Position, orientation and axis of each joint."""
        return [
            tuple(tuple(map(float, of)) for of in (joint.position, joint.orientation, joint.axis))  # type: ignore[misc]
            for joint in self.joints
        ]

    @cached_property
    def distances(self) -> list[float]:
        """Of each frame from its parent at value 0, rounded up."""
        return [float(np.linalg.norm(joint.position)) * (1.0 + 2.0**-50) for joint in self.joints]

    @cached_property
    def chains(self) -> list[list[int]]:
        """By frame the joints from the base to it, its own included."""
        chains: list[list[int]] = []
        for index, joint in enumerate(self.joints):
            chains.append([*(chains[joint.parent] if joint.parent >= 0 else []), index])
        return chains

    @cached_property
    def crossing(self) -> np.ndarray:
        """(joints, joints): an upper bound, in any configuration, of the sine of the angle between the axes of two
        revolute joints of a chain. Joints that follow one another, such as the parallel ones of a shoulder and an
        elbow, have a fixed angle, since one turns about its own axis; angles of others are at most the sums of these.
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


def _joined(components: Components, count: int, like: Tensor) -> Tensor:
    """(K, n), of tensors (K,) or numbers."""
    columns = [c if isinstance(c, Tensor) else like.new_full((count,), c) for c in components]
    return torch.stack(columns, dim=1)


def _integrated(turn: Components, rotation: Components, like: Tensor) -> Components:
    """As `integrate_orientation`, with gradients."""
    orientation, vector = _joined(turn, len(like), like), _joined(rotation, len(like), like)
    if not any_differentiated(orientation, vector):
        return rotated(orientation, vector).unbind(1)
    value = rotated(orientation.detach(), vector.detach())
    unit = orientation / orientation.norm(dim=-1, keepdim=True)
    expression = differentiable.product(differentiable.quaternion_of(vector), unit)
    return with_gradient_of(value, expression, "orientation").unbind(1)


def _integrated_few(turn: Components, rotation: Components, like: np.ndarray) -> Components:
    """As `_integrated`, of arrays (K,) and without gradients."""
    columns = np.empty((7, len(like)))
    for row, component in zip(columns, (*turn, *rotation), strict=True):
        row[...] = component
    both = torch.from_numpy(columns)
    return tuple(rotated(both[:4].T, both[4:].T).numpy().T)


def _rotate(q: Components, v: Components) -> Components:
    """A vector rotated by a unit quaternion."""
    w, x, y, z = q
    a, b, c = v
    # Twice the cross product of the vector part and v.
    d, e, f = (2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a))
    return a + w * d + (y * f - z * e), b + w * e + (z * d - x * f), c + w * f + (x * e - y * d)


def _multiply(p: Components, q: Components) -> Components:
    """The product of two quaternions: first q, then p."""
    a, b, c, d = p
    w, x, y, z = q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def multiply(p: Tensor, q: Tensor) -> Tensor:
    """Products of quaternions (K, 4): first q, then p."""
    return torch.stack(_multiply(p.unbind(1), q.unbind(1)), dim=1)


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
