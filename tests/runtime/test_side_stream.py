"""Operators that take a part of a GPU's blocks: the same results, and the former part afterwards."""

from __future__ import annotations

import pytest
import torch
from support.crowds import crowds
from support.same_bits import assert_same

import pgccd
from pgccd import ops
from pgccd.runtime.side_stream import SideStream


def test_numbers_are_checked() -> None:
    assert ops.set_device_share(7) == 1
    assert ops.set_device_share(1) == 7
    for share in (0, -1, 1025):
        with pytest.raises(ValueError, match="share"):
            ops.set_device_share(share)
    assert ops.set_device_share(1) == 1


@pytest.mark.cuda
@pytest.mark.parametrize("name", ["faster than cells", "larger than subdomains", "a terrain under all"])
@pytest.mark.parametrize("broad_phase", ["sweep", "grid", "lbvh"])
@pytest.mark.parametrize("share", [4, 1024])
def test_results_do_not_depend_on_the_share(name: str, broad_phase: pgccd.broad.BroadPhase, share: int) -> None:
    given = crowds()[name]
    scene = pgccd.Scene(given.meshes, given.mesh_index, "cuda", **given.filters)
    motion = given.motion(torch.arange(len(given.position))).to("cuda")
    expected = pgccd.detect(scene, motion, "all", broad_phase=broad_phase)
    assert len(expected) > 0
    former = ops.set_device_share(share)
    try:
        found = pgccd.detect(scene, motion, "all", broad_phase=broad_phase)
    finally:
        ops.set_device_share(former)
    assert_same(found, expected)


@pytest.mark.cuda
def test_a_side_stream_takes_a_share_and_gives_it_back() -> None:
    side = SideStream(torch.device("cuda"))
    current = torch.cuda.current_stream()
    with pytest.raises(KeyError), side, side.sharing():
        assert ops.set_device_share(4) == 4
        assert torch.cuda.current_stream() != current
        raise KeyError
    assert ops.set_device_share(1) == 1
    assert torch.cuda.current_stream() == current
    side.join()


def test_without_a_second_stream_all_blocks_are_taken() -> None:
    with SideStream(torch.device("cpu")).sharing():
        assert ops.set_device_share(1) == 1
