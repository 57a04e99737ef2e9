"""Data of the pictures: a world at the end of a step, and one collision of that step."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pgccd.geometry.mesh import Mesh


@dataclass
class Impact:
    """One contact of two bodies, i and j, at its toi."""

    ids: tuple[int, int]
    kinds: tuple[int, int]  #: their meshes
    toi: float
    feature: str  #: description of the touching features
    point: np.ndarray  #: (3,) world
    normal: np.ndarray  #: (3,) unit, from i towards j
    position: np.ndarray  #: (3, 2, 3) at t0, at toi, and at t1 if it had not stopped
    orientation: np.ndarray  #: (3, 2, 4)
    times: np.ndarray  #: (n,) in [0, 1]
    gap: np.ndarray  #: (n,) between the two touching features along the normal, at those times


@dataclass
class Motion:
    """The motion of the step that led to a snapshot, for playback."""

    position: np.ndarray  #: (N, 3) at t0
    orientation: np.ndarray  #: (N, 4) at t0
    velocity: np.ndarray  #: (N, 3) displacement of the whole step
    angular_velocity: np.ndarray  #: (N, 3) rotation vector of the whole step
    fraction: np.ndarray  #: (N,) part of the step that each body moved
    contact_ids: np.ndarray  #: (K, 2) of all contacts
    contact_toi: np.ndarray  #: (K,)
    contact_point: np.ndarray  #: (K, 3)


@dataclass
class Snapshot:
    """A world at one moment, as numpy arrays.

    Example:
        >>> pgccd.viz.world_picture("model.png", pgccd.sim.snapshot_of_step(model, step, ["After step 7"]))
    """

    meshes: list[Mesh]
    kind: np.ndarray  #: (N,) mesh of each body
    position: np.ndarray  #: (N, 3)
    orientation: np.ndarray  #: (N, 4)
    colliding: np.ndarray  #: (N,) bool
    half_extent: np.ndarray  #: (3,) of the box, centred on the origin
    caption: list[str] = field(default_factory=list)  #: a title, then statistics
    motion: Motion | None = None
    impact: Impact | None = None
