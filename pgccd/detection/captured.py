"""Detection as one CUDA graph, for loops that must not be limited by kernel launches from the host."""

import operator
from typing import Unpack

from pgccd import arguments
from pgccd.detection import broad, narrow
from pgccd.detection.capacity import Capacity, CapacityError, check_capacity
from pgccd.detection.contacts import Contacts, PaddedContacts
from pgccd.detection.pipeline import Options, detect
from pgccd.detection.query import Query
from pgccd.geometry.scene import OPTIONAL_COLUMNS, Scene
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.runtime.graph import Graph, capture

# Initial capacity, relative to what the first motion needs.
_SLACK = 1.5


class CapturedDetection:
    """`pgccd.detect` for the steps of a loop: poses are loaded into fixed memory, one CUDA graph is replayed, and
    contacts are read from fixed memory. The result is bitwise equal to that of `detect`.

    The graph is captured by the first replay, which takes longer and synchronises. On a CPU there is none: each replay
    calls `detect` with the same capacity (`is_graph` is False).

    Args:
        scene: the bodies. Its columns are read at each replay and may be written; if one is replaced, the next replay
            captures the graph again. The `mesh_index` of bodies that deform is fixed.
        motion: a step of the same kind as later ones, with the same number of bodies or vertices.
        report, min_separation: as for `detect`.
        capacity: of the result and of all intermediate lists. Default: 1.5 times what the first replayed motion needs.
        options: tolerance, nonzero_toi, broad_phase: as for `detect`.

    Raises:
        TypeError, ValueError: naming the argument.

    Example:
        >>> captured = pgccd.CapturedDetection(scene, motion)
        >>> hits = captured(pgccd.RigidMotion(x0, q0, x1, q1))  # PaddedContacts; does not synchronise
        >>> safe = hits.first_toi().clamp(max=1.0)
        >>> contacts = captured.contacts()  # trimmed copy; synchronises
    """

    def __init__(
        self,
        scene: Scene,
        motion: RigidMotion | VertexMotion,
        report: narrow.Report = "first",
        min_separation: float = 0.0,
        *,
        capacity: Capacity | None = None,
        **options: Unpack[Options],
    ) -> None:
        if not isinstance(scene, Scene):
            raise TypeError(f"scene: expected a pgccd.Scene, got {arguments.describe(scene)}")
        if not isinstance(motion, (RigidMotion, VertexMotion)):
            kinds = "a pgccd.RigidMotion or pgccd.VertexMotion"
            raise TypeError(f"motion: expected {kinds}, got {arguments.describe(motion)}")
        Query(report, min_separation, options.get("tolerance"), options.get("nonzero_toi", False))  # checks them
        arguments.choice(options.get("broad_phase", "auto"), "broad_phase", broad.BROAD_PHASES)
        if capacity is not None:
            check_capacity(capacity)
        self.scene = scene
        self._report, self._min_separation, self._options = report, min_separation, options
        #: Capacity of the result and of all intermediate lists; None before the first replay, unless it was given.
        self.capacity = capacity
        #: The motion read by each replay, in fixed memory: written by `load`, or by kernels of the caller.
        self.motion = _copy_of(motion)
        self._graph: Graph | None = None
        self._captured: list[object] = []
        self._found: PaddedContacts | None = None

    def load(self, motion: RigidMotion | VertexMotion) -> None:
        """Copies a motion into `self.motion`. Does not synchronise.

        Raises:
            TypeError, ValueError: the motion has another kind, size or path.
        """
        if type(motion) is not type(self.motion):
            raise TypeError(f"motion: expected a {type(self.motion).__name__}, got {arguments.describe(motion)}")
        if isinstance(motion, RigidMotion) and motion.path != self.motion.path:  # type: ignore[union-attr]
            raise ValueError(f"motion: its path is {motion.path!r}, that captured {self.motion.path!r}")  # type: ignore[union-attr]
        given = motion.columns()
        for name, column in self.motion.columns().items():
            if given[name].shape != column.shape or given[name].device != column.device:
                expected = f"{tuple(column.shape)} on {column.device}"
                raise ValueError(
                    f"motion: {name}: expected {expected}, got {tuple(given[name].shape)} on {given[name].device}"
                )
            column.copy_(given[name])

    def replay(self) -> PaddedContacts:
        """Detects the collisions of the loaded motion. Does not synchronise, except the first time; the next replay
        overwrites the result.

        Raises:
            ValueError: the first time: the motion is invalid, or the step does not fit in memory in one pass.
        """
        if self._found is None:
            self.capacity = self.capacity or self._estimate()
            self._capture()
        elif self.is_graph and not all(map(operator.is_, self._captured, self._read())):
            self._capture()
        if self._graph is None:
            self._found = self._detect()
        else:
            self._graph.replay()
        assert self._found is not None
        return self._found

    def __call__(self, motion: RigidMotion | VertexMotion) -> PaddedContacts:
        """`load`, then `replay`."""
        self.load(motion)
        return self.replay()

    def contacts(self) -> Contacts:
        """A copy of the contacts of the last replay; replays first if there was none. Synchronises. If a capacity was
        exceeded, the step is captured again with a larger one, and replayed.

        Raises:
            ValueError: the motion is invalid.
        """
        padded = self.replay() if self._found is None else self._found
        while True:
            try:
                found = padded.trim()
            except CapacityError as error:
                self.capacity = error.capacity.grown(error.needed)
                self._capture()
                padded = self.replay()
            else:
                return found.clone() if self.is_graph else found

    @property
    def is_graph(self) -> bool:
        """Whether replays use a CUDA graph."""
        return self.scene.device.type == "cuda"

    def _estimate(self) -> Capacity:
        given = self.scene, self.motion, self._report, self._min_separation
        needed = detect(*given, **self._options).stats.needed
        if needed is None:
            raise ValueError("motion: this step does not fit in memory in one pass; use pgccd.detect")
        return needed.times(_SLACK)

    def _detect(self) -> PaddedContacts:
        assert self.capacity is not None
        given = self.scene, self.motion, self._report, self._min_separation
        return detect(*given, capacity=self.capacity, **self._options)

    def _read(self) -> list[object]:
        """What the graph reads: it is captured again if one of these was replaced."""
        of_motion = [*self.motion.columns().values(), getattr(self.motion, "path", None)]
        return [self.scene.mesh_index, *(getattr(self.scene, name) for name in OPTIONAL_COLUMNS), *of_motion]

    def _capture(self) -> None:
        if self.is_graph:
            self._graph, self._captured = None, self._read()
            self._graph, self._found = capture(self._detect, self.scene.device)

    def __repr__(self) -> str:
        return f"CapturedDetection(bodies={self.scene.body_count}, graph={self.is_graph}, device={self.scene.device})"


def _copy_of(motion: RigidMotion | VertexMotion) -> RigidMotion | VertexMotion:
    columns = {name: column.clone() for name, column in motion.columns().items()}
    if isinstance(motion, VertexMotion):
        return VertexMotion(**columns)
    return RigidMotion.from_rotation(**columns, path=motion.path)
