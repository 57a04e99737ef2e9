"""Scenes: the standard nanorobot world in full swing, and moving spheres."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from pgccd import sim


class MixedWorld:
    """The standard world after `steps_before` steps, when nothing is left of the lattice it starts from.

    Iterating makes further steps: each gives the state as planned, before that step.
    """

    def __init__(
        self, robots: int, steps_before: int, device: torch.device | str = "cpu", seed: int = 0, pattern: str = "random"
    ) -> None:
        world = sim.World(sim.WorldConfig(robots=robots, pattern=pattern, seed=seed), device=device)
        self._set(world, world.start(), 0)
        for _ in range(steps_before):
            self.advance()

    @classmethod
    def from_checkpoint(cls, checkpoint: sim.Checkpoint, device: torch.device | str = "cpu") -> MixedWorld:
        """The world of a run of the standard robot, where its checkpoint left it."""
        mixed = cls.__new__(cls)
        world = sim.World(checkpoint.config, device=device)
        mixed._set(world, checkpoint.state.to(world.device), checkpoint.steps_made)
        return mixed

    def _set(self, world: sim.World, state: sim.RobotState, steps_made: int) -> None:
        self.world = world
        self.state = state
        self.scene = world.scene(state.id)
        self.steps_made = steps_made

    def advance(self) -> sim.Step:
        """Makes one step."""
        step = sim.make_step(self.world, self.scene, self.state, self.steps_made)
        self.state = step.after
        self.steps_made += 1
        return step

    def __iter__(self) -> Iterator[sim.RobotState]:
        while True:
            yield self.world.plan(self.state, self.steps_made)
            self.advance()


@dataclass
class MovingSpheres:
    """Spheres of radius 1 whose centres move straight."""

    position_t0: np.ndarray  #: (N, 3) float64
    position_t1: np.ndarray
    radius: float = 1.0

    def meet(self, pairs: np.ndarray) -> np.ndarray:
        """(P,) bool: do the two come within the sum of their radii at some time of the step?"""
        return self.gap(pairs) <= 0.0

    def gap(self, pairs: np.ndarray) -> np.ndarray:
        """(P,) least squared distance over the step, less the squared sum of radii."""
        start = self.position_t0[pairs[:, 1]] - self.position_t0[pairs[:, 0]]
        end = self.position_t1[pairs[:, 1]] - self.position_t1[pairs[:, 0]]
        travel = end - start
        length_squared = (travel * travel).sum(1)
        with np.errstate(invalid="ignore", divide="ignore"):
            t = np.nan_to_num(np.clip(-(start * travel).sum(1) / length_squared, 0.0, 1.0))
        nearest = start + t[:, None] * travel
        return (nearest * nearest).sum(1) - (2.0 * self.radius) ** 2


def random_spheres(count: int, seed: int, speed: float = 0.1, fraction: float = 0.25) -> MovingSpheres:
    """Centres uniform in a box that the spheres would fill to `fraction`, free to overlap; steps as in the standard
    world.

    On average 4 x `fraction` spheres overlap pairwise at rest for each sphere: about one pair a body.
    """
    random = np.random.default_rng(seed)
    edge = (count * 4.0 / 3.0 * math.pi / fraction) ** (1.0 / 3.0)
    position = random.uniform(-0.5 * edge, 0.5 * edge, (count, 3))
    direction = random.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    # The standard world's speeds: uniform from half the mean to half as much again.
    length = speed * random.uniform(0.5, 1.5, (count, 1))
    return MovingSpheres(position, position + length * direction)
