"""Detection as one CUDA graph, for loops that must not be limited by kernel launches from the host."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Generic, TypeVar, Unpack

import torch

from pgccd import arguments
from pgccd.contacts.contacts import CollidingPairs, Contacts
from pgccd.contacts.padded import PaddedCollidingPairs, PaddedContacts, checked_counts
from pgccd.geometry.scene import OPTIONAL_COLUMNS, Scene
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.validation import Validation
from pgccd.runtime.graph import Graph, capture
from pgccd.runtime.host_copy import HostCopy
from pgccd.runtime.sizes import BufferSizes, Capacity, CapacityError, sizes_of
from pgccd.search import broad, narrow
from pgccd.search.detect import CollideOptions, DetectOptions, collide, detect
from pgccd.search.query import Query

# Initial capacity, relative to what the first motion needs.
_SLACK = 1.5


@dataclass(frozen=True)
class _Record:
    """What the host reads of a replay, two calls later."""

    counts: HostCopy  #: of `PaddedContacts.counts`
    capacity: BufferSizes
    validation: Validation

    def check(self) -> None:
        """Waits for the replay. Raises CapacityError or ValueError if its result is incomplete."""
        checked_counts(self.counts.numpy().tolist(), self.capacity, self.validation, later=True)


R = TypeVar("R", bound=Contacts | CollidingPairs)
P = TypeVar("P", bound=PaddedContacts | PaddedCollidingPairs)


class _Captured(Generic[R, P]):
    """The loop of `CapturedDetection` and `CapturedCollision`.

    Args:
        scene, motion, capacity: as for these.
        options: all other arguments of `_call`.
    """

    #: `pgccd.detect` or `pgccd.collide`.
    _call: ClassVar[Callable[..., Any]]

    def __init__(
        self,
        scene: Scene,
        motion: RigidMotion | VertexMotion,
        options: Mapping[str, Any],
        capacity: Capacity | None,
    ) -> None:
        arguments.instance(scene, "scene", Scene)
        arguments.instance(motion, "motion", RigidMotion, VertexMotion)
        if capacity is not None:
            sizes_of(capacity)
        self.scene, self._options = scene, options
        self.capacity = capacity
        self.motion = _copy_of(motion)
        self._graph: Graph | None = None
        self._read: list[object] = []  # inputs of the graph
        self._found: P | None = None
        # Calls so far, the one that made the result, and the records of the last two by number.
        self._calls = self._call_of_found = 0
        self._records: dict[int, _Record] = {}

    def load(self, motion: RigidMotion | VertexMotion) -> None:
        """Copies a motion into `self.motion`. Does not synchronise.

        Raises:
            TypeError, ValueError: the motion has another kind, size or path.
        """
        if type(motion) is not type(self.motion):
            raise TypeError(f"motion: expected a {type(self.motion).__name__}, got {arguments.describe(motion)}")
        if isinstance(motion, RigidMotion) and motion.path != self.motion.path:  # type: ignore[union-attr]
            raise ValueError(f"motion: expected path {self.motion.path!r} as captured, got {motion.path!r}")  # type: ignore[union-attr]
        given = motion.columns()
        for name, column in self.motion.columns().items():
            if given[name].shape != column.shape or given[name].device != column.device:
                expected = f"{tuple(column.shape)} on {column.device}"
                raise ValueError(
                    f"motion: {name}: expected {expected}, got {tuple(given[name].shape)} on {given[name].device}"
                )
            column.copy_(given[name])

    def replay(self) -> P:
        """Detects the collisions of the loaded motion. Waits for the call before the last, and synchronises if it
        captures the graph. The next call overwrites the result, or returns one in new memory.

        Raises:
            ValueError: a pose was invalid in the call before the last or, without a given capacity, is invalid in the
                first call; or the first step does not fit in memory in one pass.
            CapacityError: the call before the last needs more than the largest capacity.
        """
        self._begin_call()
        return self._replay()

    def __call__(self, motion: RigidMotion | VertexMotion) -> P:
        """`load`, then `replay`; raises before the motion is loaded."""
        self._begin_call()
        self.load(motion)
        return self._replay()

    def _trimmed(self) -> R:
        """A copy of the result of the last call, see `CapturedDetection.contacts`."""
        padded = self.replay() if self._found is None else self._found
        self._records.pop(self._call_of_found, None)  # read now instead of two calls later
        while True:
            try:
                found: Any = padded.trim()
            except CapacityError as error:
                self._grow(error)
                padded = self._run()
            else:
                return found.clone() if self.is_graph else found

    @property
    def is_graph(self) -> bool:
        """Whether replays use a CUDA graph."""
        return self.scene.device.type == "cuda"

    def _begin_call(self) -> None:
        """Counts a call, and reads the record of the call before the last."""
        self._calls += 1
        record = self._records.pop(self._calls - 2, None)
        if record is None:
            return
        try:
            record.check()
        except CapacityError as error:
            self._grow(error)
        except ValueError as error:
            raise ValueError(f"{error} (in the call before the last)") from None

    def _replay(self) -> P:
        found = self._run()
        self._call_of_found = self._calls
        with torch.cuda.device_of(found.counts):  # the event that is waited for belongs to the current device
            self._records[self._calls] = _Record(
                HostCopy.start(found.counts), sizes_of(found.capacity), found._validation
            )
        return found

    def _run(self) -> P:
        self.capacity = self.capacity or self._estimate()
        if not self.is_graph:
            self._found = self._detect()
        else:
            inputs = self._inputs()
            if self._graph is not None and not _are_same(inputs, self._read):
                self._drop_graph()
            if self._graph is None:
                self._graph, self._found = capture(self._detect, self.scene.device)
                self._read = inputs
            self._graph.replay()
        assert self._found is not None
        return self._found

    def _grow(self, error: CapacityError) -> None:
        """Chooses a capacity for a step that exceeded one; the graph is captured again with it."""
        assert self.capacity is not None
        present, needed = sizes_of(self.capacity), sizes_of(error.needed)
        names = [field.name for field in fields(BufferSizes)]
        if error.capacity is not present and all(getattr(needed, name) <= getattr(present, name) for name in names):
            return  # it has grown since then
        larger = present.grown(needed)
        if larger == present:
            raise error
        self.capacity = larger
        self._drop_graph()

    def _drop_graph(self) -> None:
        """Lets the next replay capture a graph."""
        if self._graph is not None:
            torch.cuda.synchronize(self.scene.device)  # the graph may be running
            self._graph = None

    def _inputs(self) -> list[object]:
        """Inputs that a graph has captured for good. Rows of vertices follow from `mesh_index`."""
        scene, motion = self.scene, self.motion
        columns = [getattr(scene, name) for name in ("mesh_index", "self_collision", *OPTIONAL_COLUMNS)]
        written = None if scene.mesh_index.is_inference() else scene.mesh_index._version
        of_motion = [*motion.columns().values(), getattr(motion, "path", None)]
        return [*columns, *of_motion, written]

    def _estimate(self) -> Capacity:
        needed = self._call(self.scene, self.motion, **self._options).stats.needed
        if needed is None:
            raise ValueError("motion: this step does not fit in memory in one pass; use pgccd.detect or pgccd.collide")
        return needed.times(_SLACK)

    def _detect(self) -> P:
        assert self.capacity is not None
        found: P = self._call(self.scene, self.motion, capacity=self.capacity, **self._options)
        return found

    def __repr__(self) -> str:
        name = type(self).__name__
        return f"{name}(bodies={self.scene.body_count}, graph={self.is_graph}, device={self.scene.device})"


class CapturedDetection(_Captured[Contacts, PaddedContacts]):
    """`pgccd.detect` for the steps of a loop: poses are loaded into fixed memory, one CUDA graph is replayed, and
    contacts are read from fixed memory. The result is bitwise equal to that of `detect`.

    The first call captures the graph, so it takes longer and synchronises. On a CPU there is no graph: each call runs
    `detect` with the same capacity (`is_graph` is False).

    Each call of `__call__` or `replay` first reads the counts of the call before the last, which a GPU has usually
    finished. If that call exceeded a capacity, the graph is captured again with a larger one. If one of its poses was
    invalid, a ValueError names body and column. Both happen at the same call in every run, on every device. Until then
    an incomplete result reads as a contact at the start of the step, see `PaddedContacts`: a loop that moves bodies by
    `first_toi` stands still for such a step, and goes on when the capacity suffices.

    Args:
        scene: the bodies. Its columns are read at each call and may be written. If columns of the scene or of `motion`
            are replaced, or `mesh_index` is written, the graph is captured again. The `mesh_index` of bodies that
            deform is fixed.
        motion: a step of the same kind as later ones, with the same number of bodies or vertices.
        report, min_separation: as for `detect`.
        capacity: of the result and of all intermediate lists. Default: 1.5 times what the first replayed motion needs.
        options: tolerance, nonzero_toi, initial, broad_phase: as for `detect`.

    Attributes:
        scene: the bodies.
        motion: the motion that each replay reads, in fixed memory. `load`, or kernels of the caller, write to it.
        capacity: of the result and of all intermediate lists; None before the first replay, unless it was given.

    Raises:
        TypeError, ValueError: naming the argument.

    Example:
        >>> captured = pgccd.CapturedDetection(scene, motion)
        >>> hits = captured(pgccd.RigidMotion(x0, q0, x1, q1))  # PaddedContacts
        >>> safe = hits.first_toi().clamp(max=1.0)
        >>> contacts = captured.contacts()  # trimmed copy; synchronises
    """

    _call = staticmethod(detect)

    def __init__(
        self,
        scene: Scene,
        motion: RigidMotion | VertexMotion,
        report: narrow.Report = "first",
        min_separation: float = 0.0,
        *,
        capacity: Capacity | None = None,
        **options: Unpack[DetectOptions],
    ) -> None:
        narrow.check_report(report, "pgccd.CapturedCollision")
        _check_options(report, min_separation, options, DetectOptions)
        if options.get("normals", "features") != "features":
            raise ValueError(f'normals: expected "features" for captured steps, got {options["normals"]!r}')
        super().__init__(scene, motion, {"report": report, "min_separation": min_separation, **options}, capacity)

    def contacts(self) -> Contacts:
        """A copy of the contacts of the last call; replays first if there was no call. Synchronises. If a capacity was
        exceeded, the step is captured again with a larger one, and replayed.

        Raises:
            ValueError: the motion is invalid.
        """
        return self._trimmed()


class CapturedCollision(_Captured[CollidingPairs, PaddedCollidingPairs]):
    """`pgccd.collide` for the steps of a loop, by replays of one CUDA graph: see `CapturedDetection`. An incomplete
    result reads as if all bodies collide, see `PaddedCollidingPairs`.

    Args:
        scene, motion, capacity: as for `CapturedDetection`.
        min_separation, options: as for `collide`.

    Attributes:
        scene, motion, capacity: as of `CapturedDetection`.

    Raises:
        TypeError, ValueError: naming the argument.

    Example:
        >>> captured = pgccd.CapturedCollision(scene, motion)
        >>> colliding = captured(pgccd.RigidMotion(x0, q0, x1, q1))  # PaddedCollidingPairs
        >>> x = torch.where(colliding.may_collide(), x0, x1)
        >>> pairs = captured.pairs()  # trimmed copy; synchronises
    """

    _call = staticmethod(collide)

    def __init__(
        self,
        scene: Scene,
        motion: RigidMotion | VertexMotion,
        min_separation: float = 0.0,
        *,
        capacity: Capacity | None = None,
        **options: Unpack[CollideOptions],
    ) -> None:
        _check_options("any", min_separation, options, CollideOptions)
        super().__init__(scene, motion, {"min_separation": min_separation, **options}, capacity)

    def pairs(self) -> CollidingPairs:
        """A copy of the colliding pairs of the last call, made as `CapturedDetection.contacts`.

        Raises:
            ValueError: the motion is invalid.
        """
        return self._trimmed()


def _check_options(
    report: narrow.SearchReport, min_separation: float, options: Mapping[str, Any], known: type[CollideOptions]
) -> None:
    """Raises TypeError or ValueError, naming the argument, before anything is captured."""
    of_query = {name: options[name] for name in ("tolerance", "nonzero_toi", "initial") if name in options}
    Query(report, min_separation, **({"tolerance": None, "nonzero_toi": False} | of_query))  # checks them
    unknown = set(options) - known.__annotations__.keys()
    if unknown:
        raise TypeError(f"{min(unknown)}: expected one of {list(known.__annotations__)}")
    arguments.choice(options.get("broad_phase", "auto"), "broad_phase", broad.BROAD_PHASES)


def _copy_of(motion: RigidMotion | VertexMotion) -> RigidMotion | VertexMotion:
    columns = {name: column.clone() for name, column in motion.columns().items()}
    if isinstance(motion, VertexMotion):
        return VertexMotion._of_checked(**columns)
    return RigidMotion._of_checked(**columns, path=motion.path)


def _are_same(one: list[object], other: list[object]) -> bool:
    """Whether both have the same tensors and equal numbers."""
    return all(a is b or (isinstance(a, (int, str)) and a == b) for a, b in zip(one, other, strict=True))
