"""Which faces and edges of meshes meet."""

import numpy as np
import torch
from torch import Tensor


def incidence(vertices: Tensor, faces: Tensor, edges: Tensor, offsets: Tensor) -> tuple[list[Tensor], int]:
    """The operators' arguments `incidence` and `most`, from the first tensors of a `MeshSet` and its offsets, all on
    the CPU. Indices are rows of its concatenated tensors; items of lists ascend.

    Returns:
        face_edges (F, 3) int64, edges of each face, from its first corner to the second, and so on, any edge between
        equal corners; int64 lists, as begin (n + 1,) and items, of the faces of vertices, the edges of vertices, and
        the faces of edges (segments and points count their vertices and edge once); outward (meshes,) float64, 1 if the
        normals by the order of the corners point out of a closed mesh, -1 if they point into it, 0 if the mesh is open
        or its faces are not all wound alike. And the longest list of a vertex or edge.
    """
    counts = offsets[1:] - offsets[:-1]
    first_vertex = offsets[:-1, 0]
    mesh_of_face = torch.repeat_interleave(counts[:, 1])
    mesh_of_edge = torch.repeat_interleave(counts[:, 2])
    faces = faces.long() + first_vertex[mesh_of_face][:, None]
    edges = edges.long() + first_vertex[mesh_of_edge][:, None]
    total = len(vertices)
    ends = faces.roll(-1, 1)
    low, high = torch.minimum(faces, ends), torch.maximum(faces, ends)
    face_edges = torch.searchsorted(edges[:, 0] * total + edges[:, 1], low * total + high)
    face_edges = face_edges.clamp(max=max(len(edges) - 1, 0))
    each_face = torch.arange(len(faces))[:, None].expand(-1, 3)
    each_edge = torch.arange(len(edges)).repeat_interleave(2)
    # The corners of a segment or a point, and the edge of a segment, count once.
    differs = low < high
    is_corner = torch.stack([torch.ones_like(differs[:, 0]), differs[:, 0], differs[:, 1]], 1)
    is_edge = torch.stack([differs[:, 0], differs[:, 1], differs[:, 1]], 1)
    lists = [
        _lists(faces[is_corner], each_face[is_corner], total, 3 * len(faces)),
        _lists(edges.reshape(-1), each_edge, total, 2 * len(edges)),
        _lists(face_edges[is_edge], each_face[is_edge], len(edges), 3 * len(faces)),
    ]

    # Closed and wound alike: two faces at each edge, one along it, one against it.
    along = torch.where(faces < ends, 1, -1)
    balance = torch.zeros(len(edges), dtype=torch.int64).index_add(0, face_edges[is_edge], along[is_edge])
    is_solid = (lists[2][0].diff() == 2) & (balance == 0)
    open_edges = torch.zeros(len(counts), dtype=torch.int64).index_add(0, mesh_of_edge, (~is_solid).long())
    corners = vertices[faces] - vertices[first_vertex[mesh_of_face]][:, None]
    # NumPy adds in order, on any number of threads.
    a, b, c = corners.numpy().swapaxes(0, 1)
    volumes = np.bincount(mesh_of_face.numpy(), (a * np.cross(b, c)).sum(1), minlength=len(counts))
    outward = torch.where(open_edges == 0, torch.from_numpy(np.sign(volumes)), 0.0)
    most = max(int(begin.diff().amax()) for begin, _ in lists if len(begin) > 1)
    return [face_edges, *(column for columns in lists for column in columns), outward], most


def _lists(owner: Tensor, items: Tensor, count: int, size: int) -> tuple[Tensor, Tensor]:
    """The lists of `count` owners, from the owner (m,) of each item (m,), padded with zeros to `size` items."""
    ordered, order = torch.sort(owner, stable=True)
    begin = torch.searchsorted(ordered, torch.arange(count + 1))
    return begin, torch.nn.functional.pad(items[order], (0, size - len(items)))
