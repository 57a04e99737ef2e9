"""The nanorobot model: its configuration, its state, and the rules of motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor

from pgccd import arguments, ops
from pgccd.geometry.mesh import Mesh
from pgccd.geometry.mesh_set import MeshSet
from pgccd.geometry.scene import Scene
from pgccd.motion.paths import RigidMotion
from pgccd.sim.nanorobot import robot_mesh

Pattern = Literal["random", "skewed"]
PATTERNS: tuple[Pattern, ...] = get_args(Pattern)
#: The columns that a plan changes, in the order of `ops.simulate_plan` and `ops.simulate_commit`.
PLANNED = ("velocity", "angular_velocity", "target", "stay_until")
# They define the motion of a planned step.
_MOVING = ("id", "position", "orientation", "velocity", "angular_velocity")


@dataclass(frozen=True)
class ModelConfig:
    """Configuration of a world. Lengths are in units of the largest SBV radius of its meshes.

    Attributes:
        robots: their number, below 2^31.
        pattern: "random": straight courses in random directions. "skewed": each robot moves to one of the eight corners
            of the box (first the nearest), stays there for some time, then moves along an edge to another corner. A
            robot that is blocked turns to the nearest corner.
        seed: any int64.
        spacing: lattice spacing at the start, > 2. With 2.56 the SBVs fill 25 % of the box.
        speed: mean displacement per step; a robot moves 0.5 to 1.5 times as far.
        spin: largest rotation per step, radians.
        course_steps: mean number of steps on one course (random, and while staying in a corner).
        resume_steps: mean number of steps after which a robot that was reversed turns to its corner again.
        stay_steps: shortest and longest stay in a corner, steps.
        arrival: distance from the corner at which a robot has arrived, relative to the smallest box edge.
        crowd: a robot that other robots reverse within this distance of its corner stays there too.
        stopping_round: >= 1. A step is resolved in rounds: robots stop before their first collision, and each round
            finds robots that would collide with stopped ones. Robots found in this round or a later one do not move in
            the step. With a larger number, more robots move part of their way, and a step takes more rounds.

    Raises:
        ValueError: naming the field.

    Example:
        >>> config = pgccd.sim.ModelConfig(robots=1000, pattern="skewed", seed=7)
    """

    robots: int = 10_000
    pattern: Pattern = "random"
    seed: int = 0
    spacing: float = 2.56
    speed: float = 0.1
    spin: float = 0.1
    course_steps: float = 32.0
    resume_steps: float = 8.0
    stay_steps: tuple[int, int] = (100, 300)
    arrival: float = 0.1
    crowd: float = 0.5
    stopping_round: int = 4

    def __post_init__(self) -> None:
        arguments.choice(self.pattern, "pattern", PATTERNS)
        for name, low, high in (("robots", 1, 2**31 - 1), ("seed", -(2**63), 2**63 - 1), ("stopping_round", 1, 2**31)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise ValueError(f"{name}: expected an integer in [{low}, {high}], got {value!r}")
        if not 2.0 < arguments.number(self.spacing, "spacing") <= 1e6:
            raise ValueError(f"spacing: expected more than 2 radii (and at most 1e6), got {self.spacing}")
        for name in ("speed", "spin", "arrival", "crowd"):
            if not 0.0 <= arguments.number(getattr(self, name), name) < math.inf:
                raise ValueError(f"{name}: expected a finite number >= 0, got {getattr(self, name)}")
        for name in ("course_steps", "resume_steps"):
            if not 1.0 <= arguments.number(getattr(self, name), name) < math.inf:
                raise ValueError(f"{name}: expected a finite number >= 1, got {getattr(self, name)}")
        if not isinstance(self.stay_steps, tuple) or len(self.stay_steps) != 2:
            raise TypeError(f"stay_steps: expected two numbers, got {arguments.describe(self.stay_steps)}")
        shortest, longest = self.stay_steps
        if not 0 <= shortest <= longest < 2**31:
            raise ValueError(f"stay_steps: expected 0 <= shortest <= longest, got {self.stay_steps}")
        # If the walls are two steps apart, a robot that turns at one does not reach the other.
        fastest = 1.5 * self.speed
        space = min(lattice_cells(self.robots)) * self.spacing - 2.0
        if 2.0 * fastest > space:
            raise ValueError(
                f"speed: a box with {space:.3g} radii of free space takes at most {space / 3.0:.3g}, got {self.speed}"
            )


class WorldIntegers(NamedTuple):
    """Integer parameters of the operators, as the struct of that name in csrc/kernels/simulate/world.h."""

    robot_count: int
    cells_x: int
    cells_y: int
    cells_z: int
    pattern: int
    seed: int
    stay_shortest: int
    stay_longest: int


class WorldScales(NamedTuple):
    """Real parameters of the operators, as the struct of that name in csrc/kernels/simulate/world.h."""

    radius: float
    spacing: float
    speed: float
    spin: float
    course_change: float
    resumption: float
    arrival: float
    crowd: float


def lattice_cells(robots: int) -> tuple[int, int, int]:
    """Cells per axis of the smallest near-cubic lattice with room for all robots."""

    def first(enough: Any, guess: float) -> int:
        cells = max(1, int(guess) - 1)
        while not enough(cells):
            cells += 1
        return cells

    x = first(lambda n: n**3 >= robots, robots ** (1 / 3))
    y = first(lambda n: x * n**2 >= robots, (robots / x) ** (1 / 2))
    return x, y, -(-robots // (x * y))


@dataclass
class RobotState:
    """Robots as columns on one device: any subset of a world's robots, ids ascending.

    Attributes:
        id: (N,) int64, stable global ids.
        position: (N, 3) float64, SBV centres, world frame, length units.
        orientation: (N, 4) float64 unit quaternions (w, x, y, z).
        velocity: (N, 3) float64, world frame, length units per step.
        angular_velocity: (N, 3) float64, world frame, radians per step.
        target: (N,) int64: the target corner 0 to 7 (bit k: upper end of axis k), -1 if none.
        stay_until: (N,) int64: the step in which its stay there ends, -1 while it is moving there.
    """

    id: Tensor
    position: Tensor
    orientation: Tensor
    velocity: Tensor
    angular_velocity: Tensor
    target: Tensor
    stay_until: Tensor

    def __len__(self) -> int:
        return self.id.shape[0]

    @property
    def columns(self) -> dict[str, Tensor]:
        """All columns, by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def moving_columns(self) -> dict[str, Tensor]:
        """The columns that define the motion of a planned step."""
        return {name: getattr(self, name) for name in _MOVING}

    def map(self, change: Callable[[Tensor], Tensor]) -> RobotState:
        """The state with `change` applied to every column, for example `Tensor.clone`."""
        return RobotState(*map(change, self.columns.values()))

    def to(self, device: torch.device | str) -> RobotState:
        """The state on another device."""
        return self.map(lambda column: column.to(device))


class Model:
    """A world on one device: its meshes, its box, and the rules of its robots.

    All rules are functions of (seed, id, step) and the state, computed by pgccd's operators: bitwise equal on every
    device, with any number of threads or ranks.

    Args:
        config: of the world.
        meshes: the kinds of robots, each with origin="centroid"; the robot with id k is of kind k modulo their number.
            Default: `robot_mesh()`.
        device: of states and scenes.

    Attributes:
        config: of the world.
        meshes: the kinds of robots.
        device: of states and scenes.
        radius: largest SBV radius, length units.
        cells: number of lattice cells along x, y and z.
        half_extent: upper ends of the box, which is centred on the origin, length units; the SBVs of robots stay
            inside.

    Raises:
        ValueError: the origin of a mesh is not its centroid.

    Example:
        >>> model = pgccd.sim.Model(pgccd.sim.ModelConfig(robots=1000))
        >>> state = model.plan(model.start(), step=0)
        >>> hits = pgccd.detect(model.scene(state.id), model.motion(state))
    """

    def __init__(
        self, config: ModelConfig, meshes: Sequence[Mesh] | None = None, device: torch.device | str = "cpu"
    ) -> None:
        self.config = config
        self.meshes = MeshSet(list(meshes) if meshes is not None else [robot_mesh()], device)
        self.device = self.meshes.device
        for index, mesh in enumerate(self.meshes.meshes):
            # Distances between robots are those of their SBV centres.
            if bool(mesh.centre_offset.any()):
                raise ValueError(
                    f'meshes[{index}]: robots turn about their SBV centres: expected a Mesh with origin="centroid", '
                    f"got one whose SBV centre is {mesh.centre_offset.tolist()} from its origin"
                )
        self.radius = max(mesh.radius for mesh in self.meshes.meshes)
        self.cells = lattice_cells(config.robots)
        self.half_extent = tuple(0.5 * (config.spacing * self.radius) * cells for cells in self.cells)
        self._integers = WorldIntegers(
            config.robots, *self.cells, PATTERNS.index(config.pattern), config.seed, *config.stay_steps
        )
        self._scales = WorldScales(
            self.radius,
            config.spacing,
            config.speed,
            config.spin,
            1.0 / config.course_steps,
            1.0 / config.resume_steps,
            config.arrival,
            config.crowd,
        )

    def start(self, id: Tensor | None = None) -> RobotState:
        """The initial state of the robots `id` (N,) int64, ascending; default all. No two SBVs overlap."""
        if id is None:
            id = torch.arange(self.config.robots, device=self.device)
        return RobotState(id, *ops.simulate_start(id, self._integers, self._scales))

    def plan(self, state: RobotState, step: int | Tensor) -> RobotState:
        """The state with the velocities of step number `step` (from 0): new courses, and reflection at the walls.

        Args:
            step: a number, or (1,) int64 on the device, which is not read by the host.
        """
        if not isinstance(step, Tensor):
            if not 0 <= step < 2**32:
                raise ValueError(f"step: expected a value in [0, 2^32), got {step}")
            step = torch.full((1,), step, dtype=torch.int64, device=self.device)
        tensors = list(state.columns.values())
        planned = ops.simulate_plan(tensors, step, self._integers, self._scales)
        return replace(state, **dict(zip(PLANNED, planned, strict=True)))

    def motion(self, state: RobotState, fraction: Tensor | None = None) -> RigidMotion:
        """The motion of a planned state's step; or of a `fraction` (N,) of it, at constant velocities. Its values are
        checked when it is used.
        """
        velocity, spin = state.velocity, state.angular_velocity
        if fraction is not None:
            velocity, spin = fraction[:, None] * velocity, fraction[:, None] * spin
        return RigidMotion._of_checked(state.position, state.orientation, state.position + velocity, spin)

    def scene(self, id: Tensor) -> Scene:
        """The scene of the robots `id` (N,) int64."""
        return Scene._of_checked(self.meshes, self.mesh_index(id))

    def mesh_index(self, id: Tensor) -> Tensor:
        """(N,) int32: the kinds of the robots `id` (N,) int64."""
        kinds = len(self.meshes)
        return (id % kinds).to(torch.int32) if kinds > 1 else torch.zeros_like(id, dtype=torch.int32)

    def describe(self) -> dict[str, Any]:
        """The configuration and values derived from it, as plain numbers."""
        box = [2.0 * half for half in self.half_extent]
        kinds = len(self.meshes)
        counts = [(self.config.robots + kinds - 1 - kind) // kinds for kind in range(kinds)]
        radii = [mesh.radius for mesh in self.meshes.meshes]
        volume = sum(count * 4.0 / 3.0 * math.pi * r**3 for count, r in zip(counts, radii, strict=True))
        derived = {"radius": self.radius, "box": box, "sbv_volume_fraction": volume / math.prod(box)}
        return asdict(self.config) | derived
