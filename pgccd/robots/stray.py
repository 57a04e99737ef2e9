"""How far links stray from arcs while joints move at constant rates: see docs/explanation/exactness.md, section 14."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pgccd.motion.vectors import norm
from pgccd.robots.kinematics import Poses, Tree

#: The bound holds for links that turn by at most so many radians in a step, the turns of all joints added.
MOST_TURN = 1.0
# Radians that a link may turn between two waypoints, the turns of all joints added: a segment is first split into about
# as many parts.
LONGEST_TURN = 1e4
# Of the rate and the angle, in units of the change of the rate: see the proof.
_RATE = 0.7625
_ANGLE = 0.25625
# Rounding of the sums and products of a bound.
_ROUNDING = 1.0 + 2.0**-40
# Error of a computed pose, in units of the length of the chain and for each joint and radian.
_POSE_ERROR = 2.0**-46


@dataclass(frozen=True)
class _Places:
    """The n-th joints of the chains of M frames, for n up to the length P of the longest: tables (P, M) of rows by
    joint, of which the last, F, is zero and stands for none.

    Attributes:
        revolute, prismatic: the joint if it is of this kind, else F.
        has_revolute, has_prismatic: (P) whether any is.
        frame: of the joint; of the chain's own where there is none.
        parent: the frame before it, F for none.
        distance: (P, M, 1) from the parent at value 0; 0 for none.
        present: (P, M, 1) 1, or 0 for none.
    """

    revolute: Tensor
    prismatic: Tensor
    has_revolute: list[bool]
    has_prismatic: list[bool]
    frame: Tensor
    parent: Tensor
    distance: Tensor
    present: Tensor

    @classmethod
    def of(cls, tree: Tree, chains: Sequence[Sequence[int]], device: torch.device) -> _Places:
        """Those of chains, each in its own order."""
        none, longest = len(tree.joints), max(map(len, chains))

        def table(entry: Callable[[int], float], missing: Sequence[float], dtype: torch.dtype = torch.int64) -> Tensor:
            rows = [
                [entry(chain[n]) if n < len(chain) else other for chain, other in zip(chains, missing, strict=True)]
                for n in range(longest)
            ]
            return torch.tensor(rows, dtype=dtype, device=device)

        def of_kind(kind: str) -> Tensor:
            return table(lambda k: k if tree.joints[k].kind == kind else none, [none] * len(chains))

        revolute, prismatic = of_kind("revolute"), of_kind("prismatic")
        return cls(
            revolute=revolute,
            prismatic=prismatic,
            has_revolute=(revolute < none).any(dim=1).tolist(),
            has_prismatic=(prismatic < none).any(dim=1).tolist(),
            frame=table(lambda k: k, [max(chain) for chain in chains]),
            parent=table(lambda k: tree.joints[k].parent % (none + 1), [none] * len(chains)),
            distance=table(lambda k: tree.distances[k], [0.0] * len(chains), torch.float64)[..., None],
            present=table(lambda k: 1.0, [0.0] * len(chains), torch.float64)[..., None],
        )


class Chains:
    """The joints that move bodies, as tables for all bodies at once.

    Args:
        tree: the joints.
        frames: (N) the frame of each body.
        reach: (N) how far its points are from the origin of the frame.
        device: of the tables.
    """

    def __init__(self, tree: Tree, frames: Sequence[int], reach: Sequence[float], device: torch.device) -> None:
        self.frames = torch.tensor(frames, device=device)
        self.reach = torch.tensor(reach, dtype=torch.float64, device=device)[:, None]
        forth = [tree.chains[frame] for frame in frames]
        #: From the base to the bodies and back, and to all frames.
        self.forth = _Places.of(tree, forth, device)
        self.back = _Places.of(tree, [chain[::-1] for chain in forth], device)
        self.of_frames = _Places.of(tree, tree.chains, device)
        none = len(tree.joints)
        #: (P, F, 1): the bound of the sine of the angle between the axes of a frame's own joint and of one before it.
        crossing = torch.tensor(tree.crossing, device=device)
        own = torch.arange(none, device=device)
        self.crossing = torch.where(self.of_frames.frame == own, 0.0, crossing[self.of_frames.frame, own])[..., None]
        #: By joint, and for none, the entry of a configuration, which has a zero at its end, and scale and offset.
        self.coordinate = torch.tensor([*(joint.coordinate for joint in tree.joints), -1], device=device)
        linear = [(joint.scale, joint.offset) if joint.kind != "fixed" else (0.0, 0.0) for joint in tree.joints]
        both = torch.tensor([*linear, (0.0, 0.0)], dtype=torch.float64, device=device)
        self.scale, self.offset = both[..., None].unbind(1)

    def of_joints(self, q: Tensor) -> Tensor:
        """(F + 1, K): entries of configurations (K, J) by joint, zero for fixed ones."""
        return torch.nn.functional.pad(q, (0, 1)).T[self.coordinate]


def stray_bound(chains: Chains, start: Poses, end: Poses) -> Tensor:
    """(K, N): how far a point of a body is from its place on the arc between both poses of the body, at most, at any
    equal time of a step in which all joints move at constant rates.

    Args:
        chains: of the bodies.
        start, end: K configurations at both ends of the step; links turn by at most `MOST_TURN` between them.
    """
    steps = _with_none((end.value - start.value).abs())
    turn, bend = _turns(chains, steps)
    origin = 0.125 * _acceleration(chains, steps, turn, start, end)
    s = turn[chains.frames]
    share = torch.minimum((1.0 + 2.0 * _RATE * s + _ANGLE * (s * s)) * 0.125, torch.full_like(s, _ANGLE))
    return ((origin + chains.reach * (bend[chains.frames] * share)) * _ROUNDING).T


def pose_error(chains: Chains, q: Tensor) -> Tensor:
    """(K, N): how far points of bodies are from their exact places, at most, for rounding of configurations and poses.

    Args:
        chains: of the bodies.
        q: (K, J) configurations, of which the largest magnitudes of all ends.
    """
    size = chains.of_joints(q).abs() * chains.scale.abs() + chains.offset.abs()
    places, length, joints = chains.forth, chains.reach, torch.ones_like(chains.reach)
    turns, slides = size[places.revolute], size[places.prismatic]
    for n in range(len(places.distance)):
        length, joints = length + places.distance[n], joints + places.present[n]
        if places.has_revolute[n]:
            joints = joints + turns[n]
        if places.has_prismatic[n]:
            length = length + slides[n]
    return (_POSE_ERROR * (joints * length)).expand(-1, len(q)).T


def turns(chains: Chains, step: Tensor) -> Tensor:
    """(K,): by how much bodies turn at most, the turns of all joints added, rounded up.

    Args:
        chains: of the bodies.
        step: (K, J) changes of configurations.
    """
    of_joints = (chains.of_joints(step) * chains.scale).abs()
    return _sum(of_joints[chains.forth.revolute], chains.forth.has_revolute).amax(dim=0) * _ROUNDING


def _with_none(rows: Tensor) -> Tensor:
    """(F + 1, K): rows by joint, and zero for none."""
    return torch.cat([rows, torch.zeros_like(rows[:1])])


def _sum(terms: Tensor, wanted: Sequence[bool]) -> Tensor:
    """(M, K): terms (P, M, K) added one after the other, at the wanted places."""
    total = torch.zeros_like(terms[0])
    for term, is_wanted in zip(terms.unbind(0), wanted, strict=True):
        if is_wanted:
            total = total + term
    return total


def _turns(chains: Chains, steps: Tensor) -> tuple[Tensor, Tensor]:
    """(F + 1, K): by frame the turn of all its joints, and the bound of the change of its rate, sum over pairs of
    joints of |d_j| |d_k| sin(angle between their axes).
    """
    places = chains.of_frames
    of_joints = steps[places.revolute]
    crossed = _sum(of_joints * chains.crossing, places.has_revolute)
    bends = _with_none(steps[:-1] * crossed)[places.revolute]
    turn, bend = (_with_none(_sum(terms, places.has_revolute)) for terms in (of_joints, bends))
    return turn, bend


def _acceleration(chains: Chains, steps: Tensor, turn: Tensor, start: Poses, end: Poses) -> Tensor:
    """(N, K): a bound of the acceleration of the origins of the bodies' frames."""
    places = chains.back
    revolute, prismatic, before = steps[places.revolute], steps[places.prismatic], turn[places.parent]
    rate = revolute * (revolute + 2.0 * before)
    ends = _distances(start, chains) + _distances(end, chains)
    slides = any(places.has_prismatic)
    if slides:
        slide = 2.0 * (prismatic * before)
        out = _with_none(torch.maximum(start.value.abs(), end.value.abs()))[places.prismatic]
    # From the frame back to the base: length of the chain behind a joint, and speed of the frame seen from there.
    total = torch.zeros_like(revolute[0])
    length, speed = torch.zeros_like(total), torch.zeros_like(total)
    for n in range(len(revolute)):
        if places.has_prismatic[n]:
            total, speed, length = total + slide[n], speed + prismatic[n], length + out[n]
        if places.has_revolute[n]:
            # The distance from the joint changes by at most `speed`, so it is at most halfway above both ends.
            away = torch.minimum(length, 0.5 * (ends[n] + speed))
            total, speed = total + away * rate[n], speed + revolute[n] * away
        length = length + places.distance[n]
    return total


def _distances(poses: Poses, chains: Chains) -> Tensor:
    """(P, N, K): of the bodies' frames from those of their chains, back to the base."""
    return norm(poses.position[chains.back.frame] - poses.position[chains.frames])
