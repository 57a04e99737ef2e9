"""Mutants of points and segments: which feature pairs are tested, corners of points, hierarchies, clouds and solids."""

from __future__ import annotations

from mutants_of.mutant import CORE, TRAVERSE, Mutant

LEAVES = TRAVERSE + "leaf_item.h"
SWEEP = TRAVERSE + "rigid_sweep.h"
ENCLOSURES = CORE + "enclosures.h"
ON_ELEMENTS = ("search/test_points_and_segments.py",)


def _mutant(name: str, file: str, old: str, new: str, equivalent: str = "") -> Mutant:
    return Mutant(f"elements-{name}", file, old, new, ON_ELEMENTS, equivalent=equivalent)


MUTANTS = [
    _mutant(
        "no-points-of-i", LEAVES, "kind_j == ElementKind::kTriangle || is_point_i", "kind_j == ElementKind::kTriangle"
    ),
    _mutant("no-points-of-j", LEAVES, "(is_point_j && !is_point_i)", "false"),
    _mutant("points-twice", LEAVES, "(is_point_j && !is_point_i)", "is_point_j"),
    _mutant(
        "edges-through-segments",
        LEAVES,
        "tj.kind() == ElementKind::kTriangle",
        "true",
        equivalent="an edge passes through no face without area",
    ),
    _mutant(
        "corners-off-centre",
        SWEEP,
        "load_vec3(bodies.meshes.vertices + 3 * vertex) - centre",
        "load_vec3(bodies.meshes.vertices + 3 * vertex)",
    ),
    _mutant(
        "spheres-without-size",
        CORE + "bodies.h",
        "radius >= 0.0 && radius <= kRadiusOfPoint && centres.margin != nullptr",
        "false",
    ),
    _mutant("nodes-too-small", ENCLOSURES, "reach + b.radius[slot]", "reach"),
    _mutant("nodes-about-the-origin", ENCLOSURES, "mesh_centre(bodies, body) + centre", "centre"),
    _mutant("no-points-inside", ENCLOSURES, "has_points(bodies.meshes, mesh)", "false"),
    _mutant("nodes-of-the-solid", ENCLOSURES, "load_vec3(bodies.centres.position_t0 + 3 * body) + centre", "centre"),
]
