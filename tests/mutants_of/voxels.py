"""Mutants of the baseline by voxels."""

from __future__ import annotations

from mutants_of.mutant import ON_VOXELS, VOXEL, Mutant

MUTANTS = [
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
