"""Fixtures of the tests on several ranks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from support.ranks import RankPool

World = Callable[..., list[Any]]


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


@pytest.fixture(params=[1, pytest.param(2, marks=pytest.mark.slow), 3, 4])
def world(request: pytest.FixtureRequest, ranks: RankPool) -> World:
    """Runs world(job, *arguments) on 1, 3 and 4 ranks in turn, on 2 too with `-m slow`; returns the ranks' results."""
    return lambda job, *arguments: ranks.run(request.param, job, *arguments)
