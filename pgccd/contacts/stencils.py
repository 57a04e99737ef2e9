"""Contacts as weighted sums of vertices."""

from __future__ import annotations

import torch
from torch import Tensor

from pgccd.contacts.kinds import Kind
from pgccd.geometry.scene import Scene


def stencils_of(
    scene: Scene, pairs: Tensor, kind: Tensor, features: Tensor, coordinates: Tensor
) -> tuple[Tensor, Tensor]:
    """Vertices (K, 4) int64, rows of the scene's vertices, and their weights (K, 4); rows without a stencil are 0."""
    faces, edges, offsets = (scene.meshes.tensors[k] for k in (1, 2, 8))
    bodies, rows = pairs.clamp(min=0), features.long().clamp(min=0)
    mesh, begin = scene.mesh_index.long()[bodies], scene.layout.vertex_begin[bodies]  # (K, 2)
    face_rows, edge_rows = offsets[mesh, 1] + rows, offsets[mesh, 2] + rows
    corners = _rows_of(faces, face_rows) + begin[..., None]  # (K, 2, 3)
    ends = _rows_of(edges, edge_rows) + begin[..., None]  # (K, 2, 2)
    vertex = (begin + rows)[..., None]  # (K, 2, 1)
    u, v = coordinates.unbind(1)
    on_face, one = torch.stack([1.0 - u - v, u, v], dim=1), torch.ones_like(u)[:, None]
    vertices = [
        torch.cat([vertex[:, 0], corners[:, 1]], dim=1),
        torch.cat([vertex[:, 1], corners[:, 0]], dim=1),
        torch.cat([ends[:, 0], ends[:, 1]], dim=1),
    ]
    weights = [
        torch.cat([-one, on_face], dim=1),
        torch.cat([one, -on_face], dim=1),
        torch.stack([u - 1.0, -u, 1.0 - v, v], dim=1),
    ]
    chosen_vertices, chosen_weights = torch.zeros_like(vertices[0]), torch.zeros_like(weights[0])
    for each, of_vertices, of_weights in zip((Kind.VF_AB, Kind.VF_BA, Kind.EE), vertices, weights, strict=True):
        is_kind = ((kind == each) & (pairs[:, 0] >= 0))[:, None]
        chosen_vertices = torch.where(is_kind, of_vertices, chosen_vertices)
        chosen_weights = torch.where(is_kind, of_weights, chosen_weights)
    return chosen_vertices, chosen_weights


def _rows_of(table: Tensor, rows: Tensor) -> Tensor:
    """Rows (K, 2) of a table (R, C): (K, 2, C). Rows of another kind of feature may lie beyond it."""
    if len(table) == 0:
        return table.new_zeros((*rows.shape, table.shape[1]), dtype=torch.int64)
    return table.long()[rows.clamp(max=len(table) - 1)]
