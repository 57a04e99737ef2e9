"""Order-independent hashes of contacts and states, so that runs can be compared by their logs alone.

Each row is mixed to 64 bits; rows are summed modulo 2^64. Integer arithmetic only: the same on every device and for any
order of rows, and the hash of a whole is the sum of the hashes of its parts (as ranks need).
"""

from __future__ import annotations

import torch
from torch import Tensor

from pgccd.sim.world import RobotState

# SplitMix64 (Steele, Lea & Flood 2014, doi:10.1145/2714064.2660195) as signed numbers, which wrap.
_INCREMENT = 0x9E3779B97F4A7C15 - 2**64
_FACTORS = (0xBF58476D1CE4E5B9 - 2**64, 0x94D049BB133111EB - 2**64)


def _shift_right(bits: Tensor, count: int) -> Tensor:
    """Logical shift; torch's own copies the sign."""
    return (bits >> count) & ((1 << (64 - count)) - 1)


def _mix(bits: Tensor) -> Tensor:
    bits = bits + _INCREMENT
    bits = (bits ^ _shift_right(bits, 30)) * _FACTORS[0]
    bits = (bits ^ _shift_right(bits, 27)) * _FACTORS[1]
    return bits ^ _shift_right(bits, 31)


def _sum_of_rows(columns: list[Tensor]) -> int:
    """columns: (N,) int64 each. A value in [0, 2^64)."""
    row = torch.zeros_like(columns[0])
    for column in columns:
        row = _mix(row ^ column)
    return int(row.sum()) % 2**64


def contacts_hash(pairs: Tensor, toi: Tensor) -> int:
    """Hash over (i, j, toi bits) of all contacts.

    Args:
        pairs: (K, 2) int64 global ids; the order within a pair does not matter.
        toi: (K,) float64.

    Returns:
        An integer in [0, 2^64); 0 without contacts. Hashes of disjoint sets of contacts add up modulo 2^64.

    Example:
        >>> f"{pgccd.sim.contacts_hash(hits.pairs, hits.toi):016x}"
    """
    return _sum_of_rows([pairs.amin(dim=1), pairs.amax(dim=1), toi.view(torch.int64)])


def state_hash(state: RobotState) -> int:
    """Hash over (id, pose, velocity bits) of all robots, as `contacts_hash`.

    Example:
        >>> f"{pgccd.sim.state_hash(state):016x}"
    """
    rows = torch.cat([state.position, state.orientation, state.velocity, state.angular_velocity], dim=1)
    return _sum_of_rows([state.id, *rows.view(torch.int64).unbind(dim=1)])


def id_hash(id: Tensor) -> int:
    """Hash over ids (N,) int64, as `contacts_hash`.

    Example:
        >>> f"{pgccd.sim.hashing.id_hash(state.id):016x}"
    """
    return _sum_of_rows([id])
