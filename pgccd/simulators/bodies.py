"""Collision shapes as the bodies of a scene."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

import numpy as np
import torch

from pgccd.geometry.mesh import Mesh
from pgccd.geometry.scene import Scene
from pgccd.robots.shapes import ThickSurface


class Bodies:
    """Bodies in the order in which they are added.

    Attributes:
        names: of the bodies, for people.
    """

    def __init__(self) -> None:
        self.names: list[str] = []
        self._meshes: list[Mesh] = []
        self._known: dict[Hashable, tuple[int, float]] = {}
        self._rows: list[tuple[int, float]] = []

    def add(self, name: str, key: Hashable, surface: Callable[[], ThickSurface]) -> None:
        """Adds a body; those with equal keys share a mesh.

        Raises:
            ValueError: it has no surface, naming the body.
        """
        if key not in self._known:
            try:
                made = surface()
                mesh = Mesh(made.vertices, made.faces)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from error
            mesh.name = name
            self._known[key] = len(self._meshes), made.thickness
            self._meshes.append(mesh)
        self.names.append(name)
        self._rows.append(self._known[key])

    def scene(self, device: torch.device | str, exclude: np.ndarray, **filters: Any) -> Scene:
        """The scene of all bodies.

        Args:
            device, filters: as for `Scene`.
            exclude: (E, 2) integers.

        Raises:
            ValueError: there are none.
        """
        if not self._rows:
            raise ValueError("model: it has no collision shapes")
        index, thickness = zip(*self._rows, strict=True)
        # A list: a Python float keeps all its digits.
        margin = list(thickness) if any(thickness) else None
        pairs = torch.from_numpy(exclude.reshape(-1, 2).astype(np.int64)).to(device)
        return Scene(self._meshes, index, device, margin=margin, exclude=pairs if len(pairs) else None, **filters)
