"""From pairs of triangles whose boxes overlap to candidate feature pairs of body pairs."""

import torch
from torch import Tensor

from pgccd.contacts.kinds import Kind
from pgccd.search.bodies import MovingBodies

# Columns of a row of `MeshSet` triangles: core/mesh_set.h.
_VERTEX, _EDGE, _FACE, _REPRESENTED = slice(0, 3), slice(3, 6), 6, 7


def feature_candidates(bodies: MovingBodies, triangle_pairs: Tensor, tests_start: bool) -> tuple[Tensor, Tensor]:
    """Body pairs (P, 2) int64, ascending, and candidates (C, 4) int32 as from `pgccd.traverse.find_candidates`.

    Every vertex and edge is represented by one triangle of its mesh (Curtis, Tamstorf & Manocha 2008), so the two
    representing triangles list a feature pair exactly once.

    Args:
        bodies: the moving bodies.
        triangle_pairs: (K, 4) int64: body i, triangle of i, body j, triangle of j; i < j; unique rows.
        tests_start: whether edges and faces are listed, which may pass through one another at t = 0.
    """
    body_i, triangle_i, body_j, triangle_j = triangle_pairs.unbind(dim=1)
    count = bodies.scene.body_count
    keys, row = torch.unique(body_i * count + body_j, return_inverse=True)
    pairs = torch.stack([keys // count, keys % count], dim=1) if count else triangle_pairs[:, :2]
    of_i, of_j = (_rows(bodies, *side) for side in ((body_i, triangle_i), (body_j, triangle_j)))
    bits = torch.arange(6)
    represents_i, represents_j = ((rows[:, _REPRESENTED, None] >> bits & 1).bool() for rows in (of_i, of_j))
    vertices_i, edges_i = represents_i[:, :3], represents_i[:, 3:]
    vertices_j, edges_j = represents_j[:, :3], represents_j[:, 3:]

    def listed(kind: int, pair: Tensor, feature_i: Tensor, feature_j: Tensor) -> Tensor:
        return torch.stack([row[pair].int(), torch.full_like(feature_i, kind), feature_i, feature_j], dim=1)

    pair, corner = vertices_i.nonzero(as_tuple=True)
    vertex_face = listed(Kind.VF_AB, pair, of_i[:, _VERTEX][pair, corner], of_j[pair, _FACE])
    pair, corner = vertices_j.nonzero(as_tuple=True)
    face_vertex = listed(Kind.VF_BA, pair, of_i[pair, _FACE], of_j[:, _VERTEX][pair, corner])
    pair, first, second = (edges_i[:, :, None] & edges_j[:, None, :]).nonzero(as_tuple=True)
    edge_edge = listed(Kind.EE, pair, of_i[:, _EDGE][pair, first], of_j[:, _EDGE][pair, second])
    candidates = [vertex_face, face_vertex, edge_edge]
    if tests_start:
        pair, edge = edges_i.nonzero(as_tuple=True)
        candidates.append(listed(Kind.EF_AB, pair, of_i[:, _EDGE][pair, edge], of_j[pair, _FACE]))
        pair, edge = edges_j.nonzero(as_tuple=True)
        candidates.append(listed(Kind.EF_BA, pair, of_i[pair, _FACE], of_j[:, _EDGE][pair, edge]))
    return pairs, torch.cat(candidates)


def _rows(bodies: MovingBodies, body: Tensor, triangle: Tensor) -> Tensor:
    """(K, 8) int32 triangle rows of the bodies' meshes."""
    triangles, offsets = bodies.mesh_set[3], bodies.mesh_set[8]
    return triangles[offsets[bodies.scene.mesh_index[body].long(), 1] + triangle]
