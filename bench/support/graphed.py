"""A step of detection as a CUDA graph: launched by one call, in a fixed capacity."""

from __future__ import annotations

import torch

import pgccd


class GraphedDetection:
    """`detect(report="first")` of one scene, captured once and replayed with other poses.

    Args:
        scene: on a GPU.
        motion: any of its motions; replays take theirs in its place.
        needed: what a step like those to come needs; a quarter more is given.
    """

    def __init__(self, scene: pgccd.Scene, motion: pgccd.RigidMotion, needed: pgccd.Capacity) -> None:
        self._columns = [column.clone() for column in columns_of(motion)]
        capacity = needed.times(1.25)

        def detect() -> pgccd.PaddedContacts:
            motion = pgccd.RigidMotion.of_checked(*self._columns)
            return pgccd.detect(scene, motion, report="first", capacity=capacity)

        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            detect()  # what is set up once is not captured
        torch.cuda.current_stream().wait_stream(aside)
        self.graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self.graph):
            self.found = detect()

    def load(self, motion: pgccd.RigidMotion) -> None:
        """Puts poses where the graph reads them."""
        for column, new in zip(self._columns, columns_of(motion), strict=True):
            column.copy_(new)

    def replay(self) -> None:
        """Makes the step with the poses loaded last."""
        self.graph.replay()


def columns_of(motion: pgccd.RigidMotion) -> tuple[torch.Tensor, ...]:
    """As `RigidMotion.of_checked` takes them."""
    return motion.position_t0, motion.orientation_t0, motion.position_t1, motion.rotation
