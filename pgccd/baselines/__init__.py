"""Baseline systems for comparison."""

from pgccd.baselines.pcccd import PCCCD, VoxelStats

__all__ = ["PCCCD", "VoxelStats"]


def __dir__() -> list[str]:
    return sorted(__all__)
