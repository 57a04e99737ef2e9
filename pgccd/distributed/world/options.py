"""Arguments of `World.create`, `World.load`, `World.add` and `World.step`."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from pgccd import arguments
from pgccd.distributed.comm.interface import Comm
from pgccd.distributed.detection.excluded import Excluded
from pgccd.distributed.detection.options import RankOptions, SearchOptions
from pgccd.distributed.launch.agreement import together
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import PATHS, PathKind
from pgccd.search import narrow
from pgccd.search.checks import Initial

#: Names of payload.
Names = Collection[str]
#: Which bodies may be stopped.
Movable = Tensor | Sequence[bool] | None


@dataclass(frozen=True, kw_only=True)
class WorldOptions(RankOptions):
    """Options of a `World`, equal on all ranks. In addition to the attributes of `RankOptions`:

    Attributes:
        report, min_separation, tolerance, nonzero_toi, initial: as for `pgccd.detect`.
        path: of all motions, as for `pgccd.RigidMotion`.

    Example:
        >>> options = pgccd.distributed.WorldOptions(min_separation=1e-3, nonzero_toi=True, partition="cells")
    """

    report: narrow.Report = "first"
    min_separation: float = 0.0
    tolerance: float | None = None
    nonzero_toi: bool = False
    initial: Initial = "report"
    path: PathKind = "rigid"

    def _search(self, exclude: Tensor | None) -> SearchOptions:
        """The options of a search without pairs (E, 2) of ids."""
        lengths = self.min_separation, self.tolerance
        search = SearchOptions(self.report, *lengths, self.nonzero_toi, self.broad_phase, self.overlap, self.initial)
        return replace(search, excluded=Excluded.of(exclude))


def options_given(comm: Comm, options: WorldOptions | None) -> WorldOptions:
    """The options, or the default ones. Raises TypeError or ValueError, on all ranks, if they are invalid."""

    def check() -> WorldOptions:
        given = WorldOptions() if options is None else options
        if not isinstance(given, WorldOptions):
            raise TypeError(f"options: expected WorldOptions, got {arguments.describe(given)}")
        given._search(None).check()
        arguments.choice(given.path, "path", PATHS)
        return given

    return together(comm, check)


@dataclass(frozen=True, eq=False)
class NewBodies:
    """One rank's share of the bodies that make a world or join it, as passed to `World.create` or `World.add`."""

    scene: Scene
    position: Tensor
    id: Tensor | None
    exclude: Tensor | Sequence[Sequence[int]] | None
    payload: dict[str, Tensor] | None
    vertex_payload: dict[str, Tensor] | None
