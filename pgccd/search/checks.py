"""Argument checks shared by several stages."""

import warnings
from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.geometry.coordinates import FEW_UNITS
from pgccd.geometry.mesh import SMALLEST_RADIUS
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import RigidMotion, VertexMotion
from pgccd.motion.trajectory import Trajectory

#: What to do about surfaces that intersect at t = 0: see `pgccd.detect`.
Initial = Literal["report", "assume_free"]
INITIALS: tuple[str, ...] = get_args(Initial)

#: The default tolerance, relative to the smaller SBV radius of a pair.
RELATIVE_TOLERANCE = 1e-6


def warn_of_only_body(scene: Scene, motion: RigidMotion | VertexMotion | Trajectory) -> None:
    """Warns that the only body of a user's scene can have no contact, if it is not tested against itself."""
    deforms = isinstance(motion, VertexMotion) or (isinstance(motion, Trajectory) and motion.orientation is None)
    if not scene._is_of_user or torch.compiler.is_compiling() or (deforms and len(scene._self_colliding)):
        return
    advice = "add the bodies that it may meet"
    if deforms:
        advice += ", or pass self_collision=True to test it against itself"
    elif scene.self_collision is not None:
        advice += "; self_collision applies to bodies that deform (VertexMotion)"
    warnings.warn(f"scene: it has one body, so no contact can be found: {advice}", UserWarning, stacklevel=3)


def warn_of_rounded_positions(scene: Scene, motion: RigidMotion | VertexMotion | Trajectory) -> None:
    """Warns that float32 has rounded the positions of a rigid body to multiples of its own size."""
    if isinstance(motion, VertexMotion) or not motion._is_of_float32 or torch.compiler.is_compiling():
        return
    if isinstance(motion, Trajectory):
        if motion.orientation is None:
            return
        ends = motion.position
    else:
        ends = torch.stack([motion.position_t0, motion.position_t1])
    largest = ends.detach().abs().amax(dim=(0, 2)).to(torch.float32)
    unit = (torch.nextafter(largest, torch.full_like(largest, torch.inf)) - largest).to(torch.float64)
    radius = scene._size
    has_size = radius > SMALLEST_RADIUS  # a single point has none
    is_lost = has_size & (radius <= FEW_UNITS * unit)
    if bool(is_lost.any()):
        body = int(is_lost.long().argmax())
        warnings.warn(
            f"motion: float32 has rounded the positions of {int(is_lost.sum())} of {len(unit)} bodies: that of body "
            f"{body}, of radius {float(radius[body]):.3g}, is a multiple of {float(unit[body]):.3g}. Give float64, or "
            "positions relative to a point nearby",
            UserWarning,
            stacklevel=3,
        )


def check_separation(min_separation: float | Tensor) -> float:
    """The value, if it is a length in [0, 1e150]."""
    return arguments.length(min_separation, "min_separation")


def separation_value(min_separation: float | Tensor) -> float:
    """As `check_separation`, of a value that may require grad."""
    if isinstance(min_separation, Tensor):
        arguments.refuse_transforms(min_separation, "min_separation")
    if isinstance(min_separation, Tensor) and arguments.is_differentiated(min_separation):
        return check_separation(min_separation.detach())
    return check_separation(min_separation)


def operator_tolerance(tolerance: float | None) -> float:
    """The tolerance for the operators, where a negative value is relative to the smaller radius of each pair."""
    return -RELATIVE_TOLERANCE if tolerance is None else arguments.length(tolerance, "tolerance")


def tests_start(initial: Initial) -> bool:
    """The operators' argument of that name."""
    arguments.choice(initial, "initial", INITIALS)
    return initial == "report"


def check_tensor(
    values: Tensor, name: str, dtype: torch.dtype, shape: Sequence[int | str], device: torch.device
) -> None:
    """Raises unless the values are a tensor of this dtype and shape (see `arguments.shape`) on the device."""
    if not isinstance(values, Tensor) or values.dtype != dtype:
        kind = arguments.dtype_name(dtype)
        article = "an" if kind.startswith("i") else "a"
        raise TypeError(f"{name}: expected {article} {kind} tensor, got {arguments.describe(values)}")
    arguments.shape(values, name, shape, device)


def check_pairs(pairs: Tensor, scene: Scene, deforms: bool, ascending: bool = False) -> Tensor:
    """Validates dtype, shape, device and body indices of `pairs`, and returns it.

    Args:
        deforms: whether the bodies deform, so that they may collide with themselves.
        ascending: whether rows must be sorted and unique.
    """
    pairs = arguments.as_tensor(pairs, "pairs")
    check_tensor(pairs, "pairs", torch.int64, ("P", 2), scene.device)
    count = scene.body_count
    i, j = pairs.unbind(dim=1)
    in_order = (i >= 0) & (i < j) & (j < count)
    expected = f"pairs: expected rows 0 <= i < j < {count}"
    own = scene.self_collision
    if own is not None and deforms and len(scene._self_colliding):
        in_order |= (i == j) & (i >= 0) & (j < count) & own[i.clamp(0, count - 1)]
        expected += ", or (i, i) of a body that collides with itself"
    require(in_order, expected, pairs)
    if ascending:
        rises = (i[1:] > i[:-1]) | ((i[1:] == i[:-1]) & (j[1:] > j[:-1]))
        hint = "torch.unique(pairs, dim=0) makes them so"
        require(rises, f"pairs: expected rows sorted by i, then j, each once ({hint})", pairs[1:])
    return pairs.contiguous()


def require(valid: Tensor, message: str, values: Tensor) -> None:
    """Raises ValueError, with the first row of `values` (rows, ...) that is not valid (rows,), unless all are.

    On a GPU the assertion is asynchronous: it does not stall the stream.
    """
    if valid.device.type != "cpu" or torch.compiler.is_compiling():
        torch._assert_async(valid.all(), message)
    elif not bool(valid.all()):
        row = int((~valid).long().argmax())
        raise ValueError(f"{message}; row {row} is {values[row].tolist()}")
