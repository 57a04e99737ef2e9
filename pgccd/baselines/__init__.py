"""Systems that pgccd is compared with."""

from pgccd.baselines.pcccd import PCCCD, VoxelStats

__all__ = ["PCCCD", "VoxelStats"]
