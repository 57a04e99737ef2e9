"""Order-independent hashes of rows.

Each row is mixed to 64 bits (SplitMix64: Steele, Lea & Flood 2014, doi:10.1145/2714064.2660195); rows are summed modulo
2^64. Integer arithmetic only: equal on every device and for any order of rows, and the hash of a union is the sum of
the hashes (as needed over ranks).
"""

from collections.abc import Sequence

from torch import Tensor

from pgccd import ops


def row_hash(columns: Sequence[Tensor]) -> int:
    """Hash of the rows of columns (N, ...) of 8-byte numbers, in [0, 2^64); 0 without rows."""
    return int(ops.simulate_hash(list(columns))) % 2**64
