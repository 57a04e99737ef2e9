"""What all simulators have."""

from __future__ import annotations

from collections.abc import Iterable
from os import PathLike
from pathlib import Path

from torch import Tensor

from pgccd import files
from pgccd.geometry.scene import Scene


class Simulator:
    """A scene of a simulator's collision shapes, and names of its bodies.

    Attributes:
        scene: a `Scene` of N bodies.
        names: (N) of the bodies, for people.
    """

    scene: Scene
    names: list[str]

    def save(self, path: str | PathLike[str], frames: Iterable[tuple[Tensor, Tensor]]) -> Path:
        """Writes the scene, the names of its bodies and the frames of a run, as `pgccd.files.save_scene` does: for
        `pgccd audit --scene` and `pgccd.files.load_scene`. Frames are written one after the other.

        Args:
            path: of the JSON file; the files of the meshes and the frames are beside it.
            frames: results of `frame`, positions (N, 3) and orientations (N, 4), from any iterable, such as a generator
                that runs the simulator.

        Returns:
            The path.

        Raises:
            TypeError, ValueError, OSError: as for `pgccd.files.save_scene`.

        Example:
            >>> simulator = pgccd.simulators.MuJoCo(model)
            >>> simulator.save("run.json", [simulator.frame(data), simulator.frame(data)])
            PosixPath('run.json')
        """
        return files.save_scene(path, self.scene, frames, self.names)
