"""Fixtures of all tests: devices, ranks; and which tests do not run: slow ones, those of a GPU without one."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
import torch
from hypothesis import HealthCheck, settings
from support.ranks import ON_FOUR, RankPool, World

# torch's stores look up the names of the addresses that connect to them; a lost answer otherwise costs 5 s.
os.environ.setdefault("RES_OPTIONS", "timeout:1 attempts:1")

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]

# The same examples in every run, so that failures are reproducible; no deadline, since machines are shared.
settings.register_profile(
    "pgccd", deadline=None, derandomize=True, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("pgccd")


def pytest_configure(config: pytest.Config) -> None:
    """Deselects slow tests unless requested: pytest -m slow."""
    if not config.option.markexpr:
        config.option.markexpr = "not slow"
    if getattr(config.option, "dist", "no") == "load":  # with xdist
        config.option.dist = "worksteal"  # tests of a file run in one worker, as far as they can: they share fixtures
    if os.environ.get("PYTORCH_NO_CUDA_MEMORY_CACHING"):
        torch.cuda.graph = _skip_graph  # type: ignore[misc, assignment]
    # Workers share the cores.
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    torch.set_num_threads(max(1, torch.get_num_threads() // workers))


def _skip_graph(*_: object, **__: object) -> None:
    pytest.skip("a graph needs torch's memory pool")


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skips tests marked `cuda` without a GPU."""
    if item.get_closest_marker("cuda") is not None and not torch.cuda.is_available():
        pytest.skip("no CUDA device")


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> torch.device:
    """Each device in turn."""
    return torch.device(request.param)


@pytest.hookimpl(tryfirst=True)  # before tests are selected by their marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks the tests on the pool of ranks."""
    for item in items:
        if "ranks" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.ranks)


@pytest.fixture(scope="session")
def ranks() -> Iterator[RankPool]:
    """The pool of ranks of this worker."""
    pool = RankPool()
    yield pool
    pool.close()


@pytest.fixture(params=ON_FOUR)
def world(request: pytest.FixtureRequest, ranks: RankPool) -> World:
    """Runs world(job, *arguments) on 1 and 4 ranks in turn (1 and 3 in tests marked `on_three`), with `-m slow` on the
    other numbers up to 4; returns the ranks' results.
    """
    return lambda job, *arguments: ranks.run(request.param, job, *arguments)
