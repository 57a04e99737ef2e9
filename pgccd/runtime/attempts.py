"""Attempts in growing sizes, where the size that a step needs is known only after the step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

S = TypeVar("S")
T = TypeVar("T")


@dataclass(frozen=True)
class TooSmall(Generic[S]):
    """What an attempt returns that did not fit."""

    next: S  #: size of the next attempt


def until_it_fits(attempt: Callable[[S], T | TooSmall[S]], size: S) -> T:
    """Repeats an attempt in the sizes that it asks for, until it fits.

    Args:
        attempt: given a size, returns its result, or `TooSmall` with the size to try next.
        size: of the first attempt.

    Example:
        >>> until_it_fits(lambda size: size if size >= 5 else TooSmall(2 * size), 1)
        8
    """
    while isinstance(found := attempt(size), TooSmall):
        size = found.next
    return found
