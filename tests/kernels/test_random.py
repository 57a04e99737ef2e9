"""The counter-based generator against the published results, and its independence of other draws."""

from __future__ import annotations

import pytest
import torch

from pgccd import ops

# Random123's known-answer tests for philox4x32-10 (Salmon et al. 2011): counter words, key words, result words.
KNOWN = [
    ([0] * 4, [0] * 2, [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
    ([0xFFFFFFFF] * 4, [0xFFFFFFFF] * 2, [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]),
    (
        [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344],
        [0xA4093822, 0x299F31D0],
        [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1],
    ),
]


def signed(low: int, high: int) -> int:
    value = low | high << 32
    return value - 2**64 if value >= 2**63 else value


@pytest.mark.parametrize(("counter", "key", "result"), KNOWN)
def test_known_answers(counter: list[int], key: list[int], result: list[int]) -> None:
    drawn = ops.random_uniforms(torch.tensor([signed(*counter[:2])]), signed(*key), counter[2], counter[3])
    assert (drawn[0] * 2**32 - 0.5).tolist() == result


def test_a_robot_draws_the_same_in_any_company() -> None:
    all_ids = torch.arange(5000)
    some = torch.tensor([17, 4999, 0])
    assert torch.equal(ops.random_uniforms(all_ids, 3, 9, 1)[some], ops.random_uniforms(some, 3, 9, 1))


def test_is_uniform_and_open() -> None:
    drawn = ops.random_uniforms(torch.arange(50_000), 1, 2, 3)
    assert drawn.min() > 0.0
    assert drawn.max() < 1.0
    assert (drawn.mean(dim=0) - 0.5).abs().max() < 0.01
    assert (drawn.var(dim=0) - 1 / 12).abs().max() < 0.002
    assert len(drawn.unique()) > 0.999 * drawn.numel()


@pytest.mark.parametrize("name", ["step", "stream"])
def test_counter_words_have_32_bits(name: str) -> None:
    words = {"step": 0, "stream": 0} | {name: 2**32}
    with pytest.raises(ValueError, match=name):
        ops.random_uniforms(torch.zeros(1, dtype=torch.int64), 0, **words)
