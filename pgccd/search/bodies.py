"""A scene and its motion, as input of the stages."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.geometry.mesh_set import MeshSet
from pgccd.geometry.scene import OPTIONAL_COLUMNS, Scene
from pgccd.motion.of_scene import check_bodies, scene_columns
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.validation import RADIUS, Checked, Validation, first_invalid_rows

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
            deforming bodies, of the SBV centres; and SBV radius (N,), -inf for rigid bodies with an invalid value.
        centre_t0, centre_t1, reach: (N, 3), (N, 3), (N,) float64: the swept spheres that broad phases test. At every t
            the body and its margin are within `reach` of the point at fraction t of the way from `centre_t0` to
            `centre_t1`, its SBV centres at t0 and t1.
        device: of all tensors.
        boxes: (N, 28) float32: boxes that move with the bodies, which broad phases test too (csrc/core/moving_box.h);
            None if every mesh fills much of its SBV.

    Example:
        >>> bodies = pgccd.MovingBodies.of(scene, motion)
        >>> pairs = pgccd.broad.sweep(bodies)
    """

    def __init__(
        self,
        scene: Scene,
        motion: RigidMotion | VertexMotion | None,
        tensors: list[Tensor],
        linear_path: bool,
        deforming: bool,
        invalid_rows: Tensor | None = None,
    ) -> None:
        self.scene, self._motion = scene, motion
        self.device = scene.device
        self.linear_path = linear_path
        self.deforming = deforming
        thickness = scene._thickness
        self.tensors = tensors if thickness is None else [*tensors, thickness]
        # Which rows are invalid, for `_validation`. None: none is.
        self._invalid_rows = invalid_rows
        _, self.centre_t0, self.centre_t1, self.reach, *_ = tensors
        self.boxes: Tensor | None = None
        if thickness is not None or scene.meshes.has_boxes or self._is_off_centre:
            self._enlarge(thickness)

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
        arguments.instance(scene, "scene", Scene)
        arguments.instance(motion, "motion", RigidMotion, VertexMotion)
        columns = motion._plain()
        if scene.margin is not None or scene._fixed:
            scene._refuse()
        check_bodies(scene, motion)
        if isinstance(motion, RigidMotion):
            position_t0, position_t1, orientation, rotation = columns
            radius, invalid_rows = _sound_radii(scene, position_t0, position_t1, orientation, rotation)
            tensors = [scene.mesh_index, position_t0, position_t1, radius, orientation, rotation]
            bodies = cls(scene, motion, tensors, motion.path == "linear", False, invalid_rows)
        else:
            bodies = cls(scene, motion, _deforming(scene, *columns), True, True)
            bodies._invalid_rows = bodies._find_invalid_rows()
        if wait:
            bodies._raise_invalid(bodies._first_invalid_rows().tolist())
        return bodies

    @classmethod
    def of_columns(cls, meshes: MeshSet, columns: Mapping[str, Tensor], linear_path: bool = False) -> MovingBodies:
        """Bodies whose columns have been validated, for example by the ranks that sent them: nothing is checked, now or
        later.

        Args:
            meshes: of the bodies.
            columns: "mesh_index" (N,), those of a `RigidMotion` or `VertexMotion` by the names of their attributes, and
                optional columns of a `Scene`; for rigid bodies also "radius" (N,), if it differs from the radius of the
                mesh (negative: no pair contains the body). Other names are ignored.
            linear_path: as for a motion with path="linear".

        Example:
            >>> some = pgccd.MovingBodies.of_columns(meshes, {name: x[rows] for name, x in bodies.columns.items()})
        """
        optional = {name: columns[name] for name in OPTIONAL_COLUMNS if name in columns}
        index = columns["mesh_index"]
        radius = columns["radius"] if "radius" in columns else meshes.radius.index_select(0, index)
        scene = Scene._of_checked(meshes, index, radius, **optional)
        deforming = "x_t0" in columns
        if deforming:
            tensors = _deforming(scene, columns["x_t0"], columns["x_t1"])
        else:
            position_t0, position_t1, *turn = (columns[name] for name in _OF_MOTION)
            tensors = [index, position_t0, position_t1, radius, *turn]
        return cls(scene, None, tensors, linear_path or deforming, deforming)

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

    def _swept(self, in_other_search: Tensor | None = None) -> ops.Swept:
        """The operators' `swept` argument: swept spheres, filters and boxes.

        Args:
            in_other_search: (N,) uint8, nonzero for bodies whose pairs with each other another search finds.
        """
        scene = self.scene
        filters = scene.group, scene.mask, scene.world, scene.static
        return self.centre_t0, self.centre_t1, self.reach, *filters, in_other_search, self.boxes

    def stoppable(self) -> MovingBodies:
        """The same rigid bodies, with spheres and boxes that contain them wherever they are stopped or slowed down on
        their way: a shortened path is rounded (docs/explanation/exactness.md, section 12). Spheres about origins
        contain them already.
        """
        if self.scene.meshes.is_centred:
            return self
        start, end, rotation = self.tensors[1], self.tensors[2], self.tensors[5]
        furthest = torch.maximum(start.abs(), end.abs()).amax(1)
        turn, arm = (_sum_of_three(v.abs()) for v in (rotation, self.centre_t0 - start))
        stray = 2.0**-48 * furthest + 2.0**-51 * turn * (self.reach + arm)
        grown = copy.copy(self)
        # An invalid value may have made it NaN.
        grown.reach = torch.where(self.radius < 0.0, self.radius, (self.reach + stray) * (1.0 + 2.0**-50))
        if self.boxes is not None:
            unit, growth = self.boxes[:, 0].double(), self.boxes[:, 1].double()
            grown.boxes = self.boxes.clone()
            grown.boxes[:, 1] = ((growth + stray / unit) * (1.0 + 2.0**-22)).float()  # rounded up
        return grown

    @property
    def _is_off_centre(self) -> bool:
        """Whether SBV centres are not the positions: some mesh of rigid bodies has its origin elsewhere."""
        return not (self.deforming or self.scene.meshes.is_centred)

    def _enlarge(self, thickness: Tensor | None) -> None:
        """Finds spheres of meshes off centre and of thick bodies, and boxes."""
        scene, meshes, tensors = self.scene, self.scene.meshes, self.tensors
        is_checked = self._motion is None
        if not is_checked and (meshes.has_boxes or self._is_off_centre):
            tensors = [scene._sound_index, *tensors[1:]]
        if self._is_off_centre:
            spheres = ops.moving_spheres(meshes.tensors, tensors, self.linear_path)
            self.centre_t0, self.centre_t1, self.reach = spheres
        if thickness is not None:
            self.reach = (self.reach + thickness) * (1.0 + 2.0**-50)
        if not is_checked and self.reach is not self.radius:
            # An invalid value may have made it NaN.
            self.reach = torch.where(self.radius < 0.0, self.radius, self.reach)
        if meshes.has_boxes:
            self.boxes = ops.moving_boxes((meshes.tensors, tensors, None if self.deforming else self.linear_path))

    def _first_invalid_rows(self) -> Tensor:
        """(F,) int64: for each check the first invalid row, or a number past the last row; then 1 if any row is
        invalid, else 0.
        """
        if self._invalid_rows is None:
            self._invalid_rows = torch.zeros(1, dtype=torch.int64, device=self.device)
        return self._invalid_rows

    def check(self) -> None:
        """Validates poses and columns again, for a stage called alone: they may have changed. Synchronises with a GPU.

        Raises:
            ValueError: naming the column, the row and the value.
        """
        if self._motion is not None and not torch.compiler.is_compiling():
            self._raise_invalid(self._find_invalid_rows().tolist())

    def _find_invalid_rows(self) -> Tensor:
        if not self.deforming:
            _, position_t0, position_t1, _, orientation, rotation = self.tensors[:6]
            return _sound_radii(self.scene, position_t0, position_t1, orientation, rotation)[1]
        return first_invalid_rows(self._validation.columns)

    @property
    def _validation(self) -> Validation:
        """The meaning of the values of `_first_invalid_rows`."""
        if self._motion is None:
            return Validation([])
        columns = [*self._motion._checked(), *scene_columns(self.scene)]
        if self.deforming:
            columns.append(Checked("motion", self.radius, RADIUS, "body"))
        return Validation(columns)

    def _raise_invalid(self, first: Sequence[int]) -> None:
        """Raises ValueError if the values of `_first_invalid_rows` include an invalid row."""
        if first[-1]:
            self._validation.raise_from(first)

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


def _sound_radii(
    scene: Scene, position_t0: Tensor, position_t1: Tensor, orientation: Tensor, rotation: Tensor
) -> tuple[Tensor, Tensor]:
    """Radii and `_first_invalid_rows` of rigid bodies with these columns of a motion."""
    moving = position_t0, position_t1, orientation, rotation
    return ops.sound_radii(scene.meshes.radius, scene.mesh_index, scene._given_radius, *moving, scene.margin)


def _sum_of_three(v: Tensor) -> Tensor:
    """(N,): the sum of the columns of (N, 3), rounded alike on all devices."""
    x, y, z = v.unbind(1)
    return x + y + z


def _deforming(scene: Scene, x_t0: Tensor, x_t1: Tensor) -> list[Tensor]:
    layout = scene.layout
    position_t0, position_t1, radius, blocks_t0, blocks_t1, local_vertices = ops.refit(
        scene.meshes.tensors,
        scene._sound_index,
        x_t0,
        x_t1,
        layout.vertex_begin,
        layout.block_begin,
        layout.block_count,
    )
    moving = [radius, x_t0, x_t1, blocks_t0, blocks_t1, layout.vertex_begin, layout.block_begin, local_vertices]
    return [scene.mesh_index, position_t0, position_t1, *moving]
