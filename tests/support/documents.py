"""Pages and examples, run as written; and their loops, in which no two bodies may overlap after any step."""

from __future__ import annotations

import re
import runpy
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from oracle.boxes import least_gap

import pgccd

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
# Rounding of poses, relative to boxes of about one unit.
_ROUNDING = 1e-12


def blocks(page: Path) -> list[str]:
    """The Python blocks of a page."""
    return re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)


PAGES = [page for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))) if blocks(page)]


def run_page(page: Path) -> dict[str, Any]:
    """Runs its Python blocks in order in one namespace, and returns that."""
    names: dict[str, Any] = {}
    for number, block in enumerate(blocks(page), 1):
        exec(compile(block, f"{page.name}, Python block {number}", "exec"), names)
    return names


def run_document(path: Path) -> dict[str, Any]:
    """Runs a page or an example, and returns its namespace."""
    return run_page(path) if path.suffix == ".md" else runpy.run_path(str(path), run_name="__main__")


@contextmanager
def steps_recorded() -> Iterator[list[pgccd.RigidMotion]]:
    """Collects the motions that a loop makes by `RigidMotion.from_velocity`, one a step."""
    made: list[pgccd.RigidMotion] = []
    from_velocity = pgccd.RigidMotion.from_velocity

    def recorded(*given: Any, **more: Any) -> pgccd.RigidMotion:
        made.append(from_velocity(*given, **more))
        return made[-1]

    with mock.patch.object(pgccd.RigidMotion, "from_velocity", recorded):
        yield made


def last_poses(names: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Positions and orientations after a loop, from its namespace."""
    if "world" in names:
        return names["world"].position.numpy(), names["world"].payload["orientation"].numpy()
    return names["position"].numpy(), names["orientation"].numpy()


def check_loop(steps: list[pgccd.RigidMotion], names: dict[str, Any], box: pgccd.Mesh) -> None:
    """No two bodies overlap after any step, and each step moves them.

    Args:
        steps: of the loop, see `steps_recorded`.
        names: its namespace.
        box: the mesh of all bodies; the origin is its centre.
    """
    half = box.vertices.abs().amax(dim=0).numpy()
    corners = (box.vertices.abs().numpy() > half - 1e-9).all(axis=1)
    assert corners.sum() == 8, "the mesh is not a box"
    states = [(step.position_t0.numpy(), step.orientation_t0.numpy()) for step in steps] + [last_poses(names)]
    gaps = np.array([least_gap(*state, half) for state in states])
    overlapping = np.flatnonzero(gaps < -_ROUNDING).tolist()
    assert overlapping == [], f"bodies overlap after steps {overlapping}, by up to {-gaps.min()}"
    positions = [position for position, _ in states]
    moved = np.array([np.abs(after - before).sum() for before, after in zip(positions, positions[1:], strict=False)])
    wanted = np.array([float((step.position_t1 - step.position_t0).abs().sum()) for step in steps])
    fractions = moved / wanted
    assert fractions.min() > 1e-3 and fractions.mean() > 0.03, f"the loop hardly moves: {fractions}"
