"""The package as seen by programs and editors: which modules importing it loads, and what type checkers see."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import pgccd

ROOT = Path(__file__).resolve().parents[1]


def test_importing_brings_no_more_than_detection_needs() -> None:
    program = """
import sys, json, pgccd
large = ("trimesh", "matplotlib", "rich", "scipy", "mpi4py")
later = ("pgccd.sim", "pgccd.viz", "pgccd.distributed", "pgccd.files", "pgccd.about", "pgccd.robots")
before = sorted(name for name in sys.modules if name.split(".")[0] in large or name.startswith(later))
seen = [name for name in dir(pgccd) if name in ("about", "distributed", "files", "robots", "sim", "viz")]
used = [pgccd.about, pgccd.distributed.World, pgccd.files.load_motion, pgccd.sim.run]
try:
    pgccd.simulation
except AttributeError as error:
    print(json.dumps([before, seen, str(error)]))
"""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    later = ["about", "distributed", "files", "robots", "sim", "viz"]
    assert json.loads(done.stdout) == [[], later, "module 'pgccd' has no attribute 'simulation'"]


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
    assert len(modules) == 10
    for module in (*modules, pgccd.sim.distributed):
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
