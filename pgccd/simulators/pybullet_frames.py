"""PyBullet: its collision shapes as bodies."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pgccd.geometry.mesh import Mesh
from pgccd.robots import shapes
from pgccd.robots.shapes import ThickSurface
from pgccd.simulators.bodies import Bodies
from pgccd.simulators.simulator import Simulator

# The margin by which PyBullet thickens hulls. PyBullet returns the margin of a placed hull only if the user has
# changed it.
_HULL = 1e-3


class PyBullet(Simulator):
    """The collision shapes of a PyBullet world, as the bodies of a scene.

    Shapes of one multibody are not tested against each other, which is PyBullet's default; its other filters are
    ignored. The shape of a body that has neither links nor mass is static. Meshes of files are taken as they are, in
    metres; PyBullet replaces them by their hulls. These meshes, and hulls of points, are thickened by their collision
    margin, as in PyBullet: by at least 0.001. Boxes have sharp edges here; PyBullet rounds them with a radius of its
    margin.

    Args:
        client: number of the physics server, as `pybullet.connect` returns it.
        device: of the scene and the frames.

    Attributes:
        scene: a `Scene` of N bodies.
        names: (N) of the links.
        links: (N) body and link of each, as PyBullet numbers them.

    Raises:
        ValueError: the surface of a shape is not known (it is named), such as triangles without a file or height
            fields, whose shape PyBullet does not tell; or there are no shapes.
        ImportError: pybullet is not installed; or scipy, if there are hulls of points.

    Example:
        >>> simulator = pgccd.simulators.PyBullet(client)
        >>> position, orientation = simulator.frame()
    """

    def __init__(self, client: int = 0, device: torch.device | str = "cpu") -> None:
        import pybullet

        self._bullet, self._client = pybullet, client
        self.links: list[tuple[int, int]] = []
        bodies, static = Bodies(), []
        exclude: list[tuple[int, int]] = []
        for index in range(pybullet.getNumBodies(physicsClientId=client)):
            body = pybullet.getBodyUniqueId(index, physicsClientId=client)
            names = [name.decode() for name in pybullet.getBodyInfo(body, physicsClientId=client)]
            joints = pybullet.getNumJoints(body, physicsClientId=client)
            mass = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)[0]
            first = len(self.links)
            for link in range(-1, joints):
                if link >= 0:
                    names[0] = pybullet.getJointInfo(body, link, physicsClientId=client)[12].decode()
                name = f"body {body}, {names[1] or 'multibody'}, {names[0] or f'link {link}'}"
                found = pybullet.getCollisionShapeData(body, link, physicsClientId=client)
                if not found and len(set(pybullet.getAABB(body, link, physicsClientId=client))) > 1:
                    raise ValueError(f"{name}: expected a shape that PyBullet returns, got one such as a height field")
                thickness = max(_HULL, pybullet.getDynamicsInfo(body, link, physicsClientId=client)[11])
                for number, shape in enumerate(found):
                    # Hulls of points, as PyBullet makes of cylinders in URDF files, have no file.
                    is_hull = shape[2] == pybullet.GEOM_MESH and shape[4] in (b"", b"unknown_file")
                    points = None
                    if is_hull:
                        points = pybullet.getMeshData(body, link, number, physicsClientId=client)[1]
                    bodies.add(
                        name,
                        (*shape[2:], points, thickness),
                        lambda shape=shape, points=points, thickness=thickness: _surface(  # type: ignore[misc]
                            pybullet, points, thickness, *shape[2:]
                        ),
                        (body, link),
                    )
                    self.links.append((body, link))
                    static.append(joints == 0 and mass == 0.0)
            exclude += combinations(range(first, len(self.links)), 2)
        self.names, self._bodies, self._device = bodies.names, bodies, device
        self.scene = bodies.scene(self._poses, device, np.array(exclude), np.array(static))

    def frame(self) -> tuple[Tensor, Tensor]:
        """Positions (N, 3) and orientations (N, 4) of the bodies now.

        Raises:
            ValueError: a body is beside the square in place of an infinite plane, naming both.
        """
        return self._bodies.checked(*self._poses())

    def _poses(self) -> tuple[Tensor, Tensor]:
        poses: dict[tuple[int, int], np.ndarray] = {}
        for body, link in self.links:
            if (body, link) not in poses:
                if link < 0:
                    pose = self._bullet.getBasePositionAndOrientation(body, physicsClientId=self._client)
                else:
                    pose = self._bullet.getLinkState(
                        body, link, computeForwardKinematics=1, physicsClientId=self._client
                    )[:2]
                poses[body, link] = np.concatenate(pose)
        rows = torch.from_numpy(np.array([poses[link] for link in self.links])).to(self._device)
        return rows[:, :3], torch.nn.functional.normalize(rows[:, [6, 3, 4, 5]], dim=1)


def _surface(
    bullet: Any,
    points: Any,
    thickness: float,
    kind: int,
    size: tuple[float, ...],
    file: bytes,
    at: tuple[float, ...],
    turn: tuple[float, ...],
) -> ThickSurface:
    """The surface of a shape in the frame of its link's centre of mass."""
    if kind == bullet.GEOM_BOX:
        made = shapes.box(np.array(size))
    elif kind == bullet.GEOM_SPHERE:
        made = shapes.sphere(size[0])
    elif kind == bullet.GEOM_CAPSULE:
        made = shapes.capsule(size[1], 0.5 * size[0])
    elif kind == bullet.GEOM_CYLINDER:
        made = shapes.cylinder(size[1], 0.5 * size[0])
    elif kind == bullet.GEOM_PLANE:
        made = shapes.infinite_plane(np.array(size) / np.linalg.norm(size))
    elif points:
        return _hull(np.array(points)).thickened(thickness)  # placed already
    elif kind == bullet.GEOM_MESH and points is None:
        made = shapes.of_file(Mesh.load(file.decode(), unit="m"), np.array(size)).thickened(thickness)
    else:
        raise ValueError(f"expected a box, sphere, capsule, cylinder, plane or mesh file, got PyBullet's kind {kind}")
    q = np.array(turn)[[3, 0, 1, 2]]
    return made.placed(np.array(at), q / np.linalg.norm(q))


def _hull(points: np.ndarray) -> ThickSurface:
    """The convex hull of points (n, 3)."""
    try:
        from scipy.spatial import ConvexHull
    except ImportError as error:
        raise ImportError(f"scipy makes convex hulls of points: pip install scipy ({error})") from error
    hull = ConvexHull(points)
    faces = hull.simplices.astype(np.int64)
    a, b, c = points[faces].transpose(1, 0, 2)
    inwards = np.einsum("fk,fk->f", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    return ThickSurface(points, faces)
