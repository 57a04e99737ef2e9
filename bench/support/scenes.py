"""Scenes: the standard nanorobot world after it has left the lattice, and moving spheres."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from pgccd import distributed, sim
from pgccd.sim.model import Pattern


class MixedWorld:
    """The standard world after `steps_before` steps, enough to leave the lattice of its start.

    Iterating makes further steps and yields each planned state, before its step.
    """

    def __init__(
        self,
        robots: int,
        steps_before: int,
        device: torch.device | str = "cpu",
        seed: int = 0,
        pattern: Pattern = "random",
    ) -> None:
        model = sim.Model(sim.ModelConfig(robots=robots, pattern=pattern, seed=seed), device=device)
        self._set(model, model.start(), 0)
        for _ in range(steps_before):
            self.advance()

    @classmethod
    def from_checkpoint(cls, checkpoint: sim.Checkpoint, device: torch.device | str = "cpu") -> MixedWorld:
        """The world of a checkpoint of the standard robot."""
        mixed = cls.__new__(cls)
        model = sim.Model(checkpoint.config, device=device)
        mixed._set(model, checkpoint.state.to(model.device), checkpoint.steps_made)
        return mixed

    def _set(self, model: sim.Model, state: sim.RobotState, steps_made: int) -> None:
        self.model = model
        self.scene = model.scene(state.id)
        self.steps_made = steps_made
        self._simulation = sim.Simulation.create(distributed.Alone(), model, None, state, graph=False)

    @property
    def state(self) -> sim.RobotState:
        """All robots after the last step."""
        return self._simulation.state

    def advance(self) -> sim.Step:
        """Makes one step."""
        step = self._simulation.step(self.steps_made)
        assert isinstance(step, sim.Step)
        self.steps_made += 1
        return step

    def __iter__(self) -> Iterator[sim.RobotState]:
        while True:
            yield self.model.plan(self.state, self.steps_made)
            self.advance()


@dataclass
class MovingSpheres:
    """Spheres whose centres move along straight lines."""

    position_t0: np.ndarray  #: (N, 3) float64
    position_t1: np.ndarray
    radius: float | np.ndarray = 1.0  #: of all, or (N,)

    def meet(self, pairs: np.ndarray) -> np.ndarray:
        """Do the spheres of each pair meet at some time of the step? (P,) bool."""
        return self.gap(pairs) <= 0.0

    def gap(self, pairs: np.ndarray) -> np.ndarray:
        """Least squared distance over the step less the squared sum of radii, (P,)."""
        start = self.position_t0[pairs[:, 1]] - self.position_t0[pairs[:, 0]]
        end = self.position_t1[pairs[:, 1]] - self.position_t1[pairs[:, 0]]
        travel = end - start
        length_squared = (travel * travel).sum(1)
        with np.errstate(invalid="ignore", divide="ignore"):
            t = np.nan_to_num(np.clip(-(start * travel).sum(1) / length_squared, 0.0, 1.0))
        nearest = start + t[:, None] * travel
        radius = np.broadcast_to(self.radius, len(self.position_t0))
        return (nearest * nearest).sum(1) - radius[pairs].sum(1) ** 2


def random_spheres(
    count: int, seed: int, speed: float = 0.1, fraction: float = 0.25, size_ratio: float = 1.0
) -> MovingSpheres:
    """Centres uniform in a box whose volume times `fraction` is that of the spheres, free to overlap; steps as in the
    standard model, in proportion to the radii. Radii are 1, or between 1 / `size_ratio` and 1, uniform in their
    logarithm.

    For equal sizes at rest, on average 4 x `fraction` pairs overlap per sphere: about one pair per body.
    """
    random = np.random.default_rng(seed)
    sizes = np.geomspace(1.0 / size_ratio, 1.0, 31)
    radius = 1.0 if size_ratio == 1.0 else random.choice(sizes, count)
    volume = 4.0 / 3.0 * math.pi * np.sum(np.broadcast_to(radius, count) ** 3)
    position = random.uniform(-0.5, 0.5, (count, 3)) * (volume / fraction) ** (1.0 / 3.0)
    return _stirred(random, position, radius, speed)


def spheres_on_a_huge_one(count: int, seed: int, speed: float = 0.1) -> MovingSpheres:
    """Pebbles of radius 1 in a layer on a sphere as large as the scene, with about one pair of pebbles per body."""
    random = np.random.default_rng(seed)
    width = math.sqrt(count * 4.0 / 3.0 * math.pi)
    huge = 4.0 * width
    position = random.uniform(-0.5, 0.5, (count, 3)) * [width, width, 4.0]
    position[:, 2] += np.sqrt(huge**2 - (position[:, :2] ** 2).sum(1))
    position[0] = 0.0
    radius = np.ones(count)
    radius[0] = huge
    return _stirred(random, position, radius, speed * (radius == 1.0))


def clustered_spheres(count: int, seed: int, speed: float = 0.1, clusters: int = 1000) -> MovingSpheres:
    """Gaussian clusters of spheres of radius 1, far from one another."""
    random = np.random.default_rng(seed)
    middle = 100.0 * clusters ** (1.0 / 3.0) * random.uniform(-1.0, 1.0, (clusters, 3))
    deviation = (count / clusters) ** (1.0 / 3.0)
    position = middle[random.integers(0, clusters, count)] + deviation * random.normal(size=(count, 3))
    return _stirred(random, position, 1.0, speed)


def _stirred(
    random: np.random.Generator, position: np.ndarray, radius: float | np.ndarray, speed: float | np.ndarray
) -> MovingSpheres:
    count = len(position)
    direction = random.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    # The standard world's speeds: uniform from 0.5 to 1.5 times the mean.
    length = speed * radius * random.uniform(0.5, 1.5, count)
    return MovingSpheres(position, position + length[:, None] * direction, radius)
