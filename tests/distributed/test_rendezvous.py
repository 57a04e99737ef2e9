"""Ranks of one start find one another in a store where others have left their traces."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch.distributed as dist

from pgccd.distributed.launch import rendezvous
from pgccd.distributed.launch.placement import Placement
from pgccd.distributed.launch.rendezvous import agree_on_start, first_host

SIZE = 4


def start(store: dist.Store, restarts: list[int], timeout: float = 20.0) -> list[tuple[dist.Store, bool]]:
    """As processes would, each started with another count of restarts."""
    places = [Placement("torchrun", rank, SIZE, 0, count) for rank, count in enumerate(restarts)]
    with ThreadPoolExecutor(SIZE) as threads:
        return list(threads.map(lambda place: agree_on_start(store, place, timeout), places))


def test_each_start_has_a_part_of_the_store_to_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    store, seen = dist.HashStore(), set()
    for index, restarts in enumerate([[0] * SIZE, [0, 1, 0, 1], [1, 0, 0, 0], [1, 1, 1, 1], [1, 1, 1, 1]]):
        if index < 4:  # the last time the same process connects again
            monkeypatch.setattr(rendezvous, "_THIS_PROCESS", f"process {index}")
        found = start(store, restarts)
        # Whatever the agents count, rank 0 knows whether it was the first.
        assert found[0][1] == (index > 0)
        assert [again for _, again in found[1:]] == [count > 0 for count in restarts[1:]]
        found[1][0].set("name", f"of start {index}")
        names = {part.get("name").decode() for part, _ in found}
        assert names == {f"of start {index}"}
        seen |= names
    assert len(seen) == 5


def test_a_process_that_connects_again_takes_no_others_place() -> None:
    store = dist.HashStore()
    assert [[again for _, again in start(store, [0] * SIZE)] for _ in range(2)] == [[False] * SIZE] * 2


def test_ranks_that_do_not_come_are_named() -> None:
    store = dist.HashStore()
    start(store, [0] * SIZE)
    # They were there once; now rank 0 is alone.
    with pytest.raises(RuntimeError, match=r"^ranks \[1, 2, 3\] of 4 did not come within 0.3 s$"):
        agree_on_start(store, Placement("torchrun", 0, SIZE, 0), 0.3)
    store.set_timeout(rendezvous.timedelta(seconds=0.3))
    with pytest.raises(RuntimeError, match="^rank 0 did not come within 0.3 s"):
        agree_on_start(store, Placement("torchrun", 2, SIZE, 0), 0.3)


@pytest.mark.parametrize(
    ("nodes", "first"),
    [("gpu[007-012,020],login1", "gpu007"), ("node3", "node3"), ("a1,b2", "a1"), ("n-1-[2,4]", "n-1-2")],
)
def test_first_host_of_slurm_s_short_form(nodes: str, first: str) -> None:
    assert first_host(nodes) == first
