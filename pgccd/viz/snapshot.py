"""Data of the pictures: a world at the end of a step, and one collision of that step."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pgccd.geometry.mesh import Mesh


@dataclass
class Impact:
    """One contact of two bodies, i and j, at its toi.

    Attributes:
        ids: of i and j.
        kinds: their meshes.
        toi: in [0, 1].
        feature: description of the touching features.
        point: (3,) world frame, length units.
        normal: (3,) unit, world frame, from i towards j.
        position: (3, 2, 3) at t0, at toi, and at t1 if it had not stopped; world frame, length units.
        orientation: (3, 2, 4) unit quaternions (w, x, y, z) at these times.
        times: (n,) in [0, 1].
        gap: (n,) between the two touching features along the normal, at those times, length units.
    """

    ids: tuple[int, int]
    kinds: tuple[int, int]
    toi: float
    feature: str
    point: np.ndarray
    normal: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    times: np.ndarray
    gap: np.ndarray


@dataclass
class Snapshot:
    """A world at one moment, as numpy arrays. World frame, length units.

    Attributes:
        meshes: the kinds of bodies.
        kind: (N,) mesh of each body.
        ids: (N,) of the bodies.
        position: (N, 3).
        orientation: (N, 4) unit quaternions (w, x, y, z).
        colliding: (N,) bool.
        half_extent: (3,) of the box, centred on the origin.
        caption: a title, then statistics.
        impact: a contact of the step before, if known.

    Example:
        >>> pgccd.viz.world_picture("model.png", pgccd.sim.snapshot_of_step(model, step, ["After step 7"]))
    """

    meshes: list[Mesh]
    kind: np.ndarray
    ids: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    colliding: np.ndarray
    half_extent: np.ndarray
    caption: list[str] = field(default_factory=list)
    impact: Impact | None = None
