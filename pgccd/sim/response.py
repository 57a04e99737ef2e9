"""What robots do about a collision: stop there and turn round (the simple response of Du, Liu & Suzumura 2017)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from pgccd import ops
from pgccd.sim.world import RobotState

# A robot makes this much of the way to its toi: at the toi itself it may be within the tolerance of contact, and
# would be told so again.
_APPROACH = 0.99
# A robot that could make less than this part of its step stays where it is. Otherwise the gap between robots that are
# pressed together (by a wall, by a crowd) would shrink by the same factor in every step, until rounding closed it.
_SMALLEST_PART = 0.01
# After so many rounds whoever still collides stays where it is, which ends the matter quickly.
_ROUNDS = 4

FindContacts = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


class Exchange(Protocol):
    """What `settle` must know from others when robots are spread over ranks."""

    def first_toi(self, toi: Tensor) -> Tensor:
        """The smallest toi (N,) of each robot here over all ranks that hold it."""
        ...

    def any(self, flag: bool) -> bool:
        """True if it is on any rank."""
        ...


class _Alone:
    def first_toi(self, toi: Tensor) -> Tensor:
        return toi

    def any(self, flag: bool) -> bool:
        return flag


@dataclass
class Settlement:
    """How much of the step each robot makes, so that none collides."""

    fraction: Tensor  #: (N,) float64 in [0, 1]; below 1 for those that collide
    rounds: int  #: detections after the first
    secondary_contacts: int  #: contacts they found: with robots that had stopped in the way

    @property
    def stopped(self) -> Tensor:
        """(N,) bool."""
        return self.fraction < 1.0


def first_collisions(pairs: Tensor, toi: Tensor, body_count: int) -> Tensor:
    """The first toi of each body.

    Args:
        pairs: (K, 2) int64 body rows.
        toi: (K,) float64 in [0, 1].
        body_count: number of bodies N.

    Returns:
        (N,) float64; inf for bodies that do not collide.

    Example:
        >>> toi = pgccd.sim.first_collisions(hits.pairs, hits.toi, scene.body_count)
    """
    first = torch.full((body_count,), torch.inf, dtype=torch.float64, device=toi.device)
    return first.scatter_reduce_(0, pairs.reshape(-1), toi.repeat_interleave(2), "amin")


def settle(
    pairs: Tensor, toi: Tensor, body_count: int, find_contacts: FindContacts, exchange: Exchange | None = None
) -> Settlement:
    """Decides how much of the step each robot makes.

    A robot stops (just before) its first toi. It then stands where others expected it to move on, so the slowed-down
    step is tested again, among the robots that have just been slowed down and between them and all others, until nobody
    collides. In the step that results no robot touches another, and the next one starts without contact.

    Args:
        pairs, toi: the contacts (K, 2) and (K,) of the whole step.
        body_count: number of robots N.
        find_contacts: takes (changed (N,) bool, fraction (N,)) and returns the pairs and toi of the contacts with at
            least one changed robot in the step of which each robot makes that fraction, at constant velocities.
        exchange: how ranks agree; default: there is one.

    Example:
        >>> settled = pgccd.sim.settle(hits.pairs, hits.toi, len(state), find_contacts)
    """
    exchange = exchange or _Alone()
    fraction = torch.ones(body_count, dtype=torch.float64, device=toi.device)
    rounds = secondary_contacts = 0
    while True:
        first = exchange.first_toi(first_collisions(pairs, toi, body_count))
        # Robots that do not move at all can only touch where they did before: nothing is left to decide about them. So
        # every round stops or slows somebody, and from round _ROUNDS on stops for good: the loop ends.
        changed = (first <= 1.0) & (fraction > 0.0)
        if not exchange.any(bool(changed.any())):
            return Settlement(fraction, rounds, secondary_contacts)
        allowed = fraction * first * _APPROACH
        stays = allowed < _SMALLEST_PART if rounds < _ROUNDS else torch.ones_like(changed)
        fraction = torch.where(changed, torch.where(stays, 0.0, allowed), fraction)
        pairs, toi = find_contacts(changed, fraction)
        rounds += 1
        secondary_contacts += len(toi)


def respond(state: RobotState, fraction: Tensor) -> RobotState:
    """The state after a step of which each robot made `fraction`; those that did not make all of it turn round.

    Args:
        state: as planned, before the step.
        fraction: (N,) float64 in [0, 1].

    Example:
        >>> state = pgccd.sim.respond(state, settled.fraction)
    """
    position, orientation, velocity, angular_velocity = ops.simulate_respond(list(state.columns.values()), fraction)
    return replace(
        state, position=position, orientation=orientation, velocity=velocity, angular_velocity=angular_velocity
    )
