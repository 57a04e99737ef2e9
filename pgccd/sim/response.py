"""What robots do about a collision: stop there and turn round (the simple response of Du, Liu & Suzumura 2017)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from pgccd import ops
from pgccd.sim.model import RobotState

# A robot moves this part of the way to its toi: at the toi itself it may be within the tolerance of contact, which the
# next step would report again.
_APPROACH = 0.99
# A robot that could make less than this part of its step stays where it is. Otherwise the gap between robots that are
# pressed together (by a wall, by a crowd) would shrink by the same factor in every step, until rounding closed it.
_SMALLEST_PART = 0.01
# After so many rounds whoever still collides stays where it is, which ends the matter quickly.
_ROUNDS = 4


class FindContacts(Protocol):
    """Whom robots that have just been slowed down meet."""

    def __call__(self, changed: Tensor, fraction: Tensor, any_changed: Tensor) -> tuple[Tensor, Tensor] | None:
        """The contacts, with at least one changed robot each, of the step of which each robot makes that fraction at
        constant velocities.

        Args:
            changed: (N,) bool.
            fraction: (N,) float64.
            any_changed: (1,) int64: 1 if a robot has changed on any rank, else 0. It stays on the device, to be read
                together with other numbers.

        Returns:
            pairs (K, 2) and toi (K,); None if no robot has changed on any rank.
        """
        ...


class Exchange(Protocol):
    """What `resolve_collisions` must know from others when robots are spread over ranks."""

    @property
    def rank(self) -> int: ...

    @property
    def ranks(self) -> int: ...

    @property
    def shared(self) -> Tensor:
        """(S,) int64 rows of the robots that others know too, perhaps several times."""
        ...

    def share(self, first: Tensor) -> None:
        """Sets the first toi (N,) of all robots to the smallest over all ranks that hold them."""
        ...

    def gather(self, values: Tensor) -> Tensor:
        """values (k,) -> (ranks, k): those of every rank."""
        ...


class OneRank:
    """There is one rank.

    Args:
        rows: (R,) int64 of any robots, where they are.
    """

    rank, ranks = 0, 1

    def __init__(self, rows: Tensor) -> None:
        self.shared = rows[:0]

    def share(self, first: Tensor) -> None:
        pass

    def gather(self, values: Tensor) -> Tensor:
        return values[None]


@dataclass
class Resolution:
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
    return first.scatter_reduce_(0, pairs.reshape(-1), _of_both(toi), "amin")


def resolve_collisions(
    pairs: Tensor, toi: Tensor, body_count: int, find_contacts: FindContacts, exchange: Exchange | None = None
) -> Resolution:
    """Decides how much of the step each robot makes.

    A robot stops (just before) its first toi. It then stands where others expected it to move on, so the slowed-down
    step is tested again, among the robots that have just been slowed down and between them and all others, until none
    collides. In the step that results no robot touches another, and the next one starts without contact.

    A round costs in proportion to its contacts, not to the robots.

    Args:
        pairs, toi: the contacts (K, 2) and (K,) of the whole step.
        body_count: number of robots N.
        find_contacts: the contacts of a round.
        exchange: how ranks agree; default: there is one.

    Example:
        >>> resolved = pgccd.sim.resolve_collisions(hits.pairs, hits.toi, len(state), find_contacts)
    """
    rows = pairs.reshape(-1)
    exchange = exchange or OneRank(rows)
    fraction = torch.ones(body_count, dtype=torch.float64, device=toi.device)
    first = torch.full_like(fraction, torch.inf)
    changed = torch.zeros(body_count, dtype=torch.bool, device=toi.device)
    rounds = secondary_contacts = 0
    while True:
        first.scatter_reduce_(0, rows, _of_both(toi), "amin")
        exchange.share(first)
        # A row may be named several times: what is written for it is the same each time.
        rows = torch.cat([rows, exchange.shared])
        made, changes = ops.simulate_slow_down(rows, first, fraction, *limits_of(rounds))
        fraction[rows], changed[rows] = made, changes.view(torch.bool)
        any_changed = exchange.gather(changes.any().long().reshape(1)).amax(dim=0)
        found = find_contacts(changed, fraction, any_changed)
        if found is None:
            return Resolution(fraction, rounds, secondary_contacts)
        changed.index_fill_(0, rows, False)
        first.index_fill_(0, rows, torch.inf)
        pairs, toi = found
        rows = pairs.reshape(-1)
        rounds += 1
        secondary_contacts += len(toi)


def limits_of(rounds: int) -> tuple[float, float]:
    """Part of the way to its toi that a robot moves after so many rounds, and the smallest fraction: robots below it do
    not move."""
    # Every round stops or slows a robot, and from this one on stops it at t0: the iteration terminates.
    return _APPROACH, _SMALLEST_PART if rounds < _ROUNDS else torch.inf


def _of_both(toi: Tensor) -> Tensor:
    """(2 K,): each twice."""
    return toi[:, None].expand(-1, 2).reshape(-1)


def respond(state: RobotState, fraction: Tensor) -> RobotState:
    """The state after a step of which each robot made `fraction`; those that did not make all of it turn round.

    Args:
        state: as planned, before the step.
        fraction: (N,) float64 in [0, 1].

    Example:
        >>> state = pgccd.sim.respond(state, resolved.fraction)
    """
    position, orientation, velocity, angular_velocity = ops.simulate_respond(list(state.columns.values()), fraction)
    return replace(
        state, position=position, orientation=orientation, velocity=velocity, angular_velocity=angular_velocity
    )
