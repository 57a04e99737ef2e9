"""A mutant: the text that it replaces, and the test modules that must fail; or the reason why none can."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Mutant:
    """One mutation of the source.

    `old`, which occurs once in `file` (or once in `within`, which occurs once in the file), is replaced by `new`.
    `killed_by` are modules below tests/, or nodes of them. `equivalent` is the reason why no test can fail. If
    `switched`, both texts are expressions of the same type.
    """

    name: str
    file: str
    old: str
    new: str
    killed_by: tuple[str, ...]
    within: str = ""
    equivalent: str = ""
    switched: bool = True


CORE = "csrc/core/"
TRAVERSE = "csrc/kernels/traverse/"
NARROW = "csrc/kernels/narrow/"
BROAD = "csrc/kernels/broad/"
BOUNDS = "csrc/kernels/bounds/"
VOXEL = "csrc/kernels/voxel/"
DISTANCE = "csrc/kernels/distance/"
CONTACTS = "csrc/kernels/contacts/"

ON_TRAVERSE = ("kernels/test_margins_traverse.py",)
ON_NARROW = ("kernels/test_margins_narrow.py", "kernels/test_margins_candidates.py")
ON_BROAD = ("kernels/test_margins_broad.py",)
ON_VOXELS = ("kernels/test_voxels.py",)
ON_BOUNDS = ("kernels/test_margins_bounds.py",)
ON_CORE = ("kernels/test_margins_core.py",)
ON_TIES = ("search/test_ties.py",)
ON_DEGENERATE = ("search/test_narrow_degenerate.py",)
ON_SPIN = ("motion/test_spinning.py",)
ON_PASSING = ("search/test_narrow_at_scale.py",)
ON_ORIGIN = ("kernels/test_origin_bounds.py",)
ON_MARGIN = ("search/test_margin.py",)
ON_CROSSING = ("search/test_intersecting.py",)
ON_SIZES = ("search/test_unequal_sizes.py",)
ON_SUPPORTS = ("kernels/test_node_supports.py",)
ON_FAST_SPINS = ("search/test_fast_spins.py",)
ON_DISTANCE = ("search/test_distance.py",)

LOCAL_ROUNDING = "kLocalRounding, 64 units of the whole local frame, includes it"
SPARE = "covered by the 32 units of the extent, of which the projected gap needs at most 12"
