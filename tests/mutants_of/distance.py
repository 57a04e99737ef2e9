"""Mutants of the bounds of distances."""

from __future__ import annotations

from mutants_of.mutant import DISTANCE, ON_DISTANCE, Mutant

NODES, TRIANGLES = DISTANCE + "node_gap_item.h", DISTANCE + "triangle_gap_item.h"
SEARCH, PAIR = DISTANCE + "distance_item.h", DISTANCE + "moving_pair.h"
MEASURE = "pgccd/search/distance.py"
ROUNDING = "real errors are a few roundings, which either part of the bound covers alone; see distance-lower-rounding"
OF_NODES = "spheres, slabs and samples of nodes are rounded outward by 10^-8 of their radius, 10^5 times this"
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
        equivalent="a bend that matters is below the pair's extent, and 2^-40 of what `turned` adds to it",
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
        "spin.angle > 0.0",
        "spin.angle > 0.0 && side == 0",
        ON_DISTANCE,
        within="if (!(spin.angle > 0.0)) continue;",
    ),
    Mutant("distance-deviation-zero", NODES, DEVIATION, "0.0 * pair.curvature()", ON_DISTANCE),
    Mutant(
        "distance-deviation-0.999",
        NODES,
        DEVIATION,
        "0.25 * half_square * pair.curvature() * 0.999",
        ON_DISTANCE,
        equivalent="attained only by points as far from the axis as any, opposite one another, in spheres that touch"
        " there; those of triangles are larger by more than a thousandth of it",
    ),
    Mutant("distance-reach-0.999", NODES, "pair.reach()", "0.999 * pair.reach()", ON_DISTANCE),
    Mutant("distance-slab-across", NODES, "norm(across) * node.radius", "0.0 * norm(across)", ON_DISTANCE),
    Mutant(
        "distance-samples-rounding",
        NODES,
        "32.0 * Precision<float>::unit",
        "0.0 * Precision<float>::unit",
        ON_DISTANCE,
        equivalent="samples are rounded up to multiples of 7/1024 radii, on average by 1700 times this",
    ),
    Mutant(
        "distance-nodes-rounding",
        NODES,
        "least_between(gap[0], gap[1], bend) - pair.rounding()",
        "least_between(gap[0], gap[1], bend)",
        ON_DISTANCE,
        equivalent=OF_NODES,
    ),
    Mutant(
        "distance-spheres-rounding",
        NODES,
        "over.deviation(pair) + pair.rounding()",
        "over.deviation(pair)",
        ON_DISTANCE,
        equivalent=OF_NODES,
    ),
    Mutant("distance-middle-bend", TRIANGLES, "0.5 * bend", "0.0 * bend", ON_DISTANCE),
    Mutant("distance-middle-bend-0.999", TRIANGLES, "0.5 * bend", "0.4995 * bend", ON_DISTANCE),
    Mutant(
        "distance-shorter-direction",
        TRIANGLES,
        "middle + 0.5 * (shorter * gap)",
        "middle + 1.0 * (shorter * gap)",
        ON_DISTANCE,
    ),
    Mutant(
        "distance-lower-rounding",
        SEARCH,
        "gap - pair_.rounding()",
        "gap",
        ON_DISTANCE,
        within="return gap - pair_.rounding();",
    ),
    Mutant(
        "distance-upper-rounding",
        SEARCH,
        "norm(points[1] - points[0]) * (1.0 + 0x1p-48) + pair_.rounding()",
        "norm(points[1] - points[0])",
        ON_DISTANCE,
    ),
    Mutant(
        "distance-tolerance-of-margins", PAIR, "centres.radius[k] + centres.margin[k]", "centres.radius[k]", ON_DISTANCE
    ),
    Mutant("distance-of-points", PAIR, "2.0 * point_error", "0.0 * point_error", ON_DISTANCE, equivalent=ROUNDING),
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
        "distance_from_axis(pair_.orientation[side], pair_.spin[side], centre_[side])",
        "0.0",
        ON_DISTANCE,
    ),
    Mutant(
        "distance-margins-down",
        SEARCH,
        "add_down(found.lower, -at_most)",
        "add_down(found.lower, -at_least)",
        ON_DISTANCE,
        equivalent="the sums differ by a rounding of the margins; a bound is lower by many of the pair's extent, and"
        " margins so large touch",
    ),
    Mutant(
        "distance-along-lower-of-nearest",
        MEASURE,
        "lower=lower,\n        upper=nearest.upper",
        "lower=nearest.lower,\n        upper=nearest.upper",
        ON_DISTANCE,
        switched=False,
    ),
    Mutant(
        "distance-along-converged",
        MEASURE,
        "converged=is_converged",
        "converged=torch.ones_like(is_converged)",
        ON_DISTANCE,
        switched=False,
    ),
    Mutant(
        "distance-along-converged-of-any",
        MEASURE,
        'found.converged.to(torch.float64), "amin") > 0.0',
        'found.converged.to(torch.float64), "amin") >= 0.0',
        ON_DISTANCE,
        switched=False,
    ),
    Mutant(
        "distance-along-converged-of-all",
        MEASURE,
        "are_converged | (nearest.upper - lower",
        "are_converged & (nearest.upper - lower",
        ON_DISTANCE,
        switched=False,
    ),
    Mutant(
        "distance-along-nearest-segment",
        MEASURE,
        "earliest_of_each(owner, len(pairs), found.upper)",
        "earliest_of_each(owner, len(pairs), found.lower)",
        ON_DISTANCE,
        switched=False,
    ),
    Mutant(
        "distance-along-time",
        MEASURE,
        "time_along(segment, nearest.time, segments)",
        "nearest.time",
        ON_DISTANCE,
        switched=False,
    ),
    Mutant(
        "distance-converged-beyond",
        MEASURE,
        "(upper - lower <= allowed) | (lower > cutoff)",
        "upper - lower <= allowed",
        ON_DISTANCE,
        switched=False,
    ),
    Mutant(
        "distance-converged-always",
        MEASURE,
        "(upper - lower <= allowed) | (lower > cutoff)",
        "torch.ones_like(lower, dtype=torch.bool)",
        ON_DISTANCE,
        switched=False,
    ),
    Mutant(
        "distance-near-by-upper",
        MEASURE,
        "near = lower <= cutoff",
        "near = upper <= cutoff",
        ON_DISTANCE,
        switched=False,
    ),
    Mutant(
        "distance-radius-of-larger",
        MEASURE,
        "thick[wanted].amin(dim=1)",
        "thick[wanted].amax(dim=1)",
        ON_DISTANCE,
        switched=False,
    ),
    Mutant(
        "distance-radius-without-margin",
        MEASURE,
        "bodies.radius + thickness",
        "bodies.radius",
        ON_DISTANCE,
        switched=False,
    ),
]
