"""Hashes: dependence on the data only, not on order."""

from __future__ import annotations

import torch

from pgccd.runtime.hashing import row_hash
from pgccd.sim import Model, ModelConfig, contacts_hash, state_hash
from pgccd.sim.model import RobotState
from pgccd.sim.tally import count_step

PAIRS = torch.tensor([[0, 5], [1, 2**40], [3, 4]])
TOI = torch.tensor([0.5, 0.25, 1.0], dtype=torch.float64)


def splitmix(x: int) -> int:
    """SplitMix64 in Python's integers."""
    x = (x + 0x9E3779B97F4A7C15) % 2**64
    x = (x ^ x >> 30) * 0xBF58476D1CE4E5B9 % 2**64
    x = (x ^ x >> 27) * 0x94D049BB133111EB % 2**64
    return x ^ x >> 31


def test_is_the_sum_of_mixed_rows() -> None:
    total = 0
    for (i, j), bits in zip(PAIRS.tolist(), TOI.view(torch.int64).tolist(), strict=True):
        total += splitmix(splitmix(splitmix(i) ^ j) ^ bits)
    assert contacts_hash(PAIRS, TOI) == total % 2**64
    assert splitmix(0) == 0xE220A8397B1DCDAF  # the published first output for seed 0


def test_does_not_depend_on_any_order_and_adds_up() -> None:
    whole = contacts_hash(PAIRS, TOI)
    order = torch.tensor([2, 0, 1])
    assert contacts_hash(PAIRS[order], TOI[order]) == whole
    assert contacts_hash(PAIRS.flip(1), TOI) == whole
    assert (contacts_hash(PAIRS[:1], TOI[:1]) + contacts_hash(PAIRS[1:], TOI[1:])) % 2**64 == whole
    assert contacts_hash(PAIRS[:0], TOI[:0]) == 0


def test_sees_every_bit_and_every_pairing() -> None:
    whole = contacts_hash(PAIRS, TOI)
    for row in range(3):
        nudged = TOI.clone()
        nudged[row] = torch.nextafter(nudged[row], torch.tensor(2.0, dtype=torch.float64))
        assert contacts_hash(PAIRS, nudged) != whole
    assert contacts_hash(PAIRS, TOI[[1, 0, 2]]) != whole
    assert contacts_hash(torch.tensor([[0, 4], [1, 2**40], [3, 5]]), TOI) != whole


def test_state_hash_sees_pose_and_velocity_but_not_order() -> None:
    state = Model(ModelConfig(robots=50)).start()
    whole = state_hash(state)
    shuffled = RobotState(**{name: column.flip(0) for name, column in state.columns.items()})
    assert state_hash(shuffled) == whole
    for name in ("id", "position", "orientation", "velocity", "angular_velocity"):
        changed = state.columns[name].clone()
        changed[7] = changed[7] + 1
        assert state_hash(RobotState(**(state.columns | {name: changed}))) != whole


def test_tally_of_a_step_is_the_sum_of_its_parts(device: torch.device) -> None:
    model = Model(ModelConfig(robots=1000, seed=5))
    state = model.start()
    generator = torch.Generator().manual_seed(2)
    fraction = torch.rand(1000, dtype=torch.float64, generator=generator).mul_(3.0).clamp_(max=1.0)
    id = torch.randperm(5000, generator=generator) + 2**40
    pairs = torch.randint(5000, (300, 2), generator=generator)
    toi = torch.rand(300, dtype=torch.float64, generator=generator)
    toi[::7] = 0.0
    padded = torch.cat([pairs, torch.full((50, 2), -1)]), torch.cat([toi, torch.full((50,), torch.inf).double()])
    hashes = contacts_hash(id[pairs], toi), state_hash(state), row_hash([state.id])
    stopped, touching = int((fraction < 1.0).sum()), int((toi == 0.0).sum())
    assert 0 < stopped < 1000 and touching > 0
    for rows, times in ((pairs, toi), padded):
        columns = RobotState(**{name: column.to(device) for name, column in state.columns.items()})
        tally = count_step(columns, fraction.to(device), id.to(device), rows.to(device), times.to(device)).tolist()
        assert tally[0] == 1000 and tally[3:5] == [stopped, touching]
        assert tuple(number % 2**64 for number in (tally[1], tally[2], tally[5])) == hashes
