"""Ranks of one start find each other in a store that contains keys of earlier starts."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch.distributed as dist

from pgccd.distributed.launch import rendezvous
from pgccd.distributed.launch.placement import Placement
from pgccd.distributed.launch.rendezvous import agree_on_start, first_host

SIZE = 4


def start(store: dist.Store, timeout: float = 20.0) -> list[dist.Store]:
    """As separate processes would."""
    places = [Placement("torchrun", rank, SIZE, 0) for rank in range(SIZE)]
    with ThreadPoolExecutor(SIZE) as threads:
        return list(threads.map(lambda place: agree_on_start(store, place, timeout), places))


def test_each_start_has_a_part_of_the_store_to_itself() -> None:
    store = dist.HashStore()
    for index in range(4):
        parts = start(store)
        assert not parts[0].check(["name"])
        parts[1].set("name", f"of start {index}")
        assert {part.get("name").decode() for part in parts} == {f"of start {index}"}


def test_ranks_that_do_not_come_are_named() -> None:
    store = dist.HashStore()
    start(store)
    # Keys of an earlier start exist; now rank 0 is alone.
    with pytest.raises(RuntimeError, match=r"^ranks \[1, 2, 3\] of 4 did not connect within 0.3 s$"):
        agree_on_start(store, Placement("torchrun", 0, SIZE, 0), 0.3)
    store.set_timeout(rendezvous.timedelta(seconds=0.3))
    with pytest.raises(RuntimeError, match="^rank 0 did not connect within 0.3 s"):
        agree_on_start(store, Placement("torchrun", 2, SIZE, 0), 0.3)


@pytest.mark.parametrize(
    ("nodes", "first"),
    [("gpu[007-012,020],login1", "gpu007"), ("node3", "node3"), ("a1,b2", "a1"), ("n-1-[2,4]", "n-1-2")],
)
def test_first_host_of_slurm_s_short_form(nodes: str, first: str) -> None:
    assert first_host(nodes) == first
