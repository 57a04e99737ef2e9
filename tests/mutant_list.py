"""The list of mutants: the text that each replaces, and the test modules that must fail; or the reason why none can.
See mutants.py.
"""

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

ON_TRAVERSE = ("test_margins_traverse.py",)
ON_NARROW = ("test_margins_narrow.py", "test_margins_candidates.py")
ON_BROAD = ("test_margins_broad.py",)
ON_VOXELS = ("test_voxels.py",)
ON_BOUNDS = ("test_margins_bounds.py",)
ON_CORE = ("test_margins_core.py",)
ON_TIES = ("test_ties.py",)
ON_DEGENERATE = ("test_narrow_degenerate.py",)
ON_SPIN = ("test_spinning.py",)
ON_PASSING = ("test_narrow_at_scale.py",)
ON_ORIGIN = ("test_origin_bounds.py",)
ON_MARGIN = ("test_margin.py",)

_LOCAL_ROUNDING = "kLocalRounding, 64 units of the whole local frame, includes it"
_SPARE = "covered by the 32 units of the extent, of which the projected gap needs at most 12"

_RIGID = [
    Mutant(
        "arc-deviation-zero",
        TRAVERSE + "rigid_sweep.h",
        "sweep_detail::kept_distance(centres, i, j, settings) + deviation",
        "sweep_detail::kept_distance(centres, i, j, settings)",
        ON_TRAVERSE,
    ),
    Mutant(
        "arc-deviation-half",
        TRAVERSE + "rigid_sweep.h",
        "sweep_detail::kept_distance(centres, i, j, settings) + deviation",
        "sweep_detail::kept_distance(centres, i, j, settings) + 0.5 * deviation",
        ON_TRAVERSE,
    ),
    Mutant(
        "arc-deviation-0.98",
        TRAVERSE + "rigid_sweep.h",
        "sweep_detail::kept_distance(centres, i, j, settings) + deviation",
        "sweep_detail::kept_distance(centres, i, j, settings) + 0.98 * deviation",
        ON_TRAVERSE,
    ),
    Mutant(
        "arc-deviation-0.999",
        TRAVERSE + "rigid_sweep.h",
        "sweep_detail::kept_distance(centres, i, j, settings) + deviation",
        "sweep_detail::kept_distance(centres, i, j, settings) + 0.999 * deviation",
        ON_TRAVERSE,
        equivalent="an arc of angle a deviates by 1 - a^2/48 of the bound; with kLocalRounding at least 0.3 % is spare"
        " for every a",
    ),
    Mutant(
        "arc-deviation-first-body-only",
        TRAVERSE + "rigid_sweep.h",
        "(turn_i * rho_i + turn_j * rho_j)",
        "(turn_i * rho_i)",
        ON_TRAVERSE,
    ),
    Mutant(
        "arc-deviation-of-wanted-segments",
        TRAVERSE + "rigid_sweep.h",
        "bend / (static_cast<double>(segment_count) * segment_count)",
        "smaller(bend / (static_cast<double>(segment_count) * segment_count), 0.02 * smaller(ri, rj))",
        ON_TRAVERSE,
    ),
    Mutant(
        "arc-segments-horizon",
        TRAVERSE + "rigid_sweep.h",
        "horizon * (static_cast<double>(k) / segment_count)",
        "horizon * horizon * (static_cast<double>(k) / segment_count)",
        ON_TRAVERSE,
    ),
    Mutant(
        "arc-tilt-zero",
        TRAVERSE + "rigid_sweep.h",
        "bodies.linear_path ? 1.5f : 0.5f",
        "bodies.linear_path ? 1.5f : 0.0f",
        ON_TRAVERSE,
    ),
    Mutant(
        "arc-tilt-0.9",
        TRAVERSE + "rigid_sweep.h",
        "bodies.linear_path ? 1.5f : 0.5f",
        "bodies.linear_path ? 1.5f : 0.45f",
        ON_TRAVERSE,
    ),
    Mutant(
        "arc-tilt-0.999",
        TRAVERSE + "rigid_sweep.h",
        "bodies.linear_path ? 1.5f : 0.5f",
        "bodies.linear_path ? 1.5f : 0.4995f",
        ON_TRAVERSE,
        equivalent="for an angle a between the normals the tilt is r a/2 and the arcs' deviation r a^2/8; together"
        " with kLocalRounding they cover a thousandth of the tilt",
    ),
    Mutant(
        "straight-tilt-as-arcs",
        TRAVERSE + "rigid_sweep.h",
        "bodies.linear_path ? 1.5f : 0.5f",
        "bodies.linear_path ? 0.5f : 0.5f",
        ("test_traverse_slabs.py",),
    ),
    Mutant(
        "rigid-local-rounding-zero",
        TRAVERSE + "rigid_sweep.h",
        "sweep_detail::rounded_up(scale * distance) + kLocalRounding",
        "sweep_detail::rounded_up(scale * distance)",
        ON_TRAVERSE,
    ),
    Mutant(
        "straight-rigid-blend",
        TRAVERSE + "rigid_sweep.h",
        "sweep_detail::blend(at_t0, spun(spin, at_t0, 1.0), t)",
        "spun(spin, at_t0, t)",
        ("test_traverse_slabs.py", "test_traverse.py::test_linear_paths"),
    ),
]

_DEFORMING = [
    Mutant(
        "deforming-local-rounding-zero",
        TRAVERSE + "deforming_sweep.h",
        "sweep_detail::rounded_up(scale * distance) + kLocalRounding",
        "sweep_detail::rounded_up(scale * distance)",
        ON_TRAVERSE,
    ),
    Mutant(
        "node-horizon-squared",
        TRAVERSE + "deforming_sweep.h",
        "static_cast<float>(horizon) * (at_t1 - at_t0)",
        "static_cast<float>(horizon * horizon) * (at_t1 - at_t0)",
        ON_TRAVERSE,
    ),
    Mutant(
        "vertex-horizon-squared",
        TRAVERSE + "deforming_sweep.h",
        "(1.0 - horizon) * local_t0 + horizon * local_t1",
        "(1.0 - horizon * horizon) * local_t0 + (horizon * horizon) * local_t1",
        ON_TRAVERSE,
    ),
    Mutant(
        "centre-horizon-squared",
        TRAVERSE + "deforming_sweep.h",
        "k == 0 ? 0.0 : horizon",
        "k == 0 ? 0.0 : horizon * horizon",
        ON_TRAVERSE,
    ),
]

_TREE = [
    Mutant(
        "kept-distance-0.999",
        TRAVERSE + "sweep_frame.h",
        "pair_separation(centres, i, j, settings.separation) + pair_tolerance(centres, i, j, settings.tolerance)",
        "0.999 * pair_separation(centres, i, j, settings.separation)",
        ON_TRAVERSE,
    ),
    Mutant(
        "kept-distance-without-tolerance",
        TRAVERSE + "sweep_frame.h",
        "pair_separation(centres, i, j, settings.separation) + pair_tolerance(centres, i, j, settings.tolerance)",
        "pair_separation(centres, i, j, settings.separation)",
        ON_TRAVERSE,
    ),
    Mutant(
        "kept-distance-not-rounded-up",
        TRAVERSE + "sweep_frame.h",
        "static_cast<float>(x) * (1.0f + 2.0f * Precision<float>::unit)",
        "static_cast<float>(x)",
        ON_TRAVERSE,
        equivalent=_LOCAL_ROUNDING,
    ),
    Mutant(
        "sphere-reach-0.999",
        TRAVERSE + "pair_item.h",
        "(child.radius + other.radius) + sweep_.inflation",
        "0.999f * ((child.radius + other.radius) + sweep_.inflation)",
        ON_TRAVERSE,
    ),
    Mutant(
        "sphere-reach-without-inflation",
        TRAVERSE + "pair_item.h",
        "(child.radius + other.radius) + sweep_.inflation",
        "(child.radius + other.radius)",
        ON_TRAVERSE,
    ),
    Mutant(
        "slab-reach-0.999",
        TRAVERSE + "pair_item.h",
        "child.radius + sweep_.inflation",
        "0.999f * (child.radius + sweep_.inflation)",
        ON_TRAVERSE,
        within="slab_separates(other.slab, start, end, child.radius + sweep_.inflation)",
    ),
    Mutant(
        "other-slab-reach-0.999",
        TRAVERSE + "pair_item.h",
        "other.radius + sweep_.inflation",
        "0.999f * (other.radius + sweep_.inflation)",
        ON_TRAVERSE,
        within="-start, -end, other.radius + sweep_.inflation)",
    ),
    Mutant(
        "slab-high-0.999",
        TRAVERSE + "pair_item.h",
        "scale * b.high[slot]",
        "0.999f * (scale * b.high[slot])",
        ON_TRAVERSE,
    ),
    Mutant(
        "slab-low-0.999",
        TRAVERSE + "pair_item.h",
        "scale * b.low[slot]",
        "0.999f * (scale * b.low[slot])",
        ON_TRAVERSE,
    ),
    Mutant(
        "first-segments-only",
        TRAVERSE + "pair_item.h",
        "sweep_.segment_count",
        "larger(1, sweep_.segment_count - 1)",
        ON_TRAVERSE,
        within="uint32_t mask = 0;\n    for (int k = 1; k <= sweep_.segment_count; ++k)",
    ),
    Mutant(
        "leaf-ball-0.999",
        TRAVERSE + "traverse_cpu.cpp",
        "tree.local_radius(1 - side, other_leaf) + tree.sweep().inflation",
        "0.999f * (tree.local_radius(1 - side, other_leaf) + tree.sweep().inflation)",
        ON_TRAVERSE,
    ),
    Mutant(
        "leaf-distance-0.999",
        TRAVERSE + "traverse_cpu.cpp",
        "tree.sweep().inflation",
        "0.999f * tree.sweep().inflation",
        ON_TRAVERSE,
        within="const float distance = tree.sweep().inflation;",
    ),
    Mutant(
        "triangles-distance-rounding",
        TRAVERSE + "overlap_item.h",
        "distance * (1.0f + 8.0f * Precision<float>::unit)",
        "distance * 1.0f",
        ON_TRAVERSE,
        equivalent=_LOCAL_ROUNDING + ", which is part of the distance: its 8 units are among those 64",
    ),
    Mutant(
        "triangles-distance-0.999",
        TRAVERSE + "overlap_item.h",
        "distance * (1.0f + 8.0f * Precision<float>::unit)",
        "distance * 0.999f",
        ON_TRAVERSE,
    ),
    Mutant(
        "triangles-direction-of-no-length",
        TRAVERSE + "overlap_item.h",
        "length_squared > 1e-30f",
        "length_squared >= 0.0f",
        ON_TRAVERSE,
    ),
    Mutant(
        "node-pair-radius",
        TRAVERSE + "pair_item.h",
        "sweep_.local_scale * radius(side, node)",
        "0.999f * (sweep_.local_scale * radius(side, node))",
        ON_TRAVERSE,
    ),
    Mutant(
        "slab-tilt-not-counted-above",
        TRAVERSE + "overlap_item.h",
        "slab.high + grown",
        "slab.high",
        ON_TRAVERSE,
    ),
    Mutant(
        "slab-tilt-not-counted-below",
        TRAVERSE + "overlap_item.h",
        "slab.low - grown",
        "slab.low",
        ON_TRAVERSE,
    ),
]

_DIRECTIONS = [
    Mutant(
        "cull-extent-zero",
        CORE + "fixed_directions.h",
        "distance * (1.0f + 8.0f * unit) + (20.0f * unit) * extent",
        "distance * (1.0f + 8.0f * unit) + 0.0f * extent",
        ON_NARROW,
    ),
    Mutant(
        "cull-distance-0.999",
        CORE + "fixed_directions.h",
        "distance * (1.0f + 8.0f * unit) + (20.0f * unit) * extent",
        "distance * 0.999f + (20.0f * unit) * extent",
        ON_NARROW,
    ),
    Mutant(
        "cull-distance-rounding",
        CORE + "fixed_directions.h",
        "distance * (1.0f + 8.0f * unit) + (20.0f * unit) * extent",
        "distance * 1.0f + (20.0f * unit) * extent",
        ON_NARROW,
        equivalent="a threshold above 2 x the extent never separates; below that, its own 3 roundings fit into the"
        " doubled 20 units of the extent",
    ),
    Mutant(
        "cull-small-extents",
        CORE + "fixed_directions.h",
        "extent > 0x1p-40f",
        "extent > 0.0f * extent",
        ON_NARROW,
    ),
    Mutant(
        "cull-large-extents",
        CORE + "fixed_directions.h",
        "extent < 0x1p40f",
        "extent < 0x1p127f",
        ON_NARROW,
    ),
    Mutant(
        "cull-not-a-number",
        CORE + "fixed_directions.h",
        "(sum == sum)",
        "((sum == sum) | (extent > 0.0f * extent))",
        ("test_narrow_elementary.py::test_no_number_is_never_free", *ON_NARROW),
    ),
    Mutant(
        "cull-direction-of-no-length",
        CORE + "fixed_directions.h",
        "length > 1e-24f",
        "length > -1.0f + 0.0f * length",
        ON_NARROW,
        equivalent="extents are at least 2^-40: a direction shorter than 1e-24 is one of two crossed vectors, whose"
        " projections underflow only below 1e-38 of their length",
    ),
    Mutant(
        "cull-distance-not-rounded-up",
        NARROW + "elementary_item.h",
        "round_up<float>((settings.separation + settings.tolerance) * (1.0 + 0x1p-50))",
        "static_cast<float>(settings.separation + settings.tolerance)",
        ON_NARROW,
        equivalent="half a unit of the distance; `stays_apart` adds eight",
    ),
]

_SEPARATIONS = [
    Mutant(
        "leaves-without-distance",
        TRAVERSE + "leaf_separation.h",
        "tree_.sweep().inflation * (1.0f + 8.0f * Precision<float>::unit)",
        "0.0f * tree_.sweep().inflation",
        ON_TRAVERSE,
    ),
    Mutant(
        "leaves-distance-0.999",
        TRAVERSE + "leaf_separation.h",
        "tree_.sweep().inflation * (1.0f + 8.0f * Precision<float>::unit)",
        "0.999f * tree_.sweep().inflation",
        ON_TRAVERSE,
    ),
    Mutant(
        "leaves-apart-at-the-start-only",
        TRAVERSE + "leaf_separation.h",
        "smaller(gap_start, gap_end)",
        "gap_start",
        ON_TRAVERSE,
    ),
    Mutant(
        "leaves-apart-at-the-end-only",
        TRAVERSE + "leaf_separation.h",
        "smaller(gap_start, gap_end)",
        "gap_end",
        ON_TRAVERSE,
    ),
    Mutant(
        "leaves-without-second-row",
        TRAVERSE + "leaf_separation.h",
        "row < leaf.first_points + leaf.points_count",
        "row < leaf.first_points + 1",
        ON_TRAVERSE,
    ),
    Mutant(
        "later-leaves-0.999",
        "csrc/kernels/pipeline/pipeline_cpu.cpp",
        "leaves.begin > horizon[leaves.pair]",
        "leaves.begin > 0.999 * horizon[leaves.pair]",
        ("test_search_in_parts.py",),
    ),
    Mutant(
        "leaves-part-not-rounded-down",
        TRAVERSE + "leaf_separation.h",
        "rounded_down((from - threshold) / (from - to))",
        "(from - threshold) / (from - to)",
        ("test_search_in_parts.py",),
    ),
    Mutant(
        "leaves-part-of-the-whole-gap",
        TRAVERSE + "leaf_separation.h",
        "rounded_down((from - threshold) / (from - to))",
        "rounded_down(from / (from - to))",
        ("test_search_in_parts.py",),
    ),
    Mutant(
        "leaves-time-not-rounded-down",
        TRAVERSE + "leaf_separation.h",
        "rounded_down((static_cast<float>(k - 1) + part) / static_cast<float>(segments))",
        "(static_cast<float>(k - 1) + part) / static_cast<float>(segments)",
        ("test_search_in_parts.py",),
    ),
    Mutant(
        "leaves-time-of-the-next-segment",
        TRAVERSE + "leaf_separation.h",
        "rounded_down((static_cast<float>(k - 1) + part) / static_cast<float>(segments))",
        "rounded_down((static_cast<float>(k) + part) / static_cast<float>(segments))",
        ("test_search_in_parts.py",),
    ),
    Mutant(
        "features-stepwise-without-distance",
        CORE + "fixed_directions.h",
        "square_root(length_squared) * limits.apart",
        "square_root(length_squared) * 0.0f",
        ON_TRAVERSE,
    ),
    Mutant(
        "features-stepwise-distance-0.999",
        CORE + "fixed_directions.h",
        "square_root(length_squared) * limits.apart",
        "square_root(length_squared) * (0.999f * limits.apart)",
        ON_TRAVERSE,
    ),
    Mutant(
        "features-stepwise-out-of-range",
        CORE + "fixed_directions.h",
        "if (!limits.in_range()) return false;",
        "",
        ON_TRAVERSE,
        equivalent="in the local frame of a pair nothing is larger than 1, and steps shorter than 1e-12 are not tried",
    ),
]

_CERTIFICATES = [
    Mutant(
        "fixed-direction-extent-zero",
        NARROW + "certificates.h",
        "(T(2) * error.point + T(32) * u * error.extent)",
        "(T(2) * error.point)",
        ON_NARROW,
    ),
    Mutant(
        "fixed-direction-point-zero",
        NARROW + "certificates.h",
        "(T(2) * error.point + T(32) * u * error.extent)",
        "(T(32) * u * error.extent)",
        ON_NARROW,
    ),
    Mutant(
        "fixed-direction-distance-rounding",
        NARROW + "certificates.h",
        "distance * (T(1) + T(16) * u)",
        "distance",
        ON_NARROW,
        within="distance * (T(1) + T(16) * u) + (T(2)",
        equivalent=_SPARE,
    ),
    Mutant(
        "fixed-direction-distance-0.999",
        NARROW + "certificates.h",
        "distance * (T(1) + T(16) * u)",
        "distance * T(0.999)",
        ON_NARROW,
        within="distance * (T(1) + T(16) * u) + (T(2)",
    ),
    Mutant(
        "determinant-rounding-zero",
        NARROW + "certificates.h",
        "distance * longest * (T(1) + T(16) * u) + rounding",
        "distance * longest * (T(1) + T(16) * u)",
        ON_NARROW,
    ),
    Mutant(
        "moving-normal-distance-0.999",
        NARROW + "certificates.h",
        "distance * longest * (T(1) + T(16) * u) + rounding",
        "distance * longest * T(0.999) + rounding",
        ON_NARROW,
    ),
    Mutant(
        "moving-normal-length-at-start",
        NARROW + "certificates.h",
        "larger(larger(norm_squared(n0), T(0.25) * norm_squared(n1)), norm_squared(n2))",
        "norm_squared(n0)",
        ON_NARROW,
    ),
    Mutant(
        "difference-error-point-zero",
        NARROW + "certificates.h",
        "T(2) * error.point + T(8) * T(Precision<T>::unit) * error.extent",
        "T(8) * T(Precision<T>::unit) * error.extent",
        ON_NARROW,
    ),
    Mutant(
        "difference-error-extent-zero",
        NARROW + "certificates.h",
        "T(2) * error.point + T(8) * T(Precision<T>::unit) * error.extent",
        "T(2) * error.point",
        ON_NARROW,
        equivalent="on straight paths a window ends with the step, so that both terms of a blend are at most twice as"
        " long as the vectors at the ends of the window, covered by 128 units; on arcs the points' error covers it",
    ),
    Mutant(
        "lengths-without-root-three",
        NARROW + "certificates.h",
        "T(1.7320509)",
        "T(1)",
        ("test_certificates.py",),
    ),
    Mutant(
        "difference-error-1.01",
        NARROW + "certificates.h",
        "T(1.01) * difference_error(error)",
        "difference_error(error)",
        ON_NARROW,
        equivalent="products of two errors, a hundredth of the points' error, fit into the 128 units of the lengths",
    ),
    Mutant(
        "fixed-direction-step-rounding",
        NARROW + "advancement.h",
        "prefix * duration * (T(1) - T(4) * unit)",
        "prefix * duration",
        ON_NARROW,
        equivalent="the threshold lies 32 units of the extent further out, and no gap closes by more than twice the"
        " extent in a step: 16 units of the step, of which the product's rounding uses 4",
    ),
    Mutant(
        "advance-not-rounded-down",
        NARROW + "advancement.h",
        "add_down(t, prefix * duration * (T(1) - T(4) * unit))",
        "(t + prefix * duration * (T(1) - T(4) * unit))",
        ON_NARROW,
        equivalent="one unit of t, of the 16 that the threshold's 32 units of the extent leave (see"
        " fixed-direction-step-rounding)",
    ),
    Mutant(
        "moving-normal-step-rounding",
        NARROW + "certificates.h",
        "step * (T(1) - prefix) * (T(1) - T(4) * u)",
        "step * (T(1) - prefix)",
        ON_NARROW,
        equivalent="the cubic changes by less than 6 |a||b||r|, so its 128 units are more than 16 units of time",
    ),
    Mutant(
        "phases-hand-on-complete-advances",
        NARROW + "advancement.h",
        "Progress<T>{t, goal, advances}",
        "Progress<T>{t, goal, kQuickAdvances}",
        ("test_search_phases.py",),
    ),
    Mutant(
        "advance-deviation-0.999",
        NARROW + "advancement.h",
        "separation + path.deviation(duration) * (T(1) + T(16) * unit)",
        "separation + path.deviation(duration) * T(0.999)",
        ON_NARROW,
    ),
    Mutant(
        "advance-deviation-zero",
        NARROW + "advancement.h",
        "separation + path.deviation(duration) * (T(1) + T(16) * unit)",
        "separation",
        ON_NARROW,
    ),
    Mutant(
        "advance-deviation-rounding",
        NARROW + "advancement.h",
        "separation + path.deviation(duration) * (T(1) + T(16) * unit)",
        "separation + path.deviation(duration)",
        ON_NARROW,
        equivalent="the 2^-40 in the curvature is 512 times larger",
    ),
    Mutant(
        "curvature-rounding",
        NARROW + "paths.h",
        "(1.0 + 0x1p-40)",
        "(1.0 + 0.0)",
        ON_NARROW,
        within="(1.0 + 0x1p-40) * (first.angle",
        equivalent="the curvature's error is at most 10 units, the deviation has 16 spare, and an arc deviates less"
        " than a parabola",
    ),
    Mutant(
        "curvature-of-the-first-body",
        NARROW + "paths.h",
        "first.angle * first.angle * first_radius + second.angle * second.angle * second_radius",
        "first.angle * first.angle * first_radius",
        ON_NARROW,
    ),
    Mutant(
        "curvature-of-the-second-body",
        NARROW + "paths.h",
        "first.angle * first.angle * first_radius + second.angle * second.angle * second_radius",
        "second.angle * second.angle * second_radius",
        ON_NARROW,
    ),
    Mutant(
        "arc-extent-zero",
        NARROW + "paths.h",
        "6.0 * (reach + larger(max_abs(centre.at_t0), max_abs(centre.at_t1)))",
        "0.0 * reach",
        ON_NARROW,
        equivalent="256 units of each radius, and 8 of the offset, are more than the roundings of the projected gap",
    ),
    Mutant(
        "straight-extent-zero",
        NARROW + "paths.h",
        "error_ = {scale_ * point_error, scale_ * size}",
        "error_ = {scale_ * point_error, T(0)}",
        ON_NARROW,
    ),
    Mutant(
        "rigid-point-units-zero",
        NARROW + "pair_points.h",
        "kRigidPointUnits + 8.0 * spin[side].angle",
        "8.0 * spin[side].angle",
        ON_NARROW,
    ),
    Mutant(
        "rigid-point-angle-zero",
        NARROW + "pair_points.h",
        "kRigidPointUnits + 8.0 * spin[side].angle",
        "kRigidPointUnits",
        ON_NARROW,
    ),
    Mutant(
        "centre-error-zero",
        NARROW + "pair_points.h",
        "8.0 * Precision<double>::unit * larger(max_abs(centre.at_t0), max_abs(centre.at_t1))",
        "0.0",
        ON_NARROW,
        equivalent="4 units of the offset, which is at most the extent and both radii: " + _SPARE,
    ),
    Mutant(
        "contact-goal-too-wide",
        NARROW + "advancement.h",
        "settings.tolerance * path.scale() * T(0.0625)",
        "settings.tolerance * path.scale() * T(1.5)",
        ON_NARROW,
    ),
    Mutant(
        "noise-zero",
        NARROW + "advancement.h",
        "T(4) * error.point + T(64) * unit * error.extent",
        "T(0)",
        ("test_narrow_elementary.py::test_tight_tolerance_is_resolved", *ON_NARROW),
    ),
    Mutant(
        "touch-side-rounding-zero",
        NARROW + "touching.h",
        "determinant_rounding(length, error)",
        "T(0)",
        ON_NARROW,
    ),
    Mutant(
        "touch-inside-rounding-zero",
        NARROW + "touching.h",
        "T(32) * T(Precision<T>::unit) * (sum * sum) + T(4.1) * difference_error(error) * sum",
        "T(0)",
        ON_NARROW,
    ),
    Mutant(
        "touch-separation-noise-zero",
        NARROW + "touching.h",
        "distance_then + noise < separation",
        "distance_then < separation",
        ON_NARROW,
    ),
    Mutant(
        "touch-without-crossing",
        NARROW + "touching.h",
        "!changes_sides",
        "false",
        ON_NARROW,
        within="if (!changes_sides) return false;",
    ),
    Mutant(
        "slender-normals-used",
        NARROW + "nearest_points.h",
        "normal_squared > (slender * slender) * parallel_squared",
        "normal_squared > T(0)",
        ON_NARROW,
        equivalent="an inside foot requires the offset's transverse part below the slenderness, which bounds the error"
        " of the distance",
    ),
    Mutant(
        "toi-rounded-to-nearest",
        NARROW + "precision_ladder.h",
        "round_down<To>(outcome.toi)",
        "static_cast<To>(outcome.toi)",
        ON_NARROW,
    ),
    Mutant(
        "float-toi-not-below",
        CORE + "rounding.h",
        "static_cast<double>(nearest) > x ? std::nextafter(nearest, -static_cast<float>(INFINITY)) : nearest",
        "nearest",
        ON_NARROW,
    ),
    Mutant(
        "double-toi-not-below",
        CORE + "rounding.h",
        "x.low < 0.0 ? std::nextafter(x.high, -static_cast<double>(INFINITY)) : x.high",
        "x.high",
        ON_NARROW,
    ),
    Mutant(
        "separation-rounded-to-nearest",
        NARROW + "precision_ladder.h",
        "round_up<T>(settings.separation)",
        "static_cast<T>(settings.separation)",
        ON_NARROW,
        equivalent="one unit of the separation: " + _SPARE,
        switched=False,
    ),
    Mutant(
        "tolerance-rounded-to-nearest",
        NARROW + "precision_ladder.h",
        "round_down<T>(settings.tolerance)",
        "static_cast<T>(settings.tolerance)",
        ON_NARROW,
        equivalent="a sixteenth of the tolerance is used, and a contact must also be certified or within the noise",
        switched=False,
    ),
    Mutant(
        "prune-time-rounded-to-nearest",
        NARROW + "precision_ladder.h",
        "round_up<T>(settings.prune_at)",
        "static_cast<T>(settings.prune_at)",
        ON_NARROW,
        equivalent="only elementary queries use single precision, and they are never pruned",
        switched=False,
    ),
    Mutant(
        "ties-pruned",
        NARROW + "candidate_item.h",
        "std::nextafter(latest, static_cast<double>(INFINITY))",
        "latest",
        ON_TIES,
    ),
    Mutant(
        "double-double-advance-not-rounded-down",
        CORE + "rounding.h",
        "sum - magnitude(sum) * DoubleDouble(4.0 * Precision<DoubleDouble>::unit)",
        "sum",
        ON_NARROW,
        equivalent="4 units of t, of the 16 that the threshold's 32 units of the extent leave (see"
        " fixed-direction-step-rounding)",
    ),
    Mutant(
        "double-double-unit",
        CORE + "rounding.h",
        "0x1p-101",
        "0x1p-140",
        ON_NARROW,
        switched=False,
    ),
    Mutant(
        "double-double-sum",
        CORE + "double_double.h",
        "s.low + t.high",
        "s.low",
        ON_NARROW,
    ),
    Mutant(
        "double-double-product",
        CORE + "double_double.h",
        "c.low + cross",
        "c.low",
        ON_NARROW,
    ),
    Mutant(
        "double-double-quotient",
        CORE + "double_double.h",
        "(a.high - back.high) + (a.low - back.low)",
        "(a.high - back.high)",
        ON_NARROW,
    ),
    Mutant(
        "normal-sign-at-zero-gap",
        NARROW + "contact_item.h",
        "(along < 0.0) != f.swapped",
        "false",
        ON_NARROW,
    ),
    Mutant(
        "normal-sign-of-swapped",
        NARROW + "contact_item.h",
        "(along < 0.0) != f.swapped",
        "along < 0.0",
        ON_NARROW,
    ),
    Mutant(
        "normal-from-noise",
        NARROW + "contact_item.h",
        "norm(normal) > 0x1p-40 * extent(features)",
        "norm(normal) > 0.0",
        ON_NARROW,
    ),
    Mutant(
        "ties-by-feature-ignored",
        NARROW + "narrow_cpu.cpp",
        "std::make_tuple(pair(a), toi_a, features(a)) < std::make_tuple(pair(b), toi_b, features(b))",
        "std::make_tuple(pair(a), toi_a, features(b)) < std::make_tuple(pair(b), toi_b, features(a))",
        ON_NARROW,
    ),
    Mutant(
        "pair-tolerance-of-the-larger",
        CORE + "bodies.h",
        "smaller(centres.radius[i], centres.radius[j])",
        "larger(centres.radius[i], centres.radius[j])",
        ON_NARROW,
    ),
    Mutant(
        "nonzero-toi-goal",
        NARROW + "advancement.h",
        "smaller(goal, T(0.5) * (distance - separation))",
        "smaller(goal, T(2) * (distance - separation))",
        ("test_narrow_elementary.py::test_nonzero_toi",),
    ),
]

_PATIENT = [
    Mutant(
        "turning-middle-0.999",
        NARROW + "certificates.h",
        "distance * (T(0.5) * (T(1) + dot(direction0, direction1)) + T(16) * u) + rounding",
        "distance * T(0.999) * (T(0.5) * (T(1) + dot(direction0, direction1)) + T(16) * u) + rounding",
        ON_PASSING,
    ),
    Mutant(
        "turning-ends-0.999",
        NARROW + "certificates.h",
        "distance * (T(1) + T(16) * u) + rounding",
        "T(0.999) * distance * (T(1) + T(16) * u) + rounding",
        ON_PASSING,
        within="const T at_ends = distance * (T(1) + T(16) * u) + rounding",
    ),
    Mutant(
        "turning-rounding-zero",
        NARROW + "certificates.h",
        "T(2) * error.point + T(32) * u * error.extent",
        "T(0)",
        ON_PASSING,
        within="const T rounding = T(2) * error.point + T(32) * u * error.extent",
        equivalent="the search stops at 4 point errors and 64 units of the extent above the separation",
    ),
    Mutant(
        "turning-chord-to-the-end-only",
        NARROW + "certificates.h",
        "smaller(T(2) * (c1 - c0), c2 - c0)",
        "c2 - c0",
        ON_PASSING,
    ),
    Mutant(
        "turning-deviation-zero",
        NARROW + "advancement.h",
        "separation + path.deviation(far_duration) * (T(1) + T(16) * unit)",
        "separation",
        ON_PASSING,
    ),
    Mutant(
        "spin-reach-0.999",
        NARROW + "whole_turns.h",
        "square_root(along_quarter * along_quarter + along_inward * along_inward)",
        "0.999 * square_root(along_quarter * along_quarter + along_inward * along_inward)",
        ON_SPIN,
    ),
    Mutant(
        "spin-deviation-of-the-other-zero",
        NARROW + "whole_turns.h",
        "threshold + bend * duration * duration * 0.125 * (1.0 + 16.0 * u)",
        "threshold",
        ON_SPIN,
    ),
    Mutant(
        "spin-separation-0.999",
        NARROW + "whole_turns.h",
        "separation * (1.0 + 16.0 * u)",
        "0.999 * separation * (1.0 + 16.0 * u)",
        ON_SPIN,
    ),
    Mutant(
        "tiny-directions-not-scaled",
        NARROW + "nearest_points.h",
        "!(squared > T(Precision<T>::smallest_square))",
        "false",
        ON_DEGENERATE,
    ),
    Mutant(
        "tiny-directions-taken-as-they-are",
        NARROW + "advancement.h",
        "!(squared > T(Precision<T>::smallest_square))",
        "false",
        ON_DEGENERATE,
    ),
    Mutant(
        "slender-distance-along-the-normal",
        NARROW + "nearest_points.h",
        "T(0x1p-6) * parallel_squared",
        "T(0)",
        ON_DEGENERATE,
    ),
]


_CORE = [
    Mutant(
        "quaternion-not-divided",
        CORE + "rotation.h",
        "2.0 / (q.w * q.w + norm_squared(q.v))",
        "2.0",
        ON_CORE,
    ),
    Mutant(
        "quaternions-not-normalised",
        CORE + "rotation.h",
        "normalized(q1) * conjugate(normalized(q0))",
        "q1 * conjugate(q0)",
        ON_CORE,
        equivalent="the angle is taken from a ratio and the axis divided by its length: both ignore the scale",
    ),
    Mutant(
        "shorter-way",
        CORE + "rotation.h",
        "turn.w < 0.0",
        "false",
        ("test_motion.py",),
    ),
    Mutant(
        "arctangent-one-step",
        CORE + "trig.h",
        "step < 2",
        "step < 1",
        ("test_motion.py",),
    ),
    Mutant(
        "reduction-without-middle",
        CORE + "trig.h",
        "std::fma(-quadrant, half_pi_middle, r)",
        "r",
        ("test_motion.py",),
    ),
    Mutant(
        "reduction-without-low",
        CORE + "trig.h",
        "std::fma(-quadrant, half_pi_low, r)",
        "r",
        ("test_motion.py",),
        equivalent="2^-110 of up to 2^20 quadrants is 2^-90, far below 2^-53; it affects only the relative error near"
        " the zeros, which is unspecified",
    ),
    Mutant(
        "sine-last-term",
        CORE + "trig.h",
        "-1.0 / 1307674368000.0 + q * (1.0 / 355687428096000.0)",
        "-1.0 / 1307674368000.0",
        ("test_motion.py", *ON_CORE),
        equivalent="(pi/4)^17 / 17! is 2^-54: less than the margin of the specified 2 units",
    ),
    Mutant(
        "sine-last-two-terms",
        CORE + "trig.h",
        "-1.0 / 1307674368000.0 + q * (1.0 / 355687428096000.0)",
        "0.0",
        ("test_motion.py", *ON_CORE),
    ),
    Mutant(
        "versine-last-term",
        CORE + "trig.h",
        "-1.0 / 20922789888000.0 + q * (1.0 / 6402373705728000.0)",
        "-1.0 / 20922789888000.0",
        ("test_motion.py", *ON_CORE),
        equivalent="(pi/4)^18 / 18! is 2^-59",
    ),
    Mutant(
        "versine-last-two-terms",
        CORE + "trig.h",
        "-1.0 / 20922789888000.0 + q * (1.0 / 6402373705728000.0)",
        "0.0",
        ("test_motion.py", *ON_CORE),
    ),
]

_BROAD = [
    Mutant(
        "box-rounding-zero",
        BROAD + "body_volumes.h",
        "1.7320508075688774 * 0x1p-54",
        "0.0",
        ("test_broad_rounding.py",),
        switched=False,
    ),
    Mutant(
        "predicate-without-tolerance",
        BROAD + "body_volumes.h",
        "bodies.separation + pair_tolerance(bodies.centres, i, j, bodies.tolerance)",
        "bodies.separation",
        ("test_broad.py", "test_broad_rounding.py", "test_extremes.py"),
    ),
    Mutant(
        "swept-box-without-tolerance",
        BROAD + "body_volumes.h",
        "bodies.separation + (bodies.tolerance < 0.0 ? -bodies.tolerance * radius : bodies.tolerance)",
        "bodies.separation",
        ("test_broad.py", "test_broad_rounding.py", "test_extremes.py"),
    ),
    Mutant(
        "predicate-offset-slack-zero",
        BROAD + "body_volumes.h",
        "0x1p-48 * (max_abs(offset.at_t0) + max_abs(offset.at_t1))",
        "0.0",
        ON_BROAD,
    ),
    Mutant(
        "predicate-radius-slack-zero",
        BROAD + "body_volumes.h",
        "(1.0 + 0x1p-42)",
        "1.0",
        ON_BROAD,
        within="kept) * (1.0 + 0x1p-42) + rounding",
        equivalent="touching spheres have an offset of at least their reach, so the offset's margin is at least 2^-48"
        " of a third of it",
    ),
    Mutant(
        "predicate-reach-0.999",
        BROAD + "body_volumes.h",
        "(1.0 + 0x1p-42)",
        "0.999",
        ON_BROAD,
        within="kept) * (1.0 + 0x1p-42) + rounding",
    ),
    Mutant(
        "swept-box-radius-slack-zero",
        BROAD + "body_volumes.h",
        "(1.0 + 0x1p-40)",
        "1.0",
        ON_BROAD,
        within="0.5 * kept) * (1.0 + 0x1p-40)",
    ),
    Mutant(
        "swept-box-travel-slack-zero",
        BROAD + "body_volumes.h",
        "0x1p-40 * max_abs(travel)",
        "0.0",
        ON_BROAD,
    ),
    Mutant(
        "swept-box-without-separation",
        BROAD + "body_volumes.h",
        "0.5 * kept",
        "0.4995 * kept",
        ON_BROAD,
    ),
    Mutant(
        "outward-zero",
        BROAD + "body_volumes.h",
        "0x1p-22 * std::fabs(x) + 0x1p-130",
        "0.0 * x",
        ON_BROAD,
        equivalent="rounding to nearest keeps the order of bounds measured from one origin, so overlapping ones"
        " still do; the balls have their own 2^-19",
    ),
    Mutant(
        "outward-tiny-zero",
        BROAD + "body_volumes.h",
        "0x1p-22 * std::fabs(x) + 0x1p-130",
        "0x1p-22 * std::fabs(x)",
        ON_BROAD,
        equivalent="rounding to nearest keeps the order of bounds measured from one origin, so overlapping ones"
        " still do; the balls have their own 2^-19",
    ),
    Mutant(
        "ball-rounding-zero",
        BROAD + "filter_box.h",
        "0x1p-19 * larger(max_abs(lower), max_abs(upper))",
        "0.0",
        ON_BROAD,
    ),
    Mutant(
        "ball-radius-slack-zero",
        BROAD + "filter_box.h",
        "(1.0 + 0x1p-20)",
        "1.0",
        ON_BROAD,
        equivalent="a box's largest coordinate is its radius at least, so that the ball's rounding is 2^-19 of it",
    ),
    Mutant(
        "ball-radius-0.999",
        BROAD + "filter_box.h",
        "(1.0 + 0x1p-20)",
        "0.999",
        ON_BROAD,
    ),
    Mutant(
        "ball-underflow",
        BROAD + "filter_box.h",
        "reach * reach + FLT_MIN",
        "reach * reach",
        ON_BROAD,
    ),
]

_BOUNDS = [
    Mutant(
        "refit-children-0.999",
        BOUNDS + "refit_item.h",
        "norm(cast<double>(children[c].centre[end]) - centre) + children[c].radius",
        "0.999 * (norm(cast<double>(children[c].centre[end]) - centre) + children[c].radius)",
        ON_BOUNDS,
    ),
    Mutant(
        "refit-box-0.999",
        BOUNDS + "refit_item.h",
        "norm(refit_detail::upper_corner(node.upper[end] - centre, centre - node.lower[end]))",
        "0.999 * norm(refit_detail::upper_corner(node.upper[end] - centre, centre - node.lower[end]))",
        ON_BOUNDS,
    ),
    Mutant(
        "refit-large-slab-0.999",
        BOUNDS + "refit_item.h",
        "-node.radius",
        "-0.999 * node.radius",
        ON_BOUNDS,
    ),
    Mutant(
        "refit-measured-0.999",
        BOUNDS + "refit_item.h",
        "std::sqrt(squared)",
        "0.999 * std::sqrt(squared)",
        ON_BOUNDS,
    ),
    Mutant(
        "refit-first-end-only",
        BOUNDS + "refit_item.h",
        "larger(squared, norm_squared(x))",
        "end == 0 ? larger(squared, norm_squared(x)) : squared",
        ON_BOUNDS,
    ),
    Mutant(
        "refit-radius-to-float",
        BOUNDS + "refit_item.h",
        "static_cast<float>(node.radius * (1.0 + 0x1p-40)) * (1.0f + 2.0f * Precision<float>::unit)",
        "static_cast<float>(node.radius * (1.0 + 0x1p-40))",
        ON_BOUNDS,
    ),
    Mutant(
        "refit-radius-double-slack",
        BOUNDS + "refit_item.h",
        "static_cast<float>(node.radius * (1.0 + 0x1p-40)) * (1.0f + 2.0f * Precision<float>::unit)",
        "static_cast<float>(node.radius) * (1.0f + 2.0f * Precision<float>::unit)",
        ON_BOUNDS,
        equivalent="the next float above the nearest is 2^-25 of the radius above it: more than roundings in double",
    ),
    Mutant(
        "refit-slab-slack-zero",
        BOUNDS + "refit_item.h",
        "0x1p-22 * node.radius",
        "0.0",
        ON_BOUNDS,
    ),
    Mutant(
        "deforming-radius-slack",
        BOUNDS + "bounds_cpu.cpp",
        "std::sqrt(squared) * (1.0 + 0x1p-40)",
        "std::sqrt(squared)",
        ON_BOUNDS,
    ),
    Mutant(
        "mean-in-one-go",
        BOUNDS + "refit_item.h",
        "256",
        "1 << 30",
        ON_BOUNDS,
        within="constexpr int64_t kMeanChunk = 256;",
        switched=False,
    ),
    Mutant(
        "node-radius-slack",
        "csrc/mesh/hierarchy.cpp",
        "std::sqrt(node.points.farthest(cast<double>(centre)).first) * (1.0 + 1e-14)",
        "std::sqrt(node.points.farthest(cast<double>(centre)).first)",
        ON_BOUNDS,
        equivalent="the next float above the nearest is 2^-25 of the radius above it",
    ),
    Mutant(
        "node-radius-0.999",
        "csrc/mesh/hierarchy.cpp",
        "std::sqrt(node.points.farthest(cast<double>(centre)).first) * (1.0 + 1e-14)",
        "0.999 * std::sqrt(node.points.farthest(cast<double>(centre)).first)",
        ON_BOUNDS,
    ),
    Mutant(
        "node-radius-to-float",
        "csrc/mesh/hierarchy.cpp",
        "std::nextafter(static_cast<float>(radius), HUGE_VALF)",
        "static_cast<float>(radius)",
        ON_BOUNDS,
    ),
    Mutant(
        "node-slab-low-to-float",
        "csrc/mesh/hierarchy.cpp",
        "std::nextafter(static_cast<float>(low - slack), -HUGE_VALF)",
        "static_cast<float>(low - slack)",
        ON_BOUNDS,
    ),
    Mutant(
        "node-slab-high-to-float",
        "csrc/mesh/hierarchy.cpp",
        "std::nextafter(static_cast<float>(high + slack), HUGE_VALF)",
        "static_cast<float>(high + slack)",
        ON_BOUNDS,
    ),
    Mutant(
        "node-slab-slack",
        "csrc/mesh/hierarchy.cpp",
        "1e-14 * radius",
        "0.0",
        ON_BOUNDS,
    ),
    Mutant(
        "mesh-radius-slack",
        "pgccd/geometry/mesh.py",
        "radius * (1.0 + 2.0**-50)",
        "radius",
        ("test_mesh.py::test_sphere_bound_and_edges", *ON_BOUNDS),
        switched=False,
    ),
]

_DISTRIBUTED = [
    Mutant(
        "world-without-census",
        "pgccd/distributed/world/world.py",
        "Census.of_ranks(self.comm, self.id).require(self.census)",
        "pass",
        ("distributed/test_census.py",),
        switched=False,
    ),
    Mutant(
        "census-counts-only",
        "pgccd/distributed/halo/migrate.py",
        "if self != expected:",
        "if self.count != expected.count:",
        ("distributed/test_census.py",),
        switched=False,
    ),
    Mutant(
        "census-hashes-only",
        "pgccd/distributed/halo/migrate.py",
        "if self != expected:",
        "if self.ids != expected.ids:",
        ("distributed/test_census.py",),
        switched=False,
    ),
    Mutant(
        "distributed-simulation-without-census",
        "pgccd/sim/distributed/simulation.py",
        "Census(tally.robots, tally.id_hash).require(self._expected)",
        "pass",
        ("distributed/test_census.py",),
        switched=False,
    ),
]

_ORIGIN = [
    Mutant(
        "origin-from-axis-zero",
        TRAVERSE + "rigid_sweep.h",
        "path.from_axis[0] + ri",
        "0.0 * path.from_axis[0] + ri",
        ON_ORIGIN,
    ),
    Mutant(
        "origin-from-axis-0.995",
        TRAVERSE + "rigid_sweep.h",
        "path.from_axis[0] + ri",
        "0.995 * path.from_axis[0] + ri",
        ON_ORIGIN,
    ),
    Mutant(
        "origin-from-axis-of-the-second-0.995",
        TRAVERSE + "rigid_sweep.h",
        "path.from_axis[1] + rj",
        "0.995 * path.from_axis[1] + rj",
        ON_ORIGIN,
    ),
    Mutant(
        "origin-from-axis-0.999",
        TRAVERSE + "rigid_sweep.h",
        "path.from_axis[0] + ri",
        "0.999 * path.from_axis[0] + ri",
        ON_ORIGIN,
        equivalent="one segment's deviation is at most a fiftieth of the smaller radius, and kLocalRounding at least"
        " 0.15 % of that; with more segments it is a larger part",
    ),
    Mutant(
        "origin-bulge-0.999",
        CORE + "centre_arc.h",
        "smaller(0.125 * angle * angle, 2.0) * radius",
        "0.999 * smaller(0.125 * angle * angle, 2.0) * radius",
        ON_ORIGIN,
    ),
    Mutant(
        "origin-bulge-diameter",
        CORE + "centre_arc.h",
        "smaller(0.125 * angle * angle, 2.0)",
        "smaller(0.125 * angle * angle, 1.999)",
        ON_ORIGIN,
    ),
    Mutant(
        "origin-bulge-rounding",
        CORE + "centre_arc.h",
        "(1.0 + 0x1p-50)",
        "(1.0 + 0.0)",
        ON_ORIGIN,
        within="radius * (1.0 + 0x1p-50)",
        equivalent="8 units of the bulge, at most 16 of the centre's distance, of the 256 that the centre is allowed",
    ),
    Mutant(
        "origin-offset-error-zero",
        CORE + "centre_arc.h",
        "(kRigidPointUnits + 8.0 * angle) * Precision<double>::unit * norm(centre)",
        "0.0",
        ON_ORIGIN,
    ),
    Mutant(
        "origin-sum-rounding-zero",
        BOUNDS + "moving_sphere_item.h",
        "2.0 * Precision<double>::unit * (larger(max_abs(p0), max_abs(p1)) + norm(centre))",
        "0.0",
        ON_ORIGIN,
    ),
    Mutant(
        "origin-reach-rounding",
        BOUNDS + "moving_sphere_item.h",
        "(1.0 + 0x1p-50)",
        "(1.0 + 0.0)",
        ON_ORIGIN,
        within="(radius + bulge + rounding) * (1.0 + 0x1p-50)",
        equivalent="two roundings of the reach, of which the predicate and the boxes add 2^-42",
    ),
    Mutant(
        "origin-local-frame-without-bulge",
        TRAVERSE + "rigid_sweep.h",
        "sweep_detail::largest_coordinate(centres) + bulge",
        "sweep_detail::largest_coordinate(centres) + 0.0 * bulge",
        ON_ORIGIN,
        equivalent="it only sets the scale. Where bodies touch, the ends of their segment are too far apart for"
        " kLocalRounding only if a segment turns by more than 0.02: the arcs then stray less than the deviation allows,"
        " by more than those roundings",
    ),
    Mutant(
        "origin-traversal-rounding-zero",
        TRAVERSE + "rigid_sweep.h",
        "5.0 * point_error + 64.0 * Precision<double>::unit * (6.0 * (3.0 * reach + apart))",
        "0.0",
        ON_ORIGIN,
    ),
    Mutant(
        "origin-point-error-of-the-radius",
        NARROW + "pair_points.h",
        "mesh_reach(bodies, body[side])",
        "bodies.centres.radius[body[side]]",
        ON_NARROW,
    ),
]

_MARGIN = [
    Mutant(
        "margin-not-kept",
        CORE + "bodies.h",
        "add_up(separation, add_up(centres.margin[i], centres.margin[j]))",
        "separation",
        ON_MARGIN,
    ),
    Mutant(
        "margin-0.999",
        CORE + "bodies.h",
        "add_up(separation, add_up(centres.margin[i], centres.margin[j]))",
        "add_up(separation, 0.999 * add_up(centres.margin[i], centres.margin[j]))",
        ON_MARGIN,
    ),
    Mutant(
        "margin-not-rounded-up",
        CORE + "bodies.h",
        "add_up(separation, add_up(centres.margin[i], centres.margin[j]))",
        "separation + (centres.margin[i] + centres.margin[j])",
        ON_MARGIN,
        equivalent=f"one unit of the separation: {_SPARE}",
    ),
    Mutant(
        "margin-not-in-reach",
        "pgccd/detection/bodies.py",
        "self.reach = (self.reach + scene.margin) * (1.0 + 2.0**-50)",
        "self.reach = self.reach * (1.0 + 2.0**-50)",
        ON_MARGIN,
        switched=False,
    ),
    Mutant(
        "margin-in-reach-0.999",
        "pgccd/detection/bodies.py",
        "self.reach = (self.reach + scene.margin) * (1.0 + 2.0**-50)",
        "self.reach = (self.reach + 0.999 * scene.margin) * (1.0 + 2.0**-50)",
        ON_MARGIN,
        switched=False,
    ),
    Mutant(
        "margin-in-reach-rounding",
        "pgccd/detection/bodies.py",
        "self.reach = (self.reach + scene.margin) * (1.0 + 2.0**-50)",
        "self.reach = self.reach + scene.margin",
        ON_MARGIN,
        equivalent="one rounding of the reach, to which the predicate and the boxes add 2^-42",
        switched=False,
    ),
]

_VOXELS = [
    Mutant(
        "voxel-box-bulge-zero",
        VOXEL + "triangle_box_item.h",
        "bodies.linear_path ? 0.0 : arc_bulge(spin.angle, norm(cross(spin.axis, start)))",
        "0.0",
        ON_VOXELS,
    ),
    Mutant(
        "voxel-box-separation-0.999",
        VOXEL + "triangle_box_item.h",
        "0.5 * (input.separation + tolerance) + margin",
        "0.4995 * (input.separation + tolerance) + margin",
        ON_VOXELS,
    ),
    Mutant(
        "voxel-box-float-rounding-zero",
        VOXEL + "triangle_box_item.h",
        "0x1p-23 * (farthest + separation)",
        "0.0",
        ON_VOXELS,
    ),
    Mutant(
        "voxel-half-open-subdomain",
        VOXEL + "voxel_pairs_cpu.cpp",
        "grid_.along_axis(larger(a.lower[axis], b.lower[axis])) != place[axis]",
        "false",
        ON_VOXELS,
    ),
]

_SPACE = [
    Mutant(
        "bisection-plane-open",
        BROAD + "space_partition.h",
        "!(coordinate(box.upper) < at)",
        "!(coordinate(box.upper) <= at)",
        ("distributed/test_bisection.py",),
    ),
    Mutant(
        "bisection-one-side",
        BROAD + "space_partition.h",
        "if (plane.reaches_above(box)) stack[size++] = above;",
        "",
        ("distributed/test_bisection.py",),
        switched=False,
    ),
    Mutant(
        "self-pair-by-reference-point",
        BROAD + "subdomain_item.h",
        "if (held_i == held_j) return own_i;",
        "",
        ("distributed/test_motions.py",),
        switched=False,
    ),
]

MUTANTS = [
    *_RIGID,
    *_DEFORMING,
    *_TREE,
    *_DIRECTIONS,
    *_SEPARATIONS,
    *_CERTIFICATES,
    *_PATIENT,
    *_CORE,
    *_BROAD,
    *_BOUNDS,
    *_ORIGIN,
    *_MARGIN,
    *_DISTRIBUTED,
    *_SPACE,
    *_VOXELS,
]
