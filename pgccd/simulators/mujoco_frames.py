"""MuJoCo: its geoms as bodies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pgccd.robots.kinematics import multiply
from pgccd.robots.mjcf import surface_of_geom
from pgccd.simulators.bodies import Bodies
from pgccd.simulators.simulator import Simulator


class MuJoCo(Simulator):
    """The geoms of a MuJoCo model that may collide, as the bodies of a scene.

    Pairs that MuJoCo does not test are not tested: by contype and conaffinity, of one body, of bodies that are rigidly
    joined, of parent and child (unless the model disables that filter), and of elements `exclude`. All pairs that
    elements `pair` name are tested. Planes are infinite, whatever their size. Geoms that no degree of freedom moves are
    static, also those of mocap bodies.

    Args:
        model: a `mujoco.MjModel`.
        device: of the scene and the frames.

    Attributes:
        scene: a `Scene` of N bodies.
        names: (N) of the geoms, or of their bodies and the number of the geom.
        geoms: (N,) int64 array, the geom of each body.

    Raises:
        ValueError: a geom has no surface, such as an SDF (it is named); or no geom may collide.
        ImportError: mujoco is not installed.

    Example:
        >>> simulator = pgccd.simulators.MuJoCo(model)
        >>> position, orientation = simulator.frame(data)
        >>> list(position.shape)
        [2, 3]
    """

    def __init__(self, model: Any, device: torch.device | str = "cpu") -> None:
        import mujoco

        self._mujoco, self._model = mujoco, model
        collides = (model.geom_contype | model.geom_conaffinity) != 0
        collides[np.concatenate([model.pair_geom1, model.pair_geom2])] = True
        self.geoms = np.flatnonzero(collides)
        bodies, nameless = Bodies(), Path("model")
        for k in self.geoms.tolist():
            key = (int(model.geom_type[k]), model.geom_size[k].tobytes(), int(model.geom_dataid[k]))
            name = model.geom(k).name or f"{model.body(model.geom_bodyid[k]).name or 'body'}, geom {k}"
            bodies.add(name, key, lambda k=k: surface_of_geom(mujoco, model, k, nameless), k)  # type: ignore[misc]
        self.names, self._bodies, self._device = bodies.names, bodies, device
        owner = model.geom_bodyid[self.geoms]
        static = model.body_treeid[owner] < 0  # no degree of freedom moves it
        columns = {}
        if model.npair == 0:
            # MuJoCo tests a pair if one's contype has a bit in common with the other's conaffinity, or the other way
            # round; a scene, only if both hold.
            kind, affinity = (
                column[self.geoms].astype(np.int64) for column in (model.geom_contype, model.geom_conaffinity)
            )
            columns = {"group": kind | affinity << 32, "mask": affinity | kind << 32}
        self.scene = bodies.scene(
            lambda: self._poses(mujoco.MjData(model)),
            device,
            self._never_tested(owner, static),
            static,
            **{name: torch.from_numpy(column).to(device) for name, column in columns.items()},
        )

    def _never_tested(self, owner: np.ndarray, static: np.ndarray) -> np.ndarray:
        """(E, 2): pairs that MuJoCo leaves out by their bodies (N,), without static pairs; if there are elements
        `pair`, also those left out by contype and conaffinity.
        """
        model = self._model
        i, j = np.triu_indices(len(owner), 1)
        low, high = np.minimum(owner[i], owner[j]), np.maximum(owner[i], owner[j])
        weld = model.body_weldid[owner]
        never = (weld[i] == weld[j]) | np.isin((low << 16) + high, model.exclude_signature)
        if not model.opt.disableflags & self._mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
            above = model.body_weldid[model.body_parentid[weld]]
            related = (weld[i] == above[j]) | (weld[j] == above[i])
            never |= related & (weld[i] != 0) & (weld[j] != 0)
        if model.npair > 0:
            one, other = self.geoms[i], self.geoms[j]
            kind, affinity = model.geom_contype, model.geom_conaffinity
            never |= (kind[one] & affinity[other] | kind[other] & affinity[one]) == 0
            named = np.sort(np.stack([model.pair_geom1, model.pair_geom2]), axis=0).astype(np.int64)
            never &= ~np.isin(one * model.ngeom + other, named[0] * model.ngeom + named[1])
        never &= ~(static[i] & static[j])
        return np.stack([i[never], j[never]], axis=1)

    def frame(self, data: Any) -> tuple[Tensor, Tensor]:
        """Positions (N, 3) and orientations (N, 4) of the bodies now. Calls `mj_kinematics`, since `mj_step` leaves the
        poses of geoms at the state before the step.

        Args:
            data: the `mujoco.MjData`.

        Raises:
            ValueError: a body is beside the square in place of an infinite plane, naming both.
        """
        return self._bodies.checked(*self._poses(data))

    def _poses(self, data: Any) -> tuple[Tensor, Tensor]:
        self._mujoco.mj_kinematics(self._model, data)
        owner = self._model.geom_bodyid[self.geoms]
        turns = (torch.from_numpy(q) for q in (data.xquat[owner], self._model.geom_quat[self.geoms]))
        orientation = torch.nn.functional.normalize(multiply(*turns), dim=1)
        position = torch.from_numpy(data.geom_xpos[self.geoms])
        return position.to(self._device), orientation.to(self._device)
