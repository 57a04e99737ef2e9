"""A view in the browser that a running program updates, by viser."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from pgccd import arguments
from pgccd.arguments import real_rows
from pgccd.contacts.contacts import ContactColumns, PairColumns
from pgccd.geometry.scene import Scene
from pgccd.viz.shapes import drawn

_GREY, _COLLIDING = (133, 158, 189), (245, 102, 31)
# Length of the normals that are drawn, in radii of the smallest mesh as it is drawn.
_NORMAL_LENGTH = 0.5


class Live:
    """A view of a scene at an address, which `update` changes; made by `pgccd.viz.live`.

    Attributes:
        address: of the view, for a browser.
        server: the `viser.ViserServer`, for controls of your own, and for recordings (`get_scene_serializer`).
    """

    def __init__(self, scene: Scene, server: Any) -> None:
        self._scene, self.server = scene, server
        self.address = f"http://{server.get_host()}:{server.get_port()}"
        self._index = scene.mesh_index.cpu().numpy()
        self._shapes = [drawn(mesh) for mesh in scene.meshes.meshes]
        self._length = _NORMAL_LENGTH * min(shape.radius for shape in self._shapes)
        self._handles: dict[str, Any] = {}

    def update(self, position: Tensor, orientation: Tensor | None = None, hits: PairColumns | None = None) -> None:
        """Shows the bodies at one time, colliding ones in orange, with the points and normals of contacts.

        Args:
            position: (N, 3) of the meshes' origins, world frame, scene length units; or, without `orientation`, the
                vertices (X, 3) of deforming bodies, in the order of `VertexMotion`.
            orientation: (N, 4) unit quaternions (w, x, y, z), body to world.
            hits: contacts to show. Default: none.

        Raises:
            TypeError, ValueError: naming the argument.
        """
        count = self._scene.body_count
        rows = self._scene.layout.vertex_count if orientation is None else count
        place = real_rows(position, "position", rows, 3, None)
        if hits is not None and not isinstance(hits, PairColumns):
            raise TypeError(f"hits: expected the result of `pgccd.detect`, got {arguments.describe(hits)}")
        if not self._handles and rows:
            self._look_at(place.cpu().numpy())
        colours = np.tile(np.array(_GREY, dtype=np.uint8), (count, 1))
        if hits is not None:
            pairs = hits.pairs[hits.pairs[:, 0] >= 0].cpu()
            if len(pairs) and int(pairs.max()) >= count:
                raise ValueError(f"hits: has a contact of body {int(pairs.max())}, but the scene has {count} bodies")
            colours[pairs.flatten().numpy()] = _COLLIDING
        if orientation is None:
            with self.server.atomic():
                self._show_vertices(place.cpu().numpy(), colours)
                self._show_contacts(hits)
            return
        turn = real_rows(orientation, "orientation", count, 4, place.device).cpu().numpy()
        with self.server.atomic():
            for mesh, shape in enumerate(self._shapes):
                members = self._index == mesh
                if not members.any():
                    continue
                columns = {"batched_positions": place.cpu().numpy()[members], "batched_wxyzs": turn[members]}
                columns["batched_colors"] = colours[members]
                name = f"/mesh {mesh}"
                if name not in self._handles:
                    add = self.server.scene.add_batched_meshes_simple
                    style: dict[str, Any] = {"flat_shading": True, "side": "double"}
                    self._handles[name] = add(name, shape.vertices, shape.faces, **style, **columns)
                for column, values in columns.items():
                    setattr(self._handles[name], column, values)
            self._show_contacts(hits)

    def _look_at(self, points: np.ndarray) -> None:
        """Sets where browsers that connect from now on look from: all bodies are in sight."""
        reach = max(shape.reach for shape in self._shapes)
        lower, upper = points.min(axis=0) - reach, points.max(axis=0) + reach
        centre, size = 0.5 * (lower + upper), float(np.linalg.norm(upper - lower))
        camera = self.server.initial_camera
        camera.look_at, camera.position = centre, centre + 1.1 * size * np.array([0.5, -0.75, 0.45])
        camera.near, camera.far = 1e-3 * size, 20.0 * size

    def _show_vertices(self, position: np.ndarray, colours: np.ndarray) -> None:
        begin = self._scene.layout.vertex_begin.tolist()
        for body, mesh in enumerate(self._index.tolist()):
            shape, name = self._shapes[mesh], f"/body {body}"
            own = position[begin[body] : begin[body] + shape.vertex_count]
            vertices, colour = shape.moved(own[None])[0], tuple(colours[body].tolist())
            if name not in self._handles:
                add, faces = self.server.scene.add_mesh_simple, shape.faces
                self._handles[name] = add(name, vertices, faces, color=colour, flat_shading=True, side="double")
            self._handles[name].vertices, self._handles[name].color = vertices, colour

    def _show_contacts(self, hits: PairColumns | None) -> None:
        points = normals = np.zeros((0, 3))
        if isinstance(hits, ContactColumns):
            is_row = hits.pairs[:, 0] >= 0
            points, normals = (column[is_row].nan_to_num().cpu().numpy() for column in (hits.point, hits.normal))
        for name in ("/points", "/normals"):
            if name in self._handles:
                self._handles.pop(name).remove()
        if len(points):
            ends = np.stack([points, points + self._length * normals], axis=1)
            scene, size = self.server.scene, 0.2 * self._length
            self._handles["/points"] = scene.add_point_cloud("/points", points, (20, 20, 20), point_size=size)
            add = scene.add_line_segments
            self._handles["/normals"] = add("/normals", ends, (20, 20, 20), thickness=3.0, thickness_units="screen")

    def stop(self) -> None:
        """Ends the server."""
        self.server.stop()

    def __repr__(self) -> str:
        return f"Live({self.address!r})"


def live(scene: Scene, *, host: str = "127.0.0.1", port: int = 8080) -> Live:
    """Starts a view in the browser for a running program, such as a long simulation. `Live.update` changes it. For one
    step or trajectory, use `pgccd.show`, which makes a file.

    Args:
        scene: the bodies.
        host: interface of the server. Default: only this machine can connect.
        port: of the server; if it is taken, the next free one.

    Raises:
        TypeError: `scene` is not a Scene.
        ImportError: viser is not installed.

    Example:
        >>> view = pgccd.viz.live(scene)
        >>> view.update(x, q, hits)
        >>> view.stop()
    """
    arguments.instance(scene, "scene", Scene)
    try:
        import viser
    except ImportError as error:
        raise ImportError("live views need viser: pip install 'pgccd[live]'") from error
    server = viser.ViserServer(host=host, port=port, verbose=False)
    server.scene.set_up_direction("+z")
    return Live(scene, server)
