"""Attempts in growing sizes."""

from __future__ import annotations

import pytest

from pgccd.runtime.attempts import TooSmall, until_it_fits


def test_an_attempt_is_repeated_in_the_sizes_that_it_asks_for() -> None:
    sizes: list[int] = []

    def attempt(size: int) -> str | TooSmall[int] | None:
        sizes.append(size)
        return "found" if size > 20 else TooSmall(3 * size)

    assert until_it_fits(attempt, 2) == "found" and sizes == [2, 6, 18, 54]
    assert until_it_fits(attempt, 54) == "found" and sizes[4:] == [54]


def test_an_attempt_may_give_up() -> None:
    assert until_it_fits(lambda size: None if size > 3 else TooSmall(size + 1), 0) is None
    with pytest.raises(MemoryError):
        until_it_fits(lambda size: _fail(), 1)


def _fail() -> int:
    raise MemoryError
