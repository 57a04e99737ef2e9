"""Random small scenes of every kind, each made from its own seed: for comparisons of all ways to find the contacts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

import pgccd
from support.origins import recentred
from support.shapes import bumpy, directions, height_field, tetrahedron, unit_quaternions

#: Arguments of `detect`, and the values that scenes choose from; lengths for bodies of radius 1 or more.
ARGUMENTS: dict[str, tuple[Any, ...]] = {
    "report": ("first", "all", "all", "any", "earliest"),
    "min_separation": (0.0, 0.0, 0.0, 0.25, 0.05, 0.01),
    "tolerance": (None, None, 1e-3),
    "nonzero_toi": (False, True),
    "initial": ("report", "report", "assume_free"),
}
LAYOUTS = ("crowd", "lattice", "resting", "pile", "sizes", "still")
KINDS = ("rigid", "rigid", "posed", "linear", "deforming", "deforming", "trajectory", "deforming trajectory")
_OFFSETS = (0.0, 0.0, 0.0, 0.0, 1e6, 1e9)
_SPINS = (0.0, 0.3, 0.3, 2.0, 40.0)
_MOST_BODIES = 14


@dataclass(frozen=True)
class RandomScene:
    """Bodies, their motion, and arguments of `detect`."""

    seed: int
    layout: str
    kind: str
    meshes: list[pgccd.Mesh]
    mesh_index: Tensor  #: (N,) int32
    filters: dict[str, Tensor]  #: optional columns of the scene
    poses: list[Tensor]  #: rows of bodies, or of vertices, along the last dimension but one
    arguments: dict[str, Any]
    exclude: Tensor | None  #: (E, 2) pairs of bodies that are never tested

    def scene(self, device: torch.device | str = "cpu") -> pgccd.Scene:
        return pgccd.Scene(self.meshes, self.mesh_index, device, **self.filters, exclude=self.exclude)

    def motion(self, device: torch.device | str = "cpu", bodies: Tensor | None = None) -> Any:
        """The motion of some of the bodies, or of all."""
        rows = slice(None) if bodies is None else self.rows_of(bodies)
        poses = [column[..., rows, :].to(device) for column in self.poses]
        if self.kind == "deforming":
            return pgccd.VertexMotion(*poses)
        if self.kind == "posed":
            return pgccd.RigidMotion(*poses)
        if self.kind in ("rigid", "linear"):
            return pgccd.RigidMotion.from_velocity(*poses, dt=0.7, path=self.kind)  # type: ignore[arg-type]
        return pgccd.Trajectory(*poses)

    def position(self) -> Tensor:
        """(N, 3): where the bodies are at the beginning."""
        first = self.poses[0].reshape(-1, *self.poses[0].shape[-2:])[0]
        return first[self._begins()] if self.kind.startswith("deforming") else first

    def __str__(self) -> str:
        filters = "".join(f", {name}" for name in self.filters)
        filters += "" if self.exclude is None else f", {len(self.exclude)} excluded pairs"
        filters += ", solids" if any(mesh.solid for mesh in self.meshes) else ""
        filters += ", points" if any(mesh.point_count for mesh in self.meshes) else ""
        filters += ", segments" if any(mesh.segment_count for mesh in self.meshes) else ""
        filters += ", thick" if any(mesh.thickness for mesh in self.meshes) else ""
        arguments = ", ".join(f"{name}={value!r}" for name, value in self.arguments.items())
        return f"seed {self.seed}: {len(self.mesh_index)} bodies, {self.layout}, {self.kind}{filters}; {arguments}"

    def _counts(self) -> Tensor:
        return torch.tensor([len(self.meshes[k].vertices) for k in self.mesh_index.tolist()])

    def _begins(self) -> Tensor:
        counts = self._counts()
        return counts.cumsum(0) - counts

    def rows_of(self, bodies: Tensor) -> Tensor:
        """The rows of the motion that are of these bodies."""
        if not self.kind.startswith("deforming"):
            return bodies
        begins, counts = self._begins().tolist(), self._counts().tolist()
        parts = [torch.arange(begins[k], begins[k] + counts[k]) for k in bodies.tolist()]
        return torch.cat([torch.zeros(0, dtype=torch.int64), *parts])


def random_scene(seed: int) -> RandomScene:
    """The scene of this seed."""
    rng = np.random.default_rng(seed)
    layout, kind = str(rng.choice(LAYOUTS)), str(rng.choice(KINDS))
    on_lattice = layout in ("lattice", "resting")
    count = int(rng.integers(1 if kind == "deforming" else 2, _MOST_BODIES))
    meshes = [_cube(rng) for _ in range(2)] if on_lattice else [_mesh(rng, layout) for _ in range(3)]
    meshes = some_solids(np.random.default_rng([seed, 3]), meshes)
    meshes = some_elements(np.random.default_rng([seed, 4]), meshes, 0.25 if on_lattice else None)
    mesh_index = rng.integers(len(meshes), size=count)
    sizes = np.array([meshes[k].radius + meshes[k].thickness for k in mesh_index])
    steps = int(rng.integers(2, 4)) if "trajectory" in kind else 1
    place, velocity = _places(rng, layout, sizes, steps)
    unit = min(
        1.0, 2.0 ** float(np.floor(np.log2(sizes.min())))
    )  # so that not all features of the smallest body are close
    filters = filters_of(rng, count, kind, unit)
    if "static" in filters:
        velocity[:, filters["static"].numpy()] = 0.0
    still = np.abs(velocity).sum(axis=(0, 2)) == 0.0
    spin = np.where(still[:, None], 0.0, rng.choice(_SPINS) * directions(rng, count))
    if on_lattice:
        spin[:] = 0.0
        orientation = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    else:
        orientation = unit_quaternions(rng, count)
    offset = rng.choice(_OFFSETS) * np.array([1.0, -0.5, 0.25])
    start = place + offset
    if kind in ("rigid", "linear"):
        poses = [start, orientation, velocity[0], spin]
    elif kind == "posed":
        turned = orientation if on_lattice else np.where(still[:, None], orientation, unit_quaternions(rng, count))
        poses = [start, orientation, start + velocity[0], turned]
    elif kind == "trajectory":
        path = np.concatenate([start[None], start + np.cumsum(velocity, axis=0)])
        turned = np.stack([np.where(still[:, None], orientation, unit_quaternions(rng, count)) for _ in path])
        poses = [path, np.tile(orientation, (len(path), 1, 1)) if on_lattice else turned]
    else:
        poses = deformed(rng, [meshes[k] for k in mesh_index], start, velocity, still, 0.0 if on_lattice else 0.2)
        if kind == "deforming":
            poses = [poses[0][0], poses[0][1]]
    arguments = {name: values[rng.integers(len(values))] for name, values in ARGUMENTS.items()}
    for name in ("min_separation", "tolerance"):
        arguments[name] = arguments[name] and float(unit * arguments[name])
    return RandomScene(
        seed,
        layout,
        kind,
        meshes,
        torch.tensor(mesh_index, dtype=torch.int32),
        filters,
        [torch.tensor(column) for column in poses],
        arguments,
        excluded(np.random.default_rng([seed, 2]), count),
    )


def some_solids(rng: np.random.Generator, meshes: list[pgccd.Mesh]) -> list[pgccd.Mesh]:
    """In half of the scenes some of the closed meshes are solids, the first one larger, so that others are inside."""
    if rng.integers(2):
        return meshes
    larger = pgccd.Mesh(5.0 * meshes[0].vertices.numpy(), meshes[0].faces)
    return [mesh.as_solid("auto") if rng.uniform() < 0.7 else mesh for mesh in [larger, *meshes[1:]]]


def some_elements(rng: np.random.Generator, meshes: list[pgccd.Mesh], step: float | None) -> list[pgccd.Mesh]:
    """In half of the scenes some of the meshes are thick, or have points and segments, with the vertices of the mesh;
    coordinates and thickness are multiples of `step`.
    """
    if rng.integers(2):
        return meshes
    return [_elements(rng, mesh, step) if rng.uniform() < 0.6 else mesh for mesh in meshes]


def _elements(rng: np.random.Generator, mesh: pgccd.Mesh, step: float | None) -> pgccd.Mesh:
    thickness = float(rng.choice([0.0, 0.125, 0.25, 0.5]))
    if step is None:
        thickness *= rng.uniform(0.1, 1.0) * mesh.radius
    x, edges, faces = mesh.vertices.numpy(), mesh.edges.numpy(), mesh.faces.numpy()
    kind = rng.integers(6)
    if kind == 0:
        return mesh.thickened(thickness)
    if kind == 1:
        return pgccd.Mesh.points(x, thickness)
    if kind == 2:
        return pgccd.Mesh.segments(
            x, edges[rng.uniform(size=len(edges)) < 0.5] if len(edges) > 20 else edges, thickness
        )
    if kind == 3:
        return pgccd.Mesh.sphere(step or mesh.radius).thickened(thickness or 2 * (step or mesh.radius))
    if kind == 4:
        return pgccd.Mesh.segments(x[edges[0]], [[0, 1]], thickness)
    kept = faces[: 1 + len(faces) // 2]
    loose = np.setdiff1d(np.arange(len(x)), kept)
    return pgccd.Mesh(x, kept, segments=edges[:: 1 + len(edges) // 4], points=loose, thickness=thickness)


def excluded(rng: np.random.Generator, count: int) -> Tensor | None:
    """Some pairs of bodies in any order, some of them twice; for a third of the scenes."""
    if rng.integers(3):
        return None
    pairs = np.array([(i, j) for i in range(count) for j in range(count) if i != j]).reshape(-1, 2)
    pairs = rng.permutation(pairs[rng.uniform(size=len(pairs)) < rng.choice([0.0, 0.1, 0.3, 1.0])])
    return torch.tensor(pairs)


def _mesh(rng: np.random.Generator, layout: str) -> pgccd.Mesh:
    size = 10.0 ** rng.uniform(-3.0, 1.0) if layout == "sizes" else rng.uniform(0.5, 1.0)
    made = [
        lambda: bumpy(rng, 0, size=size),
        lambda: bumpy(rng, 1, size=size),
        lambda: tetrahedron(size),
        lambda: pgccd.Mesh(size * np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), [[0, 1, 2], [0, 2, 3]]),
        lambda: height_field(rng, 3, 2),
        lambda: _needle(rng, size),
    ][rng.integers(6)]()
    if rng.integers(3) == 0:
        return recentred(made, 4.0 * made.radius * directions(rng, 1)[0])
    return made


def _needle(rng: np.random.Generator, size: float) -> pgccd.Mesh:
    """A long mesh, whose edges are nearly parallel."""
    whole = bumpy(rng, 1, size=size)
    return pgccd.Mesh(whole.vertices.numpy() * [3.0, 0.03, 0.03], whole.faces)


def _cube(rng: np.random.Generator) -> pgccd.Mesh:
    """A box with corners at multiples of a quarter."""
    corners = np.array(list(np.ndindex(2, 2, 2))) * rng.choice([0.5, 1.0, 1.0, 2.0], 3)
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]]
    return pgccd.Mesh(corners, [*faces, [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])


def _places(rng: np.random.Generator, layout: str, sizes: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 3) and displacements (steps, N, 3)."""
    count = len(sizes)
    if layout in ("lattice", "resting"):
        side = int(np.ceil(count ** (1 / 3)))
        cells = rng.permutation(side**3)[:count]
        place = np.stack(np.unravel_index(cells, (side,) * 3), axis=1).astype(float)
        if layout == "lattice":
            place += 0.25 * rng.integers(-1, 2, place.shape)
        velocity = 0.25 * rng.integers(-4, 5, (steps, count, 3))
        return place, velocity * (rng.uniform(size=(1, count, 1)) < 0.5)
    # Of a unit of volume, bodies of radius 1 in a pile fill about all, in others a tenth.
    side = (count * np.median(sizes) ** 3 * (2.0 if layout == "pile" else 12.0)) ** (1 / 3)
    place = side * rng.uniform(-0.5, 0.5, (count, 3))
    velocity = rng.choice([0.1, 1.0, 5.0]) * np.minimum(sizes, 1.0)[:, None] * rng.normal(size=(steps, count, 3))
    if layout == "still":
        velocity *= rng.uniform(size=(1, count, 1)) < 0.3
    return place, velocity


def filters_of(rng: np.random.Generator, count: int, kind: str, unit: float) -> dict[str, Tensor]:
    def wanted(share: float) -> bool:
        return bool(rng.uniform() < share)

    filters: dict[str, Tensor] = {}
    if wanted(0.2):
        filters["group"] = torch.tensor(rng.integers(1, 8, count))
        filters["mask"] = torch.tensor(rng.integers(1, 8, count))
    if wanted(0.2):
        filters["world"] = torch.tensor(rng.integers(0, 2, count), dtype=torch.int32)
    if wanted(0.2):
        filters["static"] = torch.tensor(rng.uniform(size=count) < 0.3)
    if wanted(0.3):
        filters["margin"] = torch.tensor(unit * rng.choice([0.0, 0.125, 0.03], count))
    if kind.startswith("deforming") and wanted(0.6):
        filters["self_collision"] = torch.tensor(rng.uniform(size=count) < 0.7)
    return filters


def deformed(
    rng: np.random.Generator,
    meshes: list[pgccd.Mesh],
    start: np.ndarray,
    velocity: np.ndarray,
    still: np.ndarray,
    crumple: float,
) -> list[np.ndarray]:
    """[(T, X, 3)]: vertices at the waypoints, about their moving bodies."""
    crumple *= rng.uniform()
    frames = []
    for step in range(len(velocity) + 1):
        centre = start + velocity[:step].sum(axis=0)
        frames.append([m.vertices.numpy() + x for m, x in zip(meshes, centre, strict=True)])
    for body, mesh in enumerate(meshes):
        noise = crumple * mesh.radius * rng.normal(size=(len(frames), len(mesh.vertices), 3))
        for step, frame in enumerate(frames):
            frame[body] = frame[body] + noise[0 if still[body] else step]
    return [np.stack([np.concatenate(frame) for frame in frames])]
