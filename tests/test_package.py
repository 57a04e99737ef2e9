"""The package as seen by programs and editors: which modules importing it loads, and what type checkers see."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import pgccd

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    """By a process that imports pgccd and then calls every public function: which modules the import has loaded, how
    pgccd answers for modules that are imported later, and the number and the heavy ones of those that each call loads.
    """
    folder = tmp_path_factory.mktemp("said")
    program = f"""
import sys, json, pgccd
large = ("trimesh", "matplotlib", "rich", "scipy", "mpi4py")
later = ("pgccd.sim", "pgccd.viz", "pgccd.distributed", "pgccd.files", "pgccd.about", "pgccd.robots")
later += ("pgccd.simulators",)
before = sorted(name for name in sys.modules if name.split(".")[0] in large or name.startswith(later))
seen = [name for name in dir(pgccd) if name in ("about", "distributed", "files", "robots", "sim", "simulators", "viz")]
used = [pgccd.about, pgccd.distributed.World, pgccd.files.load_motion, pgccd.sim.run]
try:
    pgccd.simulation
except AttributeError as error:
    answer = str(error)
import torch
from pgccd import distributed, files, sim
scene = pgccd.Scene([pgccd.Mesh.box([1.0, 1.0, 1.0])], [0, 0])
x, v = torch.tensor([[0.0, 0, 0], [3.0, 0.1, 0.2]]), torch.tensor([[0.0, 0, 0], [-4.0, 0, 0]])
q = torch.tensor([[1.0, 0, 0, 0]] * 2)
motion = pgccd.RigidMotion.from_velocity(x, q, v, 0.1 * v, 1.0)
path = pgccd.Trajectory(torch.stack([x, x + v]), torch.stack([q, q]))
wanting = pgccd.RigidMotion(x.double().requires_grad_(), q.double(), (x + v).double(), q.double())
world = lambda: distributed.World.create(scene, x.double() + 1.0, (0,) * 3, (6,) * 3)
calls = {{
    **{{report: lambda r=report: pgccd.detect(scene, motion, r) for report in ("first", "all", "earliest")}},
    "collide": lambda: pgccd.collide(scene, motion),
    "trajectory": lambda: pgccd.detect(scene, path),
    "capacity": lambda: pgccd.detect(scene, motion, capacity=pgccd.Capacity.of(9)).trim(),
    "approaching": lambda: pgccd.approaching(scene, motion, pgccd.detect(scene, motion, normals="surface")),
    "gradients": lambda: pgccd.detect(scene, wanting).toi.sum().backward(),
    "captured": lambda: pgccd.CapturedDetection(scene, motion, capacity=pgccd.Capacity.of(9))(motion),
    "resolve": lambda: pgccd.resolve(scene, motion),
    "resolve a trajectory": lambda: pgccd.resolve(scene, path),
    "distance": lambda: pgccd.distance(scene, motion, cutoff=1.0),
    "exit distance": lambda: pgccd.exit_distance(scene, motion, [1.0, 0.0, 0.0]),
    "enclosed": lambda: pgccd.enclosed(scene, motion),
    "audit": lambda: pgccd.audit(scene, path),
    "at": lambda: (motion.at(torch.tensor([0.5])), motion.shortened(torch.tensor([0.5, 1.0]))),
    "orientation": lambda: pgccd.integrate_orientation(q, v),
    "elementary": lambda: pgccd.narrow.vertex_face(torch.rand(2, 4, 3), torch.rand(2, 4, 3)),
    "state": lambda: pgccd.Scene.from_state_dict(scene.state_dict()).to("cpu"),
    "world": lambda: (w := world(), w.step(motion, resolve=True), w.move(w.position), w.save({str(folder / "w")!r})),
    "simulation": lambda: sim.run(sim.ModelConfig(robots=20), 2, {str(folder / "run")!r}),
    "page": lambda: pgccd.show(scene, motion, path={str(folder / "page.html")!r}),
}}
heavy = {{"sympy", "mpmath", "scipy", "trimesh", "matplotlib", "networkx", "torch._dynamo", "torch._inductor"}}
loaded = {{}}
for name, call in calls.items():
    known = set(sys.modules)
    call()
    new = set(sys.modules) - known
    loaded[name] = [len(new), sorted(heavy & {{".".join(each.split(".")[:n]) for each in new for n in (1, 2)}})]
print(json.dumps([before, seen, answer, loaded]))
"""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_importing_brings_no_more_than_detection_needs(said: list[Any]) -> None:
    later = ["about", "distributed", "files", "robots", "sim", "simulators", "viz"]
    assert said[:3] == [[], later, "module 'pgccd' has no attribute 'simulation'"]


def test_first_calls_load_no_more_than_they_need(said: list[Any]) -> None:
    """None loads what costs more time than the call."""
    for name, (count, heavy) in said[3].items():
        assert heavy == [], name
        assert count <= {"world": 130, "simulation": 60, "page": 60}.get(name, 12), name


def test_type_checkers_see_what_is_imported_later() -> None:
    tree = ast.parse((ROOT / "pgccd" / "__init__.py").read_text())
    guarded = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "_TYPE_CHECKING"]
    modules, shown = guarded[0].body
    assert isinstance(modules, ast.ImportFrom) and ast.unparse(shown) == "from pgccd.viz import show"
    assert pgccd.show is pgccd.viz.show
    names = {alias.name for alias in modules.names}
    assert names == set(pgccd._LATER) and names <= set(pgccd.__all__) <= set(dir(pgccd))
    assert (ROOT / "pgccd" / "py.typed").is_file()


def test_public_modules_show_what_is_public() -> None:
    assert sorted([*pgccd.__all__, "__version__"]) == dir(pgccd)
    modules = [value for name in pgccd.__all__ if isinstance(value := getattr(pgccd, name), ModuleType)]
    assert len(modules) == 11
    for module in modules:
        assert dir(module) == sorted(module.__all__) and all(hasattr(module, name) for name in module.__all__)


@pytest.mark.parametrize(
    "public",
    [pgccd.Scene, pgccd.RigidMotion, pgccd.VertexMotion, pgccd.MovingBodies, pgccd.Capacity, pgccd.PaddedContacts],
)
def test_private_helpers_are_hidden(public: type) -> None:
    hidden = {"of_checked", "first_invalid_rows", "known_invalid_rows", "validation", "raise_invalid", "has_verdict"}
    hidden |= {"is_trusted", "capacity_estimates", "leave_out", "current_radius", "sound_index"}
    hidden |= {"guess", "grown", "pairs_written"}
    assert not hidden & set(dir(public))


def test_installed_in_place_by_a_path() -> None:
    # Import hooks, the alternative for in-place installs, are invisible to type checkers and editors.
    installing = [line for line in (ROOT / "bootstrap.py").read_text().splitlines() if "--no-build-isolation" in line]
    assert installing and all("--config-settings=editable_mode=compat" in line for line in installing)


@pytest.mark.slow
def test_mypy_outside_the_tree(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    (tmp_path / "program.py").write_text(
        "import pgccd\n"
        "reveal_type(pgccd.Stats().contacts)\n"
        "reveal_type(pgccd.show(*pgccd.files.load_scene('scene.json'), path='page.html'))\n"
        "reveal_type(pgccd.sim.ModelConfig().robots)\n"
    )
    environment = os.environ | {"MYPYPATH": str(ROOT)}
    command = [sys.executable, "-m", "mypy", "--cache-dir", str(tmp_path / "cache"), "program.py"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=280)
    revealed = [line.split('"')[1] for line in done.stdout.splitlines() if "Revealed" in line]
    assert revealed == ["int", "pathlib.Path", "int"], done.stdout
