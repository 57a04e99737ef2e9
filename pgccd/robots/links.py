"""Which links of a robot are joined, and so not tested against each other."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product

from pgccd.robots.kinematics import Tree


def adjacent_links(tree: Tree, links: Sequence[tuple[int, bool]]) -> set[tuple[int, int]]:
    """Pairs (i, j), i < j, of links that are rigidly joined, or neighbours.

    From the last moving joint of a link the tree is followed upwards, over links without surfaces and through joints of
    any kind, to the first link with surfaces. That link is a neighbour of all links below the joint that are rigidly
    joined. If it is below a moving joint itself, the links that are rigidly joined to it are neighbours too. If it is
    fixed to the root, no other link that is fixed to the root is a neighbour.

    Args:
        links: the frame of each, and whether it has surfaces.
    """
    # The frame that each link is rigidly joined to: that of the last joint that moves, or the root.
    rigid: list[int] = []
    for joint in tree.joints:
        is_fixed = joint.kind == "fixed"
        rigid.append(rigid[joint.parent] if is_fixed and joint.parent >= 0 else len(rigid))
    at: dict[int, list[int]] = {}  # links with surfaces by frame
    groups: dict[int, list[int]] = {}  # and by rigid group
    for number, (frame, has_surfaces) in enumerate(links):
        if has_surfaces:
            at.setdefault(frame, []).append(number)
            groups.setdefault(rigid[frame], []).append(number)
    pairs: set[tuple[int, int]] = set()
    for group, members in groups.items():
        pairs.update(combinations(members, 2))
        above = tree.joints[group].parent
        while above >= 0 and above not in at:
            above = tree.joints[above].parent
        if above >= 0:
            is_fixed = rigid[above] == 0
            neighbours = at[above] if is_fixed else groups[rigid[above]]
            pairs.update((min(pair), max(pair)) for pair in product(members, neighbours))
    return pairs
