"""Newton: its shapes as bodies; frames from Warp arrays."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pgccd.robots import shapes
from pgccd.robots.shapes import ThickSurface
from pgccd.simulators.bodies import Bodies
from pgccd.simulators.simulator import Simulator


class Newton(Simulator):
    """The shapes of a Newton model that may collide, as the bodies of a scene on the device of the model.

    Shapes are tested against the shapes of their world; a shape that belongs to no world has a body in each world.
    Shapes of one body, and the model's `shape_collision_filter_pairs`, are not tested; collision groups are ignored.
    Shapes that belong to no body are static. Shapes are thickened by their `shape_margin`. Planes with width and length
    are rectangles; in Newton, other shapes can touch such a plane also a little beside it.

    Args:
        model: a `newton.Model`.

    Attributes:
        scene: a `Scene` of N bodies.
        names: (N) labels of the shapes.
        shapes: (N,) int64 array, the shape of each body.

    Raises:
        ValueError: the surface of a shape is not known here, such as a cone (it is named); or no shape may collide.
        ImportError: newton or warp is not installed.
    """

    def __init__(self, model: Any) -> None:
        import newton
        import warp

        self._to_torch = warp.to_torch
        owner, world = model.shape_body.numpy(), model.shape_world.numpy()
        flags = model.shape_flags.numpy() & int(newton.ShapeFlags.COLLIDE_SHAPES)
        columns = tuple(
            column.numpy()
            for column in (model.shape_type, model.shape_scale, model.shape_transform, model.shape_margin)
        )
        worlds = np.unique(world[world >= 0]).tolist() or [0]
        rows = [(k, w) for w in worlds for k in np.flatnonzero(flags).tolist() if world[k] in (-1, w)]
        bodies = Bodies()
        for k, _ in rows:
            kind, scale, transform, margin = (column[k] for column in columns)
            source, placed = model.shape_source[k], transform.astype(np.float64)
            key = (int(kind), scale.tobytes(), transform.tobytes(), float(margin), id(source))
            bodies.add(
                str(model.shape_label[k]),
                key,
                lambda kind=kind, scale=scale, source=source, placed=placed, margin=margin: (  # type: ignore[misc]
                    _surface(newton.GeoType(int(kind)).name, scale.astype(np.float64), source)
                    .placed(placed[:3], _wxyz(placed[3:]))
                    .thickened(float(margin))
                ),
                int(owner[k]),
            )
        self.names, self._bodies = bodies.names, bodies
        self.shapes = np.array([k for k, _ in rows])
        place = {row: number for number, row in enumerate(rows)}
        filtered = {(int(a), int(b)) for a, b in model.shape_collision_filter_pairs}
        for own in (np.flatnonzero(owner == body).tolist() for body in range(model.body_count)):
            filtered |= set(combinations(own, 2))
        pairs = [(place.get((a, w)), place.get((b, w))) for a, b in filtered for w in worlds]
        exclude = [(i, j) for i, j in pairs if i is not None and j is not None]
        device = torch.device(str(model.device))
        # A body after the last one, for shapes that belong to no body.
        body = np.where(owner[self.shapes] < 0, model.body_count, owner[self.shapes])
        self._body = torch.from_numpy(body.astype(np.int64)).to(device)
        of_world = torch.tensor([w for _, w in rows], device=device)
        static = owner[self.shapes] < 0
        self.scene = bodies.scene(lambda: self._poses(model), device, np.array(exclude), static, world=of_world)

    def frame(self, state: Any) -> tuple[Tensor, Tensor]:
        """Positions (N, 3) and orientations (N, 4) of the bodies now, float32, from a view of the state's memory.
        If there are infinite planes, synchronises with a GPU.

        Args:
            state: the `newton.State`.

        Raises:
            ValueError: a body is beside the square in place of an infinite plane, naming both.
        """
        return self._bodies.checked(*self._poses(state))

    def _poses(self, state: Any) -> tuple[Tensor, Tensor]:
        poses = self._to_torch(state.body_q)  # (bodies, 7): position, and orientation (x, y, z, w)
        fixed = poses.new_tensor([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
        poses = torch.cat([poses, fixed])[self._body]
        return poses[:, :3], torch.nn.functional.normalize(poses[:, [6, 3, 4, 5]], dim=1)


def _wxyz(xyzw: np.ndarray) -> np.ndarray:
    q = xyzw[[3, 0, 1, 2]]
    return q / np.linalg.norm(q)


def _surface(kind: str, scale: np.ndarray, source: Any) -> ThickSurface:
    """The surface of a shape in its frame."""
    if kind == "BOX":
        return shapes.box(2.0 * scale)
    if kind == "SPHERE":
        return shapes.sphere(float(scale[0]))
    if kind == "CAPSULE":
        return shapes.capsule(float(scale[0]), float(scale[1]))
    if kind == "CYLINDER":
        return shapes.cylinder(float(scale[0]), float(scale[1]))
    if kind == "ELLIPSOID":
        return shapes.ellipsoid(scale)
    if kind == "PLANE":
        if not scale[:2].any():
            return shapes.infinite_plane()
        if not scale[:2].all():
            raise ValueError(f"expected a plane with width and length or with neither, got {scale[:2].tolist()}")
        return shapes.rectangle(0.5 * float(scale[0]), 0.5 * float(scale[1]))
    if kind in ("MESH", "CONVEX_MESH"):
        faces = np.asarray(source.indices, dtype=np.int64).reshape(-1, 3)
        return ThickSurface(np.asarray(source.vertices, dtype=np.float64), faces).scaled(scale)
    raise ValueError(f"expected a shape of known surface, got {kind.lower()}")
