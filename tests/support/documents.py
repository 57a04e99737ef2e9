"""Pages and examples, run as written; and their loops, in which no two bodies may overlap after any step."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from oracle.boxes import axes_of, least_gap
from oracle.convex import Convex, gap

import pgccd
from support.comments import run_checked

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
#: Documents with a loop that moves bodies: the name of their mesh, a box, and the number of motions before the loop.
LOOPS = {
    "README.md": ("box", 1),
    "cluster.md": ("rock", 0),
    "cuda_graphs.md": ("box", 1),
    "see_a_scene.md": ("box", 1),
    "02_simulation_loop.py": ("box", 0),
    "04_many_ranks.py": ("box", 0),
}
#: Documents whose loop moves bodies that are not boxes; they assert themselves that nothing touches at its end.
CHECKED_BY_THEMSELVES = {"06_environments.py", "08_impulses.py", "12_audit.py", "solver.md"}
# Rounding of poses, relative to boxes of about one unit.
_ROUNDING = 1e-12


def blocks(path: Path) -> list[str]:
    """The Python blocks of a page, or the text of an example."""
    text = path.read_text()
    return [text] if path.suffix == ".py" else re.findall(r"```python\n(.*?)```", text, re.DOTALL)


PAGES = [page for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))) if blocks(page)]


def run_document(path: Path, old: str = "", new: str = "") -> dict[str, Any]:
    """Runs the blocks of a page, or an example, in order in one namespace, and returns that.

    Args:
        old, new: text to be replaced, if any.
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    assert not old or any(old in block for block in blocks(path)), f"{path.name}: no {old!r}"
    wrong = []
    for number, block in enumerate(blocks(path), 1):
        text, name = block.replace(old, new) if old else block, f"{path.name}, Python block {number}"
        if path.suffix == ".md" and not old:
            wrong += run_checked(text, name, names)
        else:
            exec(compile(text, name, "exec"), names)
    assert wrong == []
    return names


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
        names = {"position": names["world"].position, **names["world"].payload}
    return names["position"].cpu().numpy(), names["orientation"].cpu().numpy()


def check_convex(steps: list[pgccd.RigidMotion], names: dict[str, Any]) -> int:
    """No two bodies overlap after any step of a loop over bodies of several convex meshes and a terrain at rest; static
    ones may. Returns the number of pairs that were close to each other.

    Args:
        steps: those recorded, of all bodies in the order of their rows.
        names: namespace of the loop: `meshes`, `mesh_index`, `static` and `terrain`.
    """
    poses = [(step.position_t0.numpy(), step.orientation_t0.numpy()) for step in steps] + [last_poses(names)]
    convex = {
        number: Convex.of_mesh(mesh.vertices.numpy(), mesh.faces.numpy())
        for number, mesh in enumerate(names["meshes"])
        if mesh is not names["terrain"]
    }
    corners = names["terrain"].vertices.numpy()[names["terrain"].faces.numpy()]
    ground = [Convex.of_mesh(triangle, np.array([[0, 1, 2]])) for triangle in corners]
    rows = [(row, number) for row, number in enumerate(names["mesh_index"].tolist()) if number in convex]
    fixed = np.concatenate([names["static"].numpy()[[row for row, _ in rows]], np.ones(len(ground), dtype=bool)])
    near = 0
    for number, (position, orientation) in enumerate(poses):
        axes = axes_of(orientation)
        everything = [*(convex[mesh].placed(axes[row], position[row]) for row, mesh in rows), *ground]
        low, high = (np.array([f(each.vertices, axis=0) for each in everything]) for f in (np.min, np.max))
        for i in np.flatnonzero(~fixed):
            close = (low <= high[i]).all(axis=1) & (high >= low[i]).all(axis=1)
            for j in np.flatnonzero(close & (fixed | (np.arange(len(fixed)) > i))):
                near += 1
                apart = gap(everything[i], everything[j])
                assert apart > -_ROUNDING, f"bodies {i} and {j} overlap after step {number}, by {-apart}"
    return near


def check_loop(document: str, steps: list[pgccd.RigidMotion], names: dict[str, Any]) -> None:
    """No two bodies overlap after any step, and each step moves them.

    Args:
        document: one of `LOOPS`.
        steps: those recorded.
        names: its namespace.
    """
    mesh, before = LOOPS[document]
    steps, box = steps[before:], names[mesh]
    half = box.vertices.abs().amax(dim=0).numpy()
    assert (box.vertices.abs().numpy() > half - 1e-9).all(axis=1).sum() == 8, "the mesh is not a box about its origin"
    poses = [(step.position_t0, step.orientation_t0) for step in steps]
    states = [(x.cpu().numpy(), q.cpu().numpy()) for x, q in poses] + [last_poses(names)]
    gaps = np.array([least_gap(*state, half) for state in states])
    overlapping = np.flatnonzero(gaps < -_ROUNDING).tolist()
    assert overlapping == [], f"bodies overlap after steps {overlapping}, by up to {-gaps.min()}"
    moved = np.abs(np.diff([position for position, _ in states], axis=0)).sum(axis=(1, 2))
    fractions = moved / [float((step.position_t1 - step.position_t0).abs().sum()) for step in steps]
    assert fractions.min() > 1e-3 and fractions.mean() > 0.03, f"the loop stands still: {fractions}"
