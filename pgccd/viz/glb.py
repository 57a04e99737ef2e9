"""Bodies at one time as a GLB file, by trimesh."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pgccd.viz.animation import Animation, RigidPaths
from pgccd.viz.moment import COLOURS, colours_at_first, first_moment, poses_at, vertices_at
from pgccd.viz.raster import placed

_MARK = (30, 30, 30, 255)


def write_glb(path: Path, animation: Animation) -> Path:
    """Writes all bodies at the time of the first contact, or at the start if there is none, and the contacts of that
    time. The bodies of the first contact have two colours. Coordinates are the world's, z up, rounded to float32.

    Raises:
        ImportError: trimesh is not installed.
    """
    try:
        import trimesh
    except ImportError as error:
        raise ImportError("path: GLB files need trimesh: pip install 'pgccd[mesh]'") from error
    marks, (segment, time, at_time) = animation.marks, first_moment(animation)
    colours = colours_at_first(animation)
    scene = trimesh.Scene()
    paints = [(*(255 * colour).round().astype(int).tolist(), 255) for colour in COLOURS]

    def add(vertices: np.ndarray, faces: np.ndarray, paint: tuple[int, ...], **where: Any) -> None:
        material = trimesh.visual.material.PBRMaterial(
            baseColorFactor=paint, metallicFactor=0.0, roughnessFactor=0.8, doubleSided=True
        )
        visual = trimesh.visual.TextureVisuals(material=material)
        mesh = trimesh.Trimesh(vertices, faces, visual=visual, process=False, validate=False)
        scene.add_geometry(mesh, **where)

    paths = animation.paths
    if isinstance(paths, RigidPaths) and not paths.is_linear:
        poses = _poses(paths, segment, time)
        known: dict[tuple[int, int], str] = {}
        for body, (shape, colour) in enumerate(zip(animation.shape_index.tolist(), colours.tolist(), strict=True)):
            node = f"body {animation.ids[body]}"
            if (shape, colour) in known:
                scene.graph.update(frame_to=node, matrix=poses[body], geometry=known[shape, colour])
                continue
            name = known[shape, colour] = f"mesh {shape}, colour {colour}"
            drawn = animation.shapes[shape]
            add(drawn.vertices, drawn.faces, paints[colour], geom_name=name, node_name=node, transform=poses[body])
    else:
        for body, vertices in enumerate(vertices_at(animation, segment, time)):
            node = f"body {animation.ids[body]}"
            faces = animation.shapes[animation.shape_index[body]].faces
            add(vertices, faces, paints[colours[body]], geom_name=node, node_name=node)
    size = 0.03 * float(np.linalg.norm(scene.extents)) if len(scene.geometry) else 1.0
    for number in at_time.tolist():
        ball = trimesh.creation.icosphere(subdivisions=2, radius=0.2 * size)
        parts = [ball.apply_translation(marks.point[number])]
        if marks.normal[number].any():
            ends = [marks.point[number], marks.point[number] + size * marks.normal[number]]
            parts.append(trimesh.creation.cylinder(radius=0.06 * size, segment=ends))
        mark: Any = trimesh.util.concatenate(parts)
        node = f"contact {number}"
        add(mark.vertices, mark.faces, _MARK, geom_name=node, node_name=node)
    path.write_bytes(scene.export(file_type="glb"))
    return path


def _poses(paths: RigidPaths, segment: int, time: float) -> np.ndarray:
    """(N, 4, 4) matrices of all bodies."""
    position, orientation = poses_at(paths, segment, time)
    matrices = np.tile(np.eye(4), (len(position), 1, 1))
    for axis in range(3):
        matrices[:, :3, axis] = placed(np.eye(3)[axis, None], np.zeros_like(position), orientation)[:, 0]
    matrices[:, :3, 3] = position
    return matrices
