"""Functions of the user in a loop of steps of a `World`: their arguments, and checks of what they return."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pgccd import arguments
from pgccd.distributed.comm.exchange import Columns
from pgccd.geometry.scene_columns import bool_column
from pgccd.motion.paths import RigidMotion


@dataclass(frozen=True, eq=False)
class Bodies:
    """The own bodies of one rank, as passed to user functions. In a graph, rows with negative ids are padding; their
    values have no effect.

    Attributes:
        id: (N,) int64.
        position: (N, 3) float64, length units, world frame: positions of the origins.
        mesh_index: (N,) int32.
        payload: by name, (N, ...).
        step: (1,) int64: number of steps made.
    """

    id: Tensor
    position: Tensor
    mesh_index: Tensor
    payload: Columns
    step: Tensor


#: The motion of the next step; or (motion, new values of the payload by name), which the response finds in the bodies.
Motion = Callable[[Bodies], RigidMotion | tuple[RigidMotion, Columns]]
#: From the bodies at t0, their motion, and the first toi of each (N,), inf without a contact, 0 for all if the search
#: of any rank was incomplete: the position at the end of the step as "position", and new values of the payload by name.
Response = Callable[[Bodies, RigidMotion, Tensor], Columns]
#: The bodies (N,) bool that may be stopped in the next step.
Movable = Callable[[Bodies], Tensor]
#: From the bodies after a step, the motion and the answer that the response was passed, and the contacts of the whole
#: step that this rank found, as pairs (K, 2) int64 of ids, -1 for padding, and toi (K,): numbers (k,) int64. Each
#: contact is found by one rank.
Tally = Callable[[Bodies, RigidMotion, Tensor, Tensor, Tensor], Tensor]


def bodies_of(columns: Columns, step: Tensor) -> Bodies:
    payload = {name[1:]: column for name, column in columns.items() if name.startswith(".")}
    return Bodies(columns["id"], columns["position"], columns["mesh_index"], payload, step)


def motion_of(motion: Motion, bodies: Bodies) -> tuple[RigidMotion, Bodies, Columns]:
    """The motion of a step, the bodies with the values that the user's function changed, and the changed values."""
    made, changed = motion(bodies), dict[str, Tensor]()
    if isinstance(made, tuple) and len(made) == 2 and isinstance(made[1], dict):
        made, changed = made
    if not isinstance(made, RigidMotion):
        expected = "a pgccd.RigidMotion, or (motion, new values of the payload by name), to be returned"
        raise TypeError(f"motion: expected {expected}, got {arguments.describe(made)}")
    for name, values in changed.items():
        if name not in bodies.payload:
            raise ValueError(f"motion: {name!r} is not a payload of this world, which has {sorted(bodies.payload)}")
        before = bodies.payload[name]
        if not isinstance(values, Tensor) or values.shape != before.shape or values.dtype != before.dtype:
            expected = f"{tuple(before.shape)} {arguments.dtype_name(before.dtype)}"
            raise ValueError(f"motion: {name!r}: expected {expected}, got {arguments.describe(values)}")
    return made, replace(bodies, payload=bodies.payload | changed), changed


def tallied(
    tally: Tally, bodies: Bodies, new: Columns, motion: RigidMotion, answer: Tensor, pairs: Tensor, toi: Tensor
) -> Tensor:
    """(k,) int64: what the user's function counts of a step, given the values of the bodies after it."""
    payload = bodies.payload | {name: values for name, values in new.items() if name != "position"}
    values = tally(replace(bodies, position=new["position"], payload=payload), motion, answer, pairs, toi)
    if not isinstance(values, Tensor) or values.dtype != torch.int64 or values.dim() != 1:
        raise TypeError(f"tally: expected an int64 tensor (k,) to be returned, got {arguments.describe(values)}")
    return values


def with_position(new: Columns) -> Columns:
    if not isinstance(new, dict) or "position" not in new:
        raise TypeError(f'response: expected tensors by name, "position" among them, got {arguments.describe(new)}')
    return new


def fixed_of(movable: Movable | None, bodies: Bodies) -> Tensor | None:
    """(N,) bool: the bodies that may not be stopped; None: none."""
    if movable is None:
        return None
    return bool_column(movable(bodies), "movable", len(bodies.id), bodies.id.device) == 0
