"""Pairs of links, and of links and obstacles, that are never tested, and why."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from pgccd import arguments

#: The reason why surfaces of links i and j, of the groups that the reader gave them, are never tested, or None.
WhyUntested = Callable[[int, tuple[int, ...], int, tuple[int, ...]], str | None]


@dataclass(frozen=True)
class LeftOut:
    """Pairs that are left out in addition to those of the file.

    Attributes:
        links: the reason, by the names of two links.
        with_obstacles: (link, obstacle): names of pairs that are allowed to touch.
    """

    links: Mapping[frozenset[str], str] = field(default_factory=dict)
    with_obstacles: Sequence[tuple[str, str]] = ()

    @classmethod
    def allowed(cls, pairs: Any, link_names: Sequence[str]) -> LeftOut:
        """From the argument of `Robot.allow`: names of no link are names of obstacles.

        Raises:
            TypeError, ValueError: naming the argument.
        """
        expected = "pairs: expected pairs of names, such as [('base', 'tool')]"
        if isinstance(pairs, str) or not isinstance(pairs, Iterable):
            raise TypeError(f"{expected}, got {arguments.describe(pairs)}")
        given = list(pairs)
        links: dict[frozenset[str], str] = {}
        with_obstacles: list[tuple[str, str]] = []
        for pair in given:
            if not isinstance(pair, (tuple, list)) or [isinstance(name, str) for name in pair] != [True, True]:
                raise TypeError(f"{expected}, got {given!r}")
            link, other = pair if pair[0] in link_names else reversed(pair)
            if link not in link_names:
                raise ValueError(f"pairs: expected a name of a link, such as {link_names[0]!r}, in {pair!r}")
            if link == other:
                raise ValueError(f"pairs: expected two different names, got {pair!r}")
            if other in link_names:
                links[frozenset(pair)] = "allowed"
            else:
                with_obstacles.append((link, other))
        return cls(links, with_obstacles)

    def __add__(self, other: LeftOut) -> LeftOut:
        """Both. A pair that is in both has the reason given first."""
        obstacles = dict.fromkeys([*self.with_obstacles, *other.with_obstacles])
        return LeftOut({**other.links, **self.links}, list(obstacles))

    def without(self, link: str) -> LeftOut:
        """Without the pairs of this link."""
        links = {pair: why for pair, why in self.links.items() if link not in pair}
        return LeftOut(links, [pair for pair in self.with_obstacles if pair[0] != link])

    def check_obstacles(self, names: Sequence[str], link_names: Sequence[str]) -> None:
        """Raises ValueError if an obstacle has the name of a link, or no obstacle has a name that is allowed."""
        for name in names:
            if name in link_names:
                raise ValueError(f"obstacles: names: {name!r} is the name of a link of the robot")
        for link, name in self.with_obstacles:
            if name not in names:
                what = f"one named {name!r}, which `allow` names with {link!r}"
                raise ValueError(f"obstacles: expected {what}, got {list(names) or 'none'}")


def sorted_pairs(pairs: Iterable[tuple[int, int]]) -> Tensor:
    """(E, 2) int64."""
    return torch.tensor(sorted(pairs), dtype=torch.int64).reshape(-1, 2)
