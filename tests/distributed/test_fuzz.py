"""A short run of the fuzzer on several ranks."""

from __future__ import annotations

from unittest import mock

import pytest
import torch
from support import ways
from support.hard_scenes import hard_scene
from support.ranks import RankPool

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_ranks_give_the_same_bits(ranks: RankPool, device: str) -> None:
    with mock.patch.object(ways, "all_ways", return_value=()):
        assert not list(map(str, ways.differences(map(hard_scene, range(40)), [device], ranks, 3)))


def test_one_bit_is_seen(ranks: RankPool) -> None:
    scene = hard_scene(37)
    whole = ways.columns_of(ways.reference(scene))
    answers = [of_scenes[0] for of_scenes in ranks.run(2, ways.on_rank, [scene.seed], "cpu")]
    own, found = max(answers, key=lambda answer: len(answer[1]["pairs"]))
    assert len(found["pairs"]) > 0 and ways.of_rank(scene, whole, own, found) is None
    found["normal"].view(torch.int64)[-1, -1] ^= 1
    assert "normal: 1 of" in str(ways.of_rank(scene, whole, own, found))
