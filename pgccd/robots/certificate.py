"""What `certify` found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from pgccd.contacts.rows import Form, Rows

if TYPE_CHECKING:
    from pgccd.robots.obstacles import Obstacles
    from pgccd.robots.robot import Robot


class Verdict(IntEnum):
    """What is known of a path.

    Attributes:
        FREE: certainly free of contact, between waypoints too.
        COLLISION: surfaces touch in a configuration of the path.
        NEAR: a pair comes within the resolution (or as near as rounding can tell); no configuration was found in which
            surfaces touch.
        START: a pair touches at the first waypoint.
        INVALID: the value of a joint is not finite or larger than 1e6, a link turns by more than 1e4 radians between
            two waypoints (all joints added), the pose of an obstacle is invalid, or the robot may leave the square in
            place of an infinite plane of its file.
        UNDECIDED: the search was given up: the budget of a `MotionValidator` was spent, or, on a GPU, the memory of a
            search did not suffice.
    """

    FREE = 0
    COLLISION = 1
    NEAR = 2
    START = 3
    INVALID = 4
    UNDECIDED = 5


@dataclass(eq=False, kw_only=True, repr=False)
class Certificate(Rows):
    """Results of B environments, independent of one another.

    Attributes:
        verdict: (B,) int8, see `Verdict`.
        time: (B,) float64 in [0, 1]: the path is certainly free of contact before this part of its segments; inf if it
            is free, 0 for `START`, `INVALID` and `UNDECIDED`. Never later than the first contact.
        segment: (B,) int64: the segment of `time`, from waypoint `segment` to the next; -1 if free, invalid or
            undecided.
        toi: (B,) float64 in [0, 1], within the segment; inf if free.
        links: (B, 2) int64: what meets there: a link, or -1 - k for obstacle k; the number of links if nothing meets.
        point: (B, 3) float64, world frame: where they meet; nan if nothing meets.
        link_names: names of the robot's links.
        obstacle_names: names of the obstacles.
        untested: `Robot.untested`: pairs of links, and of links and obstacles, that were not tested. The `repr` counts
            those with the reason "sampled", since they may touch in other configurations.
        steps: number of parts of segments over which pairs of bodies were tested, summed over all pairs.

    Example:
        >>> result = robot.certify(torch.zeros(1, 2, robot.joint_count))
        >>> result.free, result.time
        (tensor([True]), tensor([inf], dtype=torch.float64))
    """

    verdict: Tensor
    time: Tensor
    segment: Tensor
    toi: Tensor
    links: Tensor
    point: Tensor
    link_names: list[str] = field(default_factory=list)
    obstacle_names: list[str] = field(default_factory=list)
    untested: list[tuple[str, str, str]] = field(default_factory=list)
    steps: int = 0

    _names: ClassVar[tuple[str, ...]] = ("verdict", "time", "segment", "toi", "links", "point")
    _forms: ClassVar[Mapping[str, Form]] = {
        "verdict": (torch.int8, ()),
        "time": (torch.float64, ()),
        "segment": (torch.int64, ()),
        "toi": (torch.float64, ()),
        "links": (torch.int64, (2,)),
        "point": (torch.float64, (3,)),
    }

    @classmethod
    def from_state_dict(  # type: ignore[override]
        cls, state: dict[str, Any], robot: Robot, obstacles: Obstacles | None = None
    ) -> Certificate:
        """The certificates of a `state_dict`, on the device of its tensors.

        Args:
            state: from `state_dict`.
            robot: whose paths these are.
            obstacles: for their names. Default: names "obstacle 0" and so on.

        Raises:
            TypeError, ValueError: naming the entry that is missing or invalid.

        Example:
            >>> result = robot.certify(torch.zeros(1, 2, robot.joint_count))
            >>> again = pgccd.robots.Certificate.from_state_dict(result.state_dict(), robot)
        """
        return cls(**cls._columns_of(state), **names_of(robot, obstacles))

    def _followed_by(self, others: Sequence[Certificate]) -> Certificate:
        names = max((each.obstacle_names for each in (self, *others)), key=len)
        for k, each in enumerate((self, *others)):
            if each.link_names != self.link_names or each.untested != self.untested:
                raise ValueError(f"results[{k}]: is of another robot than the first one")
            if each.obstacle_names != names[: len(each.obstacle_names)]:
                raise ValueError(f"results[{k}]: is of obstacles with other names than {names}")
        steps = sum(each.steps for each in (self, *others))
        return replace(super()._followed_by(others), obstacle_names=names, steps=steps)

    @property
    def free(self) -> Tensor:
        """(B,) bool: whether the whole path is certainly free of contact."""
        return self.verdict == int(Verdict.FREE)

    def names(self, environment: int) -> tuple[str, ...]:
        """The names of the two that meet in an environment; empty if nothing does.

        Args:
            environment: from 0 to B - 1.

        Raises:
            IndexError: there is no such environment.

        Example:
            >>> robot.certify(torch.zeros(1, 2, robot.joint_count)).names(0)
            ()
        """
        return names_in(self.links[environment], self.link_names, self.obstacle_names)

    def __repr__(self) -> str:
        counts = [f"{v.name.lower()}={n}" for v in Verdict if (n := int((self.verdict == int(v)).sum()))]
        if sampled := sum(why.startswith("sampled") for _, _, why in self.untested):
            counts.append(f"untested_sampled={sampled}")
        return f"Certificate({', '.join([f'environments={len(self)}', *counts])})"


def links_of(pairs: Tensor, robot: Robot) -> Tensor:
    """(B, 2) int64 for pairs of bodies (B, 2): a link, or -1 - k for obstacle k; the number of links for body -1, which
    is none.
    """
    own, link = robot.body_count, robot.body_link.to(pairs.device)
    links = torch.where(pairs < own, link[pairs.clamp(0, own - 1).long()], own - 1 - pairs)
    return torch.where(pairs < 0, len(robot.link_names), links)


def names_in(links: Tensor, link_names: Sequence[str], obstacle_names: Sequence[str]) -> tuple[str, ...]:
    """The names of two links or obstacles (2,), numbered as in results; empty if there are none."""
    numbers = links.tolist()
    if numbers[0] == len(link_names):
        return ()
    obstacles = {-1 - k: name for k, name in enumerate(obstacle_names)}
    return tuple(link_names[k] if k >= 0 else obstacles.get(k, f"obstacle {-1 - k}") for k in numbers)


def names_of(robot: Robot, obstacles: Obstacles | None) -> dict[str, Any]:
    """What a certificate says of the names of links and obstacles."""
    names = [] if obstacles is None else obstacles.names
    return {"link_names": robot.link_names, "obstacle_names": names, "untested": robot.untested}
