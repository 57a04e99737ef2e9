"""Mutants of the bound of how far links of arms stray from arcs."""

from __future__ import annotations

from mutants_of.mutant import Mutant

STRAY = "pgccd/robots/stray.py"
ON_STRAY = ("robots/test_stray.py",)
SEARCH = "pgccd/robots/path_search.py"
ON_SEARCH = ("robots/test_certify.py",)
NOT_ATTAINED = "a term of higher order in the turn, of which no chain is known that attains it"

MUTANTS = [
    Mutant(
        "arm-origin-0.999",
        STRAY,
        "0.125 * _acc",
        "0.124875 * _acc",
        (*ON_STRAY, "robots/test_certify.py"),
        switched=False,
    ),
    Mutant("arm-rotation-0.999", STRAY, "* 0.125", "* 0.124875", ON_STRAY, switched=False),
    Mutant(
        "arm-joints-apart",
        STRAY,
        "(revolute + 2.0 * before)",
        "(revolute + 0.0 * before)",
        ON_STRAY,
        switched=False,
    ),
    Mutant(
        "arm-slide-0.999", STRAY, "2.0 * (prismatic * before)", "1.998 * (prismatic * before)", ON_STRAY, switched=False
    ),
    Mutant(
        "arm-speed-zero",
        STRAY,
        "0.5 * (ends[n] + speed)",
        "0.5 * ends[n]",
        ON_STRAY,
        equivalent=NOT_ATTAINED,
        switched=False,
    ),
    Mutant(
        "arm-crossing-of-neighbours",
        "pgccd/robots/kinematics.py",
        "min(1.0, np.sin(angle) + 1e-12)",
        "0.999 * min(1.0, np.sin(angle))",
        ON_STRAY,
        switched=False,
    ),
    Mutant("arm-rate", STRAY, "2.0 * _RATE * s", "0.0 * s", ON_STRAY, equivalent=NOT_ATTAINED, switched=False),
    Mutant(
        "arm-pose-error",
        STRAY,
        "_POSE_ERROR = 2.0**-46",
        "_POSE_ERROR = 0.0",
        ON_STRAY,
        switched=False,
    ),
    Mutant(
        "arm-rounding-between-waypoints",
        SEARCH,
        "torch.maximum(*way)",
        "torch.maximum(q0.abs(), q1.abs())",
        ON_SEARCH,
        switched=False,
    ),
    Mutant("arm-near-at-an-end", SEARCH, "length <= _SHORTEST", "left <= _SHORTEST", ON_SEARCH, switched=False),
    Mutant(
        "arm-sum-of-times",
        SEARCH,
        "(own > segment) | ((own == segment) & (at > toi))",
        "own + at > segment + toi",
        ON_SEARCH,
        switched=False,
    ),
]
