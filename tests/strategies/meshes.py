"""Triangle meshes: closed, open, non-manifold, disconnected; finite coordinates of order one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st


@dataclass(frozen=True)
class TriMesh:
    """vertices (v, 3) float64, faces (f, 3) int64; the three vertices of a face are distinct."""

    vertices: np.ndarray
    faces: np.ndarray


def _icosahedron() -> TriMesh:
    g = (1 + 5**0.5) / 2
    corners = [(-1.0, g, 0.0), (1.0, g, 0.0), (-1.0, -g, 0.0), (1.0, -g, 0.0)]
    corners = [(x[-k], x[1 - k], x[2 - k]) for k in range(3) for x in corners]
    vertices = np.array(corners, dtype=np.float64) / np.hypot(1, g)
    edge = np.linalg.norm(vertices[0] - vertices[1])
    near = np.linalg.norm(vertices[:, None] - vertices, axis=2) < 1.1 * edge
    faces = []
    for i in range(12):
        for j in range(i + 1, 12):
            for k in range(j + 1, 12):
                if near[i, j] and near[j, k] and near[i, k]:
                    outward = np.dot(np.cross(vertices[j] - vertices[i], vertices[k] - vertices[i]), vertices[i]) > 0
                    faces.append((i, j, k) if outward else (i, k, j))
    return TriMesh(vertices, np.array(faces, dtype=np.int64))


def _subdivided(mesh: TriMesh) -> TriMesh:
    vertices, middle, faces = list(mesh.vertices), {}, []

    def between(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in middle:
            point = vertices[a] + vertices[b]
            middle[key] = len(vertices)
            vertices.append(point / np.linalg.norm(point))
        return middle[key]

    for a, b, c in mesh.faces.tolist():
        ab, bc, ca = between(a, b), between(b, c), between(c, a)
        faces += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return TriMesh(np.array(vertices), np.array(faces, dtype=np.int64))


@st.composite
def bumpy_spheres(draw: st.DrawFn, most_subdivisions: int = 2) -> TriMesh:
    """Closed, genus 0: a subdivided icosahedron with waves on it; 20, 80, 320 ... faces."""
    mesh = _icosahedron()
    for _ in range(draw(st.integers(0, most_subdivisions))):
        mesh = _subdivided(mesh)
    height = draw(st.floats(0.0, 0.3))
    waves = np.array(draw(st.tuples(*[st.integers(-6, 6)] * 3)), dtype=np.float64)
    return TriMesh(mesh.vertices * (1.0 + height * np.sin(mesh.vertices @ waves))[:, None], mesh.faces)


_BOX_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_BOX_QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
_BOX_FACES = np.array([f for a, b, c, d in _BOX_QUADS for f in ((a, b, c), (a, c, d))], dtype=np.int64)


@st.composite
def boxes(draw: st.DrawFn) -> TriMesh:
    """Closed, 12 faces, sides from needle-thin to equal."""
    side = np.array([draw(st.floats(1e-3, 1.0)) for _ in range(3)])
    return TriMesh(_BOX_CORNERS * side, _BOX_FACES.copy())


@st.composite
def tetrahedra(draw: st.DrawFn) -> TriMesh:
    """Closed, four faces; on a coarse grid, so that flat ones and coincident corners occur."""
    grid = st.tuples(*[st.integers(-4, 4)] * 3)
    vertices = np.array([draw(grid) for _ in range(4)], dtype=np.float64) / 4.0
    return TriMesh(vertices, np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)], dtype=np.int64))


@st.composite
def flat_sheets(draw: st.DrawFn, most_cells: int = 6) -> TriMesh:
    """Open: a rectangle of cells in a plane, exactly flat or with small bumps."""
    nx, ny = draw(st.integers(1, most_cells)), draw(st.integers(1, most_cells))
    x, y = np.meshgrid(np.linspace(-1, 1, nx + 1), np.linspace(-1, 1, ny + 1), indexing="ij")
    z = draw(st.sampled_from([0.0, 1e-9, 0.1])) * np.sin(3 * x + 5 * y)
    index = np.arange((nx + 1) * (ny + 1)).reshape(nx + 1, ny + 1)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int64)
    return TriMesh(np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1), faces)


@st.composite
def soups(draw: st.DrawFn, most_faces: int = 24) -> TriMesh:
    """Triangles that share no vertices, or faces of random vertices."""
    count = draw(st.integers(1, most_faces))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    if draw(st.booleans()):
        return TriMesh(rng.uniform(-1, 1, (3 * count, 3)), np.arange(3 * count, dtype=np.int64).reshape(-1, 3))
    vertices = rng.uniform(-1, 1, (count + 3, 3))  # some in no face
    faces = np.stack([rng.permutation(len(vertices))[:3] for _ in range(count)]).astype(np.int64)
    return TriMesh(vertices, faces)


@st.composite
def with_holes(draw: st.DrawFn) -> TriMesh:
    """A closed mesh with some faces removed; all vertices stay."""
    mesh = draw(st.one_of(bumpy_spheres(1), boxes()))
    kept = draw(st.lists(st.booleans(), min_size=len(mesh.faces), max_size=len(mesh.faces)))
    faces = mesh.faces[np.array(kept)]
    return TriMesh(mesh.vertices, faces if len(faces) else mesh.faces[:1])


@st.composite
def non_manifold(draw: st.DrawFn) -> TriMesh:
    """Three or more faces on one edge, separate fans meeting in a vertex, or the same face twice."""
    blades = draw(st.integers(3, 7))
    angle = 2 * np.pi * np.arange(blades) / blades
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(blades)], axis=1)
    kind = draw(st.sampled_from(["edge", "vertex", "double"]))
    if kind == "vertex":
        other = 0.5 * ring + np.array([0.0, 0.0, 1.0])
        vertices = np.concatenate([np.zeros((1, 3)), ring, other])
        faces = [(0, 1 + k, 1 + (k + 1) % blades) for k in range(blades - 1)]
        faces += [(0, 1 + blades + k, 1 + blades + (k + 1) % blades) for k in range(blades - 1)]
    else:
        vertices = np.concatenate([[[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], ring])
        faces = [(0, 1, 2 + k) for k in range(blades)]
        if kind == "double":
            faces += [faces[0], faces[1][::-1]]
    return TriMesh(vertices, np.array(faces, dtype=np.int64))


@st.composite
def several_components(draw: st.DrawFn) -> TriMesh:
    """Two to four meshes merged into one, disjoint or interpenetrating."""
    parts = draw(st.lists(st.one_of(boxes(), tetrahedra(), bumpy_spheres(1)), min_size=2, max_size=4))
    vertices, faces, count = [], [], 0
    for part in parts:
        vertices.append(part.vertices + np.array(draw(st.tuples(*[st.integers(-2, 2)] * 3)), dtype=np.float64))
        faces.append(part.faces + count)
        count += len(part.vertices)
    return TriMesh(np.concatenate(vertices), np.concatenate(faces))


def meshes() -> st.SearchStrategy[TriMesh]:
    """Any of the above."""
    return st.one_of(
        tetrahedra(),
        boxes(),
        bumpy_spheres(),
        flat_sheets(),
        soups(),
        with_holes(),
        non_manifold(),
        several_components(),
    )


def extended_meshes() -> st.SearchStrategy[TriMesh]:
    """Those with vertices in more than one point; a mesh with all in one point raises its own error."""
    return meshes().filter(lambda shape: bool(np.ptp(shape.vertices[shape.faces].reshape(-1, 3), axis=0).any()))
