"""Hypothesis strategies for meshes, motions and degenerate features.

`contacts`, not imported here, constructs pairs of bodies that graze, rest or meet tip to tip at a chosen time.
"""

from .features import degenerate_features, feature_motions
from .meshes import (
    TriMesh,
    boxes,
    bumpy_spheres,
    extended_meshes,
    flat_sheets,
    meshes,
    non_manifold,
    several_components,
    soups,
    tetrahedra,
    with_holes,
)
from .motions import Pose, PoseMotion, pose_motions, poses, unit_quaternions

__all__ = [
    "Pose",
    "PoseMotion",
    "TriMesh",
    "boxes",
    "bumpy_spheres",
    "degenerate_features",
    "extended_meshes",
    "feature_motions",
    "flat_sheets",
    "meshes",
    "non_manifold",
    "pose_motions",
    "poses",
    "several_components",
    "soups",
    "tetrahedra",
    "unit_quaternions",
    "with_holes",
]
