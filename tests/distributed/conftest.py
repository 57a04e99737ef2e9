"""Fixtures of the tests on several ranks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from support.ranks import RankPool

World = Callable[..., list[Any]]
SLOW = pytest.mark.slow
# Four ranks have the most kinds of neighbours, three an odd number of parts.
ON_FOUR = [1, pytest.param(2, marks=SLOW), pytest.param(3, marks=SLOW), 4]
ON_THREE = [1, pytest.param(2, marks=SLOW), 3, pytest.param(4, marks=SLOW)]
on_three = pytest.mark.parametrize("world", ON_THREE, indirect=True)


@pytest.hookimpl(tryfirst=True)  # before tests are selected by their marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks the tests on the pool of ranks."""
    for item in items:
        if "ranks" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.ranks)


@pytest.fixture(scope="session")
def ranks() -> Iterator[RankPool]:
    pool = RankPool()
    yield pool
    pool.close()


@pytest.fixture(params=ON_FOUR)
def world(request: pytest.FixtureRequest, ranks: RankPool) -> World:
    """Runs world(job, *arguments) on 1 and 4 ranks in turn (1 and 3 in tests marked `on_three`), with `-m slow` on the
    other numbers up to 4; returns the ranks' results.
    """
    return lambda job, *arguments: ranks.run(request.param, job, *arguments)
