"""Collision shapes as the bodies of a scene."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pgccd.geometry.mesh import Mesh
from pgccd.geometry.scene import Scene
from pgccd.motion.differentiable import oriented
from pgccd.robots.shapes import PLANE, ThickSurface


class Bodies:
    """Bodies in the order in which they are added.

    Attributes:
        names: of the bodies, for people.
    """

    def __init__(self) -> None:
        self.names: list[str] = []
        self._known: dict[Hashable, int] = {}
        self._surfaces: list[ThickSurface] = []
        self._meshes: list[Mesh] = []
        self._index: list[int] = []
        # The first body of infinite planes that move together, by mesh and carrier.
        self._planes: dict[Hashable, int] = {}

    def add(self, name: str, key: Hashable, surface: Callable[[], ThickSurface], carrier: Hashable) -> None:
        """Adds a body. Bodies with equal keys share a mesh, and bodies with equal carriers share a pose.

        Raises:
            ValueError: it has no surface, naming the body.
        """
        if key not in self._known:
            try:
                made = surface()
                mesh = made.mesh(name)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from error
            self._known[key] = len(self._meshes)
            self._surfaces.append(made)
            self._meshes.append(mesh)
        index = self._known[key]
        if self._surfaces[index].infinite:
            self._planes.setdefault((index, carrier), len(self._index))
        self.names.append(name)
        self._index.append(index)

    def scene(
        self,
        frame: Callable[[], tuple[Tensor, Tensor]],
        device: torch.device | str,
        exclude: np.ndarray,
        static: np.ndarray,
        **filters: Any,
    ) -> Scene:
        """The scene of all bodies. Infinite planes become squares that reach four times as far as all else.

        Args:
            frame: gives the poses of the bodies now.
            device, filters: as for `Scene`.
            exclude: (E, 2) integers.
            static: (N,) bool.

        Raises:
            ValueError: there are none.
        """
        if not self._index:
            raise ValueError("model: it has no collision shapes")
        surfaces = [self._surfaces[k] for k in self._index]
        away = frame()[0].double().norm(dim=1).cpu().numpy()
        infinite = np.array([each.infinite for each in surfaces])
        reach = np.array([np.linalg.norm(each.centre) if each.infinite else each.reach for each in surfaces])
        self._half = max(PLANE, 4.0 * float((away + reach).max()))
        self._reach = torch.from_numpy(np.where(infinite, -np.inf, reach)).to(device)
        self._static = torch.from_numpy(static).to(device)
        meshes = list(self._meshes)
        for k, each in enumerate(self._surfaces):
            if each.infinite:
                meshes[k] = each.widened(self._half).mesh(self._meshes[k].name or "")
        pairs = torch.from_numpy(exclude.reshape(-1, 2).astype(np.int64)).to(device)
        return Scene(
            meshes,
            self._index,
            device,
            exclude=pairs if len(pairs) else None,
            static=self._static,
            **filters,
        )

    def checked(self, position: Tensor, orientation: Tensor) -> tuple[Tensor, Tensor]:
        """The poses of a frame.

        Raises:
            ValueError: a body is beside the square in place of an infinite plane, naming both.
        """
        for row in self._planes.values():
            surface = self._surfaces[self._index[row]]
            away = position - position[row]
            across, side, other = oriented(position.new_tensor(_axes(surface)), orientation[row]).unbind(0)
            away = away - across
            lateral = ((away @ side) ** 2 + (away @ other) ** 2).sqrt()
            leaves = ~(lateral + self._reach <= self._half) & ~(self._static & self._static[row])
            if bool(leaves.any()):
                body = int(leaves.long().argmax())
                expected = f"bodies within {self._half:g} of the place of the infinite plane {self.names[row]!r}"
                got = f"{self.names[body]!r} at {float(lateral[body]):.3g}"
                raise ValueError(f"position: expected {expected}, got {got}: make the scene of this frame")
        return position, orientation


def _axes(surface: ThickSurface) -> np.ndarray:
    """(3, 3): the centre of a square, and the directions of its sides."""
    a, b, c = surface.vertices[:3]
    return np.stack([surface.centre, (b - a) / (2.0 * PLANE), (c - b) / (2.0 * PLANE)])
