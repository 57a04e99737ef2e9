"""Mutants of the way out of contact."""

from __future__ import annotations

from mutants_of.mutant import Mutant

FILE = "pgccd/search/exit_distance.py"
POINTS = "_POINTS = 2.0**-47"
LONGER_WAY = "((x + y) + z) + (size + stray)"
REST = "-((low + lower) + rest)"
WORST = "it bounds points whose coordinates all have the largest rounding, in the same direction"
SPARE = "what rounded points may touch is added to margins, and is a thousand times larger"


def _exit(name: str, old: str, new: str, equivalent: str = "") -> Mutant:
    killed_by = ("search/test_exit_distance.py",)
    return Mutant(f"exit-{name}", FILE, old, new, killed_by, equivalent=equivalent, switched=False)


MUTANTS = [
    _exit("points-zero", POINTS, "_POINTS = 0.0"),
    _exit("points-0.999", POINTS, "_POINTS = 0.999 * 2.0**-47", WORST),
    _exit("points-without-margin", "margin = sum_of_margins(added, margin)", "margin = sum_of_margins(added, None)"),
    _exit("way-0.999", "(1.0 + _WAY)", "0.999"),
    _exit("way-rounding", "(1.0 + _WAY)", "1.0", SPARE),
    _exit("way-of-centres", LONGER_WAY, "((x + y) + z) + stray"),
    _exit("way-without-offset", LONGER_WAY, "size + stray"),
    _exit("way-along-two-axes", LONGER_WAY, "(x + y) + (size + stray)"),
    _exit("offset-rounded", REST, "-(lower + rest)"),
    _exit("sum-rounded", REST, "-(low + rest)"),
    _exit(
        "product-rounded",
        REST,
        "-(low + lower)",
        "it changes a translation by a rounding of its own: " + SPARE,
    ),
    _exit("upper-0.999", "_above(below[row] + left)", "below[row] + 0.999 * left"),
    _exit("upper-rounding", "_above(below[row] + left)", "below[row] + left", SPARE),
    _exit("product-rounding", "_above(_above(self.way - below)[row]", "((self.way - below)[row]", SPARE),
    _exit("lower-of-distance", "near.upper <= separation", "near.lower <= separation"),
    _exit("lower-without-separation", "near.upper <= separation", "near.upper <= 0.0"),
    _exit("lower-of-contacts", "hits[(hits.kind == Kind.EF_AB) | (hits.kind == Kind.EF_BA)]", "hits"),
    _exit("lower-of-distances-only", "touches[passes.pairs[:, 0] // 2] = True", "pass"),
    _exit("lower-of-larger", "bodies.scene._size[pairs].amin(dim=1)", "bodies.scene._size[pairs].amax(dim=1)"),
    _exit("halves-below", "torch.where(touches, middle, below)", "middle"),
    _exit("halves-above", "torch.where(touches, above, middle)", "above"),
    _exit("bodies-with-themselves", "pairs[pairs[:, 0] != pairs[:, 1]]", "pairs"),
    _exit("default-pairs-without-separation", 'Query("any", query.min_separation,', 'Query("any", 0.0,'),
]
