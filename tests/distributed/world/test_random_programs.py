"""Random sequences of steps, moves, checkpoints and changes of bodies, on changing numbers of ranks."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.ranks import RankPool
from support.world_machine import go_on


def sequences(ranks: RankPool, folder: Path, seed: int, sizes: tuple[int, ...], operations: int) -> dict[str, int]:
    """The same world on each number of ranks in turn; what has been seen."""
    seen: dict[str, int] = {}
    for leg, size in enumerate(sizes):
        for name, count in ranks.run(size, go_on, 1000 * seed + leg, operations, str(folder), leg > 0)[0].items():
            seen[name] = seen.get(name, 0) + count
    return seen


def test_random_sequences(ranks: RankPool, tmp_path: Path) -> None:
    """Rigid and deforming bodies; some trajectories have margins, bodies are added between others, pairs excluded."""
    seen = dict.fromkeys(("contacts", "stopped", "rounds", "touching", "unresolved", "excluded"), 0)
    for seed in (24, 30, 34):
        for name, count in sequences(ranks, tmp_path / str(seed), seed, (3, 2), 7).items():
            seen[name] += count
    assert min(seen.values()) > 5, seen


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 160))
def test_many_random_sequences(ranks: RankPool, tmp_path: Path, seed: int) -> None:
    sequences(ranks, tmp_path, seed, (1 + seed % 4, 1 + (seed + 1) % 4, 1 + (seed + 3) % 4), 12)
