"""Mutants of the bounds of distances."""

from __future__ import annotations

from mutants_of.mutant import DISTANCE, ON_DISTANCE, Mutant

NODES, SEARCH, PAIR = DISTANCE + "node_gap_item.h", DISTANCE + "distance_item.h", DISTANCE + "moving_pair.h"
ROUNDING = "real errors are a few roundings, so either part of the bound alone covers them; see distance-lower-rounding"
BEND = "half_square * larger(curvature + rounding, 0.0) * kRoundedUp"
DEVIATION = "0.25 * half_square * pair.curvature() * kRoundedUp"

MUTANTS = [
    Mutant("distance-bend-zero", NODES, BEND, "0.0 * (curvature + rounding)", ON_DISTANCE),
    Mutant("distance-bend-0.999", NODES, BEND, "half_square * larger(curvature + rounding, 0.0) * 0.999", ON_DISTANCE),
    Mutant(
        "distance-bend-rounded-up",
        NODES,
        BEND,
        "half_square * larger(curvature, 0.0)",
        ON_DISTANCE,
        equivalent="below the rounding of every bound: the bend is at most a multiple of the pair's extent in any part"
        " of the step that a search ends in",
    ),
    Mutant(
        "distance-turned-zero",
        NODES,
        "0.5 * spin.angle * length * pair.from_axis(side)",
        "0.0 * spin.angle * length",
        ON_DISTANCE,
    ),
    Mutant(
        "distance-bend-one-end",
        NODES,
        "larger(most(side, 0, across), most(side, 1, across))",
        "most(side, 0, across)",
        ON_DISTANCE,
    ),
    Mutant(
        "distance-bend-one-body",
        NODES,
        "if (!(spin.angle > 0.0)) continue;",
        "if (!(spin.angle > 0.0) || side == 1) continue;",
        ON_DISTANCE,
        switched=False,
    ),
    Mutant("distance-deviation-zero", NODES, DEVIATION, "0.0 * pair.curvature()", ON_DISTANCE),
    Mutant(
        "distance-deviation-0.999",
        NODES,
        DEVIATION,
        "0.25 * half_square * pair.curvature() * 0.999",
        ON_DISTANCE,
        equivalent="attained only by single points on opposite sides of both axes; the nodes of a tree are leaves of"
        " triangles, whose spheres are larger by more than a thousandth of it",
    ),
    Mutant("distance-slab-across", NODES, "norm(across) * node.radius;", "0.0 * norm(across);", ON_DISTANCE),
    Mutant(
        "distance-samples-rounding",
        NODES,
        "32.0 * Precision<float>::unit",
        "0.0 * Precision<float>::unit",
        ON_DISTANCE,
        equivalent="samples are rounded up to multiples of 7/1024 radii, by 1700 times this on average, and"
        " interpolated between corners that no node fills",
    ),
    Mutant("distance-middle-bend", SEARCH, "- 0.5 * bend, last", "- 0.0 * bend, last", ON_DISTANCE),
    Mutant("distance-middle-bend-0.999", SEARCH, "- 0.5 * bend, last", "- 0.4995 * bend, last", ON_DISTANCE),
    Mutant(
        "distance-shorter-direction",
        SEARCH,
        "middle + 0.5 * (shorter * gap)",
        "middle + 1.0 * (shorter * gap)",
        ON_DISTANCE,
    ),
    Mutant(
        "distance-lower-rounding", SEARCH, "return gap - pair_.rounding();", "return gap;", ON_DISTANCE, switched=False
    ),
    Mutant(
        "distance-upper-rounding",
        SEARCH,
        "* (1.0 + 0x1p-48) + pair_.rounding()",
        "* 1.0 + 0.0 * pair_.rounding()",
        ON_DISTANCE,
        switched=False,
    ),
    Mutant(
        "distance-of-points",
        PAIR,
        "2.0 * point_error + 32.0",
        "0.0 * point_error + 32.0",
        ON_DISTANCE,
        switched=False,
        equivalent=ROUNDING,
    ),
    Mutant(
        "distance-extent",
        PAIR,
        "32.0 * Precision<double>::unit * extent",
        "0.0 * Precision<double>::unit * extent",
        ON_DISTANCE,
        equivalent=ROUNDING,
    ),
    Mutant(
        "distance-axis-through-centre",
        PAIR,
        "distance_from_axis(pair_.orientation[side], pair_.spin[side], centre_[side]) +",
        "0.0 +",
        ON_DISTANCE,
        switched=False,
    ),
    Mutant(
        "distance-margins-down",
        SEARCH,
        "add_down(found.lower, -at_most)",
        "add_down(found.lower, -at_least)",
        ON_DISTANCE,
        equivalent="less than the rounding of the bounds",
    ),
]
