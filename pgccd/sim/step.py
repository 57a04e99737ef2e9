"""One step of the model, run eagerly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from torch import Tensor

from pgccd.contacts.contacts import Contacts
from pgccd.distributed.detection.share import Share
from pgccd.resolution.rounds import Fractions
from pgccd.sim.model import RobotState


@dataclass
class Step:
    """A step run eagerly. Expensive results are computed on access.

    Attributes:
        index: of the step, from 0.
        before: the robots as planned: poses at t0, velocities of the step. On several ranks this rank's own robots.
        resolution: the part of the step that each robot moves; on several ranks also those of ghosts, which follow.
        after: the robots after the step, before they migrate.
        find: computes `contacts`.
        make_record: computes `record`.
        stop_requested: whether the run was asked to stop, on any rank.
        share: this rank's pairs and contacts; None of a step gathered from several ranks.
    """

    index: int
    before: RobotState
    resolution: Fractions
    after: RobotState
    find: Callable[[], Contacts]
    make_record: Callable[[], dict[str, Any]]
    stop_requested: bool = False
    share: Share | None = None

    @cached_property
    def contacts(self) -> Contacts:
        """Contacts of the whole step, as if no robot had stopped. Pairs are rows of `before`; on several ranks of the
        bodies that `share` holds.
        """
        return self.find()

    @property
    def toi(self) -> Tensor:
        """(K,) float64 toi of `contacts`."""
        return self.contacts.toi

    @cached_property
    def record(self) -> dict[str, Any]:
        """Its line in steps.jsonl; of all ranks, and equal on all of them except for times."""
        return self.make_record()
