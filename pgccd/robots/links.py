"""Which links of a robot are joined, and so not tested against each other."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

from pgccd.robots.kinematics import Tree


def adjacent_links(tree: Tree, links: Sequence[tuple[int, bool]]) -> list[tuple[int, int]]:
    """Pairs of links that are rigidly joined, or whose rigid groups are joined by one joint; groups without surfaces
    are passed over.

    Args:
        links: the frame of each, and whether it has surfaces.
    """
    # The frame that each one is rigidly joined to: that of the last joint that moves.
    rigid: list[int] = []
    for index, joint in enumerate(tree.joints):
        rigid.append(rigid[joint.parent] if joint.kind == "fixed" and joint.parent >= 0 else index)
    has_surfaces = {rigid[frame] for frame, solid in links if solid}

    def above(group: int) -> int:
        """The group with surfaces to which a group is joined, or -1."""
        parent = tree.joints[group].parent
        while parent >= 0 and rigid[parent] not in has_surfaces:
            parent = tree.joints[rigid[parent]].parent
        return rigid[parent] if parent >= 0 else -1

    pairs = []
    for (i, (a, solid_a)), (j, (b, solid_b)) in combinations(enumerate(links), 2):
        one, other = rigid[a], rigid[b]
        if solid_a and solid_b and (one == other or above(one) == other or above(other) == one):
            pairs.append((i, j))
    return pairs
