"""Hierarchies of meshes, as the operators take them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from torch import Tensor

import pgccd

WIDTH = 8


class Hierarchy(NamedTuple):
    """Of one mesh."""

    triangles: Tensor  #: (F, 8)
    blocks: Tensor  #: (n, 4, 8)
    links: Tensor  #: (n, 8, 4): the first child's block, or the first triangle and their number; rows of leaf points
    leaf_points: Tensor
    supports: Tensor

    @staticmethod
    def of(mesh: pgccd.Mesh) -> Hierarchy:
        """Of a set of this mesh only."""
        tensors = pgccd.MeshSet([mesh]).tensors
        return Hierarchy(*tensors[3:7], tensors[11])


def prepared(mesh: pgccd.Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles (F, 8), node blocks (n, 4, 8) and links (n, 8, 2), as the operators take them."""
    triangles, blocks, links, *_ = Hierarchy.of(mesh)
    return triangles.numpy(), blocks.numpy(), links.numpy()


def walk(links: np.ndarray) -> tuple[list[tuple[int, int, int]], int]:
    """(node, first triangle, triangle count) of every node, unordered, and the depth."""
    found, deepest = [], 0

    def visit(node: int, depth: int) -> tuple[int, int]:
        nonlocal deepest
        deepest = max(deepest, depth)
        first, count = links[node // WIDTH, node % WIDTH, :2].tolist()
        if count == 0:
            below = [
                visit(first * WIDTH + slot, depth + 1)
                for slot in range(WIDTH)
                if links[first, slot, 1] >= 0  # otherwise an empty slot
            ]
            assert first > node // WIDTH and below, "blocks of parents precede those of their children"
            first, count = min(b[0] for b in below), sum(b[1] for b in below)
        found.append((node, first, count))
        return first, count

    visit(0, 1)
    return found, deepest


def assert_encloses(blocks: np.ndarray, links: np.ndarray, triangles: np.ndarray, x: np.ndarray) -> None:
    """Asserts that each node's volume encloses its triangles' vertices, exactly up to this test's rounding."""
    for node, first, count in walk(links)[0]:
        volume = blocks[node // WIDTH, :, node % WIDTH].astype(np.longdouble)
        arms = x[triangles[first : first + count, :3]].reshape(-1, 3).astype(np.longdouble) - volume[:3]
        assert np.sqrt((arms**2).sum(axis=1)).max() <= volume[3] * np.longdouble(1 + 1e-17)
        if len(volume) > 4:  # also a slab about the same centre
            along = arms @ volume[4:7]
            assert along.min() >= volume[7] and along.max() <= volume[8]
