"""Mutants of the boxes of bodies that fill little of their SBV."""

from __future__ import annotations

from mutants_of.mutant import BOUNDS, BROAD, Mutant

MAKE, TEST = BOUNDS + "moving_box_item.h", BROAD + "box_item.h"
ON_BOXES = ("kernels/test_margins_boxes.py",)

MUTANTS = [
    Mutant("box-bulge-zero", MAKE, "per_unit * (bulge + fixed)", "per_unit * fixed", ON_BOXES),
    Mutant("box-bulge-0.999", MAKE, "per_unit * (bulge + fixed)", "per_unit * (0.999 * bulge + fixed)", ON_BOXES),
    Mutant("box-furthest-0.999", MAKE, "smaller(furthest, ", "smaller(0.999 * furthest, ", ON_BOXES, switched=False),
    Mutant("box-reach-0.999", MAKE, "from_axis + radius)", "0.999 * (from_axis + radius))", ON_BOXES, switched=False),
    Mutant(
        "box-margin-0.999",
        MAKE,
        "box_detail::margin_of(bodies, body)",
        "0.999 * box_detail::margin_of(bodies, body)",
        ON_BOXES,
        within="double fixed = box_detail::margin_of(bodies, body)",
    ),
    Mutant(
        "box-deforming-margin-0.999",
        MAKE,
        "box_detail::margin_of(bodies, body)",
        "0.999 * box_detail::margin_of(bodies, body)",
        ON_BOXES,
        within="per_unit * box_detail::margin_of(bodies, body)",
    ),
    Mutant("box-point-error-0.999", MAKE, "5.0 * point_error", "4.99 * point_error", ON_BOXES),
    Mutant("box-noise-0.999", MAKE, "1536.0 * Precision<double>::unit", "1534.0 * Precision<double>::unit", ON_BOXES),
    Mutant(
        "box-centre-rounding-0.999",
        MAKE,
        "2.0 * Precision<double>::unit * (largest",
        "1.998 * Precision<double>::unit * (largest",
        ON_BOXES,
        switched=False,
    ),
    Mutant(
        "box-centre-error-zero",
        MAKE,
        "centre_offset_error(spin.angle, centre)",
        "0.0",
        ON_BOXES,
    ),
    Mutant("box-point-0.999", MAKE, "per_unit * radius + growth(from_axis)", "0.999 * (per_unit * radius)", ON_BOXES),
    Mutant("box-deforming-0.999", MAKE, "(0.5 * (to - from))", "(0.4995 * (to - from))", ON_BOXES),
    Mutant(
        "box-of-mesh-0.999",
        "pgccd/geometry/boxes.py",
        "0.5 * (upper - lower) * (1.0 + _ROUNDING)",
        "0.4995 * (upper - lower)",
        ON_BOXES,
        switched=False,
    ),
    Mutant(
        "box-of-mesh-rounding-zero",
        "pgccd/geometry/boxes.py",
        "_ROUNDING = 1e-12",
        "_ROUNDING = 0.0",
        ON_BOXES,
        equivalent="a few 2^-53 of the radius, to which the test of boxes adds 2^-18 of it",
        switched=False,
    ),
    Mutant("box-rounding-zero-in-pairs", TEST, "64.0f * Precision<float>::unit", "0.0f", ON_BOXES),
    Mutant(
        "box-distance-without-tolerance",
        TEST,
        "bodies.separation + pair_tolerance(centres, i, j, bodies.tolerance)",
        "bodies.separation",
        ON_BOXES,
    ),
    Mutant(
        "box-distance-0.999",
        TEST,
        "bodies.separation + pair_tolerance(centres, i, j, bodies.tolerance)",
        "0.999 * (bodies.separation + pair_tolerance(centres, i, j, bodies.tolerance))",
        ON_BOXES,
    ),
    Mutant(
        "box-pairs-without-growth",
        TEST,
        "(static_cast<float>(scale * distance) + grown)",
        "static_cast<float>(scale * distance)",
        ("search/test_slender.py", *ON_BOXES),
    ),
    Mutant(
        "box-stopped-rounding-zero",
        TEST,
        "32.0 * Precision<double>::unit",
        "0.0",
        ON_BOXES,
    ),
    Mutant("box-first-end-only", TEST, "has_gap(0, 0) && has_gap(1, 1)", "has_gap(0, 0)", ON_BOXES),
    Mutant("box-last-end-only", TEST, "has_gap(0, 0) && has_gap(1, 1)", "has_gap(1, 1)", ON_BOXES),
    Mutant("box-equal-times-only", TEST, "(has_gap(0, 1) && has_gap(1, 0))", "true", ON_BOXES),
    Mutant("box-edges-0.999", TEST, "unit_[side] * edges", "0.999f * unit_[side] * edges", ON_BOXES),
]
