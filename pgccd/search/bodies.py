"""A scene and its motion, as input of the stages."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.geometry.columns import mesh_expected
from pgccd.geometry.mesh import MeshSet
from pgccd.geometry.scene import OPTIONAL_COLUMNS, Scene
from pgccd.motion.paths import PATHS, RigidMotion, VertexMotion
from pgccd.motion.validation import MARGIN, Check, Checked, Validation, first_invalid_radius, first_invalid_rows, joined

# The tensors of rigid bodies, and the columns of a motion among them.
_RIGID = ("mesh_index", "position_t0", "position_t1", "radius", "orientation_t0", "rotation")
_OF_MOTION = ("position_t0", "position_t1", "orientation_t0", "rotation")


class MovingBodies:
    """The bodies of a scene during one step of motion, as the operators read them; made by `of`.

    Attributes:
        scene: the bodies.
        linear_path: whether vertices move on straight lines instead of arcs.
        deforming: whether the bodies are given by their vertices.
        tensors: the operators' `bodies` argument. Entries 1 to 3: positions at t0 and t1 (N, 3), of the origins or, for
            deforming bodies, of the SBV centres; and SBV radius (N,).
        centre_t0, centre_t1, reach: (N, 3), (N, 3), (N,) float64: the swept spheres that broad phases test. At every t
            the body and its margin are within `reach` of the point at fraction t of the way from `centre_t0` to
            `centre_t1`, its SBV centres at t0 and t1.
        boxes: (N, 28) float32: boxes that move with the bodies, which broad phases test too (csrc/core/moving_box.h);
            None if every mesh fills much of its SBV.
        checked: whether poses and columns have been validated.

    Example:
        >>> bodies = pgccd.MovingBodies.of(scene, motion)
        >>> pairs = pgccd.broad.sweep(bodies)
    """

    def __init__(
        self,
        scene: Scene,
        motion: RigidMotion | VertexMotion | None,
        columns: Mapping[str, Tensor],
        tensors: list[Tensor],
        swept_spheres: tuple[Tensor, Tensor, Tensor],
        boxes: Tensor | None,
        linear_path: bool,
    ) -> None:
        self.scene, self._motion, self._columns = scene, motion, columns
        self.linear_path = linear_path
        self.deforming = "x_t0" in columns
        self.tensors = tensors
        self.centre_t0, self.centre_t1, self.reach = swept_spheres
        self.boxes = boxes
        # Columns of the scene that are checked.
        self._of_scene: list[Checked] = []
        self.checked = False
        self._found_invalid_rows: Tensor | None = None

    @classmethod
    def of(cls, scene: Scene, motion: RigidMotion | VertexMotion, *, wait: bool = True) -> MovingBodies:
        """The bodies of `scene` during one step of `motion`. For deforming bodies this refits each body's hierarchy,
        once for all stages; if vertices change later, make new moving bodies.

        Args:
            wait: whether to raise for an invalid pose now. Otherwise this does not synchronise, and poses are validated
                on the device.

        Raises:
            TypeError, ValueError: if scene and motion disagree in number or device, or a pose is invalid.
        """
        if not isinstance(scene, Scene):
            raise TypeError(f"scene: expected a pgccd.Scene, got {arguments.describe(scene)}")
        if not isinstance(motion, (RigidMotion, VertexMotion)):
            kinds = "a pgccd.RigidMotion or pgccd.VertexMotion"
            raise TypeError(f"motion: expected {kinds}, got {arguments.describe(motion)}")
        columns = motion.columns()
        scene._check_columns()
        if scene.device != motion.device:
            raise ValueError(f"motion: is on {motion.device}, the scene on {scene.device}")
        if isinstance(motion, RigidMotion) and motion.path not in PATHS:
            arguments.choice(motion.path, "path", PATHS)
        of_scene = scene_columns(scene)
        checks = wait and (bool(of_scene) or not motion._is_trusted)
        of_columns = motion._first_invalid_rows(columns, of_scene) if checks else None
        if of_columns is not None and (first := of_columns.tolist())[-1]:
            Validation([*motion._validation.columns, *of_scene]).raise_from(first)
        tensors = (_deforming if isinstance(motion, VertexMotion) else _rigid)(scene, columns)
        if of_scene:
            tensors[0] = scene._sound_index()
        if scene.margin is not None:
            tensors.append(scene.margin)
        linear_path = isinstance(motion, VertexMotion) or motion.path == "linear"
        deforming = isinstance(motion, VertexMotion)
        spheres = _swept_spheres(scene, tensors, deforming, linear_path)
        boxes = _moving_boxes(scene, tensors, deforming, linear_path)
        bodies = cls(scene, motion, columns, tensors, spheres, boxes, linear_path)
        bodies.checked, bodies._of_scene = wait, of_scene
        if of_columns is not None:
            bodies._found_invalid_rows = bodies._with_radius(of_columns)
            if bodies.deforming:
                bodies._raise_invalid(bodies._found_invalid_rows.tolist())
        return bodies

    @classmethod
    def of_columns(cls, meshes: MeshSet, columns: Mapping[str, Tensor], linear_path: bool = False) -> MovingBodies:
        """Bodies whose columns have been validated, for example by the ranks that sent them: nothing is checked, now or
        later.

        Args:
            meshes: of the bodies.
            columns: "mesh_index" (N,), those of a `RigidMotion` or `VertexMotion` by the names of their attributes,
                and optional ones of a `Scene`; for rigid bodies also "radius" (N,), if it is not that of the mesh
                (negative: no pair contains the body). Others are ignored.
            linear_path: as for a motion with path="linear".

        Example:
            >>> some = pgccd.MovingBodies.of_columns(meshes, {name: x[rows] for name, x in bodies.columns.items()})
        """
        optional = {name: columns[name] for name in OPTIONAL_COLUMNS if name in columns}
        index = columns["mesh_index"]
        radius = columns["radius"] if "radius" in columns else meshes.radius.index_select(0, index)
        scene = Scene._of_checked(meshes, index, radius=radius, **optional)
        deforming = "x_t0" in columns
        moving = {name: columns[name] for name in (("x_t0", "x_t1") if deforming else _OF_MOTION)}
        tensors = (_deforming if deforming else _rigid)(scene, moving)
        if scene.margin is not None:
            tensors.append(scene.margin)
        spheres = _swept_spheres(scene, tensors, deforming, linear_path)
        boxes = _moving_boxes(scene, tensors, deforming, linear_path)
        bodies = cls(scene, None, moving, tensors, spheres, boxes, linear_path or deforming)
        bodies.checked = True
        return bodies

    @property
    def columns(self) -> dict[str, Tensor]:
        """The columns of `of_columns`; of bodies that deform without those of their vertices."""
        rigid = {"mesh_index": self.tensors[0]} if self.deforming else dict(zip(_RIGID, self.tensors, strict=False))
        optional = {name: getattr(self.scene, name) for name in OPTIONAL_COLUMNS}
        return rigid | {name: column for name, column in optional.items() if column is not None}

    @property
    def swept_spheres(self) -> tuple[Tensor, Tensor, Tensor]:
        """`centre_t0`, `centre_t1` and `reach`."""
        return self.centre_t0, self.centre_t1, self.reach

    def stoppable(self) -> MovingBodies:
        """The same rigid bodies, with spheres that contain them wherever on their way they are stopped or slowed down:
        a shortened path is rounded (docs/explanation/exactness.md, section 12). Spheres about origins do already.
        """
        if self.scene.meshes.is_centred:
            return self
        start, end, rotation = self.tensors[1], self.tensors[2], self.tensors[5]
        furthest = torch.maximum(start.abs(), end.abs()).amax(1)
        turn, arm = (_sum_of_three(v.abs()) for v in (rotation, self.centre_t0 - start))
        # Absent bodies have a reach of -inf, which 0 would turn into NaN.
        stray = 2.0**-48 * furthest + 2.0**-51 * turn * (self.reach.clamp(min=0.0) + arm)
        grown = copy.copy(self)
        grown.reach = (self.reach + stray) * (1.0 + 2.0**-50)
        return grown

    @property
    def boxes_at_any_times(self) -> Tensor | None:
        """`boxes`, if they contain bodies that are stopped or slowed down anywhere on their way."""
        return self.boxes if self.scene.meshes.is_centred else None

    def _first_invalid_rows(self) -> Tensor:
        """(F,) int64: for each check the first invalid row, or a number past the last row; then 1 if any row is
        invalid, else 0. Computed once and cached.
        """
        if self._found_invalid_rows is None:
            self._found_invalid_rows = self._find_invalid_rows()
        return self._found_invalid_rows

    def _known_invalid_rows(self) -> Tensor | None:
        """`_first_invalid_rows`, or None if an operator finds them from the columns of `checked_by_operator`."""
        has_verdict = self._motion is None or self._motion._has_verdict
        return self._first_invalid_rows() if has_verdict else self._found_invalid_rows

    @property
    def _operator_checks(self) -> tuple[list[int], list[float]]:
        """The checks and limits of the columns of the motion, for `ops.detect_rigid`."""
        return ([], []) if self._motion is None else self._motion._checks

    @property
    def _checked_by_operator(self) -> list[Checked]:
        """Columns of the scene that an operator checks besides those of the motion."""
        return self._of_scene

    def check(self) -> None:
        """Validates poses and columns again, for a stage called alone: they may have changed. Synchronises with a GPU.

        Raises:
            ValueError: naming the column, the row and the value.
        """
        if self._motion is None:
            return
        self._of_scene = scene_columns(self.scene)
        if (self._of_scene or not self._motion._is_trusted) and not torch.compiler.is_compiling():
            self._raise_invalid(self._find_invalid_rows().tolist())

    def _find_invalid_rows(self) -> Tensor:
        if self._motion is None:
            return torch.zeros(1, dtype=torch.int64, device=self.device)
        return self._with_radius(self._motion._first_invalid_rows(self._columns, self._of_scene))

    def _with_radius(self, invalid_rows: Tensor) -> Tensor:
        return joined(invalid_rows, first_invalid_radius(self.radius)) if self.deforming else invalid_rows

    @property
    def _validation(self) -> Validation:
        """The meaning of the values of `_first_invalid_rows`."""
        if self._motion is None:
            return Validation([])
        columns = [*self._motion._validation.columns, *self._of_scene]
        return Validation(columns, self.radius if self.deforming else None)

    def _raise_invalid(self, first: Sequence[int]) -> None:
        """Raises ValueError if the values of `_first_invalid_rows` include an invalid row."""
        if first[-1]:
            self._validation.raise_from(first)

    @property
    def device(self) -> torch.device:
        """The device of the scene and of the motion."""
        return self.scene.device

    @property
    def mesh_set(self) -> list[Tensor]:
        """The operators' `mesh_set` argument."""
        return self.scene.meshes.tensors

    @property
    def operands(self) -> ops.Bodies:
        """The arguments of operators for both kinds of bodies."""
        return self.mesh_set, self.tensors, None if self.deforming else self.linear_path

    @property
    def position_t0(self) -> Tensor:
        """(N, 3) float64 at t0: positions of the origins or, of deforming bodies, of the SBV centres."""
        return self.tensors[1]

    @property
    def position_t1(self) -> Tensor:
        """(N, 3) float64: as `position_t0`, at t1."""
        return self.tensors[2]

    @property
    def radius(self) -> Tensor:
        """(N,) float64: SBV radii; of deforming bodies, over the step."""
        return self.tensors[3]

    @property
    def _self_colliding(self) -> Tensor:
        """(S,) int64, ascending: the bodies tested against themselves. Empty unless the bodies deform: within a rigid
        body distances are constant, and on straight paths it changes by an affine map, which keeps separate points
        apart (except midway through exactly half a turn).
        """
        rows = self.scene._self_colliding
        return rows if self.deforming else rows[:0]


def scene_columns(scene: Scene) -> list[Checked]:
    """The columns of a scene whose values are validated at each use; none of a validated scene."""
    columns = []
    if scene._must_check_index:
        count = len(scene.meshes)
        columns = [Checked("mesh_index", scene.mesh_index, Check("range", count - 1.0, mesh_expected(count)), "body")]
    if scene.margin is not None and not scene._is_trusted:
        columns.append(Checked("margin", scene.margin, MARGIN, "body"))
    return columns


def check_scene(scene: Scene) -> None:
    """Raises ValueError if a value of a column of a scene is invalid. Synchronises with a GPU if one may be."""
    scene._check_columns()
    if columns := scene_columns(scene):
        Validation(columns).raise_from(first_invalid_rows(columns).tolist())


def _swept_spheres(
    scene: Scene, tensors: list[Tensor], deforming: bool, linear_path: bool
) -> tuple[Tensor, Tensor, Tensor]:
    centre_t0, centre_t1, reach = tensors[1:4]
    if not deforming and not scene.meshes.is_centred:
        centre_t0, centre_t1, reach = ops.moving_spheres(scene.meshes.tensors, tensors, linear_path)
    if scene.margin is not None:
        reach = (reach + scene.margin) * (1.0 + 2.0**-50)
    return centre_t0, centre_t1, reach


def _sum_of_three(v: Tensor) -> Tensor:
    """(N,): the sum of the columns of (N, 3), rounded alike on all devices."""
    x, y, z = v.unbind(1)
    return x + y + z


def _moving_boxes(scene: Scene, tensors: list[Tensor], deforming: bool, linear_path: bool) -> Tensor | None:
    if not scene.meshes.has_boxes:
        return None
    return ops.moving_boxes((scene.meshes.tensors, tensors, None if deforming else linear_path))


def _rigid(scene: Scene, columns: Mapping[str, Tensor]) -> list[Tensor]:
    position_t0, position_t1, orientation_t0, rotation = columns.values()
    if position_t0.shape[0] != scene.body_count:
        raise ValueError(f"motion: has {position_t0.shape[0]} bodies, the scene {scene.body_count}")
    return [scene.mesh_index, position_t0, position_t1, scene._current_radius(), orientation_t0, rotation]


def _deforming(scene: Scene, columns: Mapping[str, Tensor]) -> list[Tensor]:
    layout = scene.layout
    x_t0, x_t1 = columns.values()
    if len(x_t0) != layout.vertex_count:
        expected = f"the scene's bodies have {layout.vertex_count}"
        raise ValueError(f"motion: x_t0 has {len(x_t0)} vertices, {expected}")
    position_t0, position_t1, radius, blocks_t0, blocks_t1 = ops.refit(
        scene.meshes.tensors,
        scene._sound_index(),
        x_t0,
        x_t1,
        layout.vertex_begin,
        layout.block_begin,
        layout.block_count,
    )
    return [
        scene.mesh_index,
        position_t0,
        position_t1,
        radius,
        x_t0,
        x_t1,
        blocks_t0,
        blocks_t1,
        layout.vertex_begin,
        layout.block_begin,
    ]
