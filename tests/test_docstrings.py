"""The examples in docstrings run as written, in a namespace with the names they use."""

from __future__ import annotations

import ast
import contextlib
import doctest
import functools
import importlib
import inspect
import io
import json
import pkgutil
import re
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.reports import detected
from support.steps import step_of

import pgccd
from pgccd import distributed, sim
from pgccd.distributed.partition.balance import CellLoads
from pgccd.distributed.partition.decomposition import Decomposition
from pgccd.sim.simulation import FIRST_CONTACTS

ROOT = Path(__file__).resolve().parents[1]
TWO_BALLS = """<mujoco><worldbody><geom type="plane" size="1 1 1"/>
<body pos="0 0 1"><freejoint/><geom size="0.1"/></body></worldbody></mujoco>"""
# Modules whose examples need ranks, a scheduler, GPU streams or a server; other tests run them.
NOT_ALONE = (
    "pgccd.distributed.checkpoint.writing",
    "pgccd.distributed.guard.guard",
    "pgccd.distributed.comm.mpi_comm",
    "pgccd.runtime.side_stream",
    "pgccd.distributed.comm.torch_comm",
    "pgccd.distributed.detection.share",
    "pgccd.runtime.host_copy",
    "pgccd.viz.live_view",
)

# Two links on two joints.
_LINK = """<link name="{0}"><collision><origin xyz="0.5 0 0"/><geometry><box size="0.8 0.1 0.1"/></geometry></collision>
</link><joint name="{1}" type="continuous"><parent link="{2}"/><child link="{0}"/><origin xyz="{3} 0 0"/>
<axis xyz="0 0 1"/></joint>"""
ARM = f"""<robot name="arm"><link name="base"/>{_LINK.format("upper", "shoulder", "base", 0)}
{_LINK.format("tool", "elbow", "upper", 1)}</robot>"""
MJCF = """<mujoco><worldbody><body name="upper"><joint axis="0 0 1"/><geom type="box" size="0.4 0.1 0.1"/><body
name="lower" pos="1 0 0"><joint axis="0 0 1"/><geom type="sphere" size="0.1"/></body></body></worldbody></mujoco>"""


def modules() -> Iterator[str]:
    for module in pkgutil.walk_packages(pgccd.__path__, "pgccd."):
        if not module.name.endswith(("._C", ".__main__")):
            yield module.name


def examples_of(module: str) -> list[doctest.DocTest]:
    """The examples of a module, read from its source without importing it."""
    path = ROOT / Path(*module.split("."))
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    parser, found = doctest.DocTestParser(), []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef, ast.Module)):
            text = ast.get_docstring(node) or ""
            name = f"{module}.{getattr(node, 'name', '')}"
            test = parser.get_doctest(text, {}, name, str(path), getattr(node, "lineno", 0))
            found += [test] if test.examples else []
    return found


def two_bodies() -> dict[str, Any]:
    """Names used by the detection examples."""
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=torch.float64)
    mesh = pgccd.Mesh(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    x = torch.tensor([[0.0, 0, 0], [3, 0, 0]], dtype=torch.float64)
    v = torch.tensor([[0.0, 0, 0], [-2.5, 0, 0]], dtype=torch.float64)
    q = torch.tensor([[1.0, 0, 0, 0]] * 2, dtype=torch.float64)
    scene, motion = pgccd.Scene([mesh], [0, 0]), pgccd.RigidMotion(x, q, x + v, q)
    bodies = pgccd.MovingBodies.of(scene, motion)
    pairs = pgccd.broad.sweep(bodies)
    candidates, _ = pgccd.traverse.find_candidates(bodies, pairs)
    names = {"robot": mesh, "rock": mesh, "mesh": mesh, "scene": scene, "motion": motion, "m": motion, "bodies": bodies}
    names |= {"x": x, "x0": x, "x1": x + v, "q": q, "q0": q, "q1": q, "v": v, "w": v, "omega": v, "dt": 1.0}
    names |= {"position": x, "orientation": q, "velocity": v, "rows": torch.tensor([1]), "pairs": pairs}
    names |= {"candidates": candidates, "hits": pgccd.detect(scene, motion), "capacity": pgccd.Capacity.of(100)}
    names |= {"cloth_t0": corners, "cloth_t1": corners, "ball_t0": corners + 2.0, "ball_t1": corners}
    return names | {"meshes": scene.meshes, "device": torch.device("cpu")}


@functools.cache
def of_robots() -> dict[str, Any]:
    """Names used by the examples of the nanorobot world."""
    model = sim.Model(sim.ModelConfig(robots=50, speed=0.3))
    state, comm = model.start(), distributed.Alone()
    scene = model.scene(state.id)
    step = step_of(model, state, 0)
    moved = model.plan(state, 0)
    hits = pgccd.detect(scene, model.motion(moved), FIRST_CONTACTS.report)
    names = {"model": model, "state": state, "scene": scene, "step": step, "hits": hits, "comm": comm}
    partition = distributed.Cells.uniform((0, 0, 0), (30, 30, 30), 1)
    loads = CellLoads(*(torch.zeros(len(partition.owner), dtype=torch.int64) for _ in range(3)))
    names |= {"resolved": step.resolution, "partition": partition, "loads": loads}
    names["decomposition"] = Decomposition(comm, partition)
    return names | {"id": state.id, "mood": state.position, "x": state.position}


def planning_space(dimension: int) -> Any:
    """OMPL's information on a space of so many dimensions."""
    base = pytest.importorskip("ompl.base")
    space, bounds = base.RealVectorStateSpace(dimension), base.RealVectorBounds(dimension)
    bounds.setLow(-1.0)
    bounds.setHigh(1.0)
    space.setBounds(bounds)
    return base.SpaceInformation(space)


def namespace(module: str) -> dict[str, Any]:
    """Names that the examples of a module may use."""
    names: dict[str, Any] = {"pgccd": pgccd, "torch": torch, "np": np} | two_bodies()
    with contextlib.suppress(ImportError):
        names["trimesh"] = importlib.import_module("trimesh")
    if module.startswith(("pgccd.sim", "pgccd.viz", "pgccd.distributed")):
        names |= of_robots()
    if module.startswith("pgccd.viz"):
        names |= two_bodies()
    if module.startswith("pgccd.robots"):
        pytest.importorskip("yourdfpy")
        pytest.importorskip("mujoco")
        names["robot"] = pgccd.robots.load_urdf("arm.urdf")
    if module == "pgccd.robots.ompl":
        names["space_information"] = planning_space(names["robot"].joint_count)
    if module.startswith("pgccd.robots"):
        names["obstacles"] = pgccd.robots.Obstacles([names["mesh"]], torch.tensor([[3.0, 3.0, 3.0]]))
    if module in ("pgccd.simulators.mujoco_frames", "pgccd.simulators.simulator"):
        mujoco = pytest.importorskip("mujoco")
        names["model"] = mujoco.MjModel.from_xml_string(TWO_BALLS)
        names["data"] = mujoco.MjData(names["model"])
    if module == "pgccd.simulators.pybullet_frames":
        bullet = pytest.importorskip("pybullet")
        names |= {"bullet": bullet, "client": bullet.connect(bullet.DIRECT)}
        bullet.createMultiBody(1.0, bullet.createCollisionShape(bullet.GEOM_SPHERE))
    if module.startswith("pgccd.distributed.world."):
        names |= two_bodies() | {"comm": distributed.Alone()}
        payload = {"velocity": names["v"]}
        if module == "pgccd.distributed.world.loop":
            payload |= {"q": names["q0"], "v": names["v"], "w": names["w"]}
        rocks = pgccd.Scene([names["rock"]], [0, 0])
        names["world"] = distributed.World.create(rocks, names["x"], (0, 0, 0), (9, 9, 9), payload=payload)
    if module == "pgccd.search.narrow":
        names |= dict.fromkeys(("x0", "x1"), torch.rand(5, 4, 3))
    if module == "pgccd.runtime.stages":
        names |= of_robots() | {"step": 0}
    if module == "pgccd.distributed.comm.interface":
        names |= {"scene": pgccd.Scene([names["mesh"]]), "position": torch.zeros(1, 3)}
        names |= {"lower": (0, 0, 0), "upper": (9, 9, 9)}
    options = type("Options", (), {"robots": 9})
    return names | vars(sys.modules[module]) | {"options": options, "digest": "0"}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, with the files that examples use."""
    trimesh = pytest.importorskip("trimesh")
    names = two_bodies()
    for name in ("rock.ply", "robot.ply"):
        trimesh.creation.box().export(tmp_path / name)
    poses = {"position_t0": "x0", "orientation_t0": "q0", "position_t1": "x1", "orientation_t1": "q1"}
    np.savez(tmp_path / "poses.npz", **{name: names[short].numpy() for name, short in poses.items()})
    scene = {"meshes": ["rock.ply"], "mesh_index": [0, 0], "poses": "poses.npz"}
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    (tmp_path / "arm.urdf").write_text(ARM)
    (tmp_path / "arm.xml").write_text(MJCF)
    sim.run(sim.ModelConfig(robots=20), 1, tmp_path / "out" / "try")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(example: doctest.Example, names: dict[str, Any]) -> str:
    """Runs an example; returns its output, or the printed value of its expression."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(example.source, "<example>", "single"), names)
    return printed.getvalue()


WITH_EXAMPLES = [name for name in modules() if name not in NOT_ALONE and examples_of(name)]


@pytest.mark.parametrize("module", WITH_EXAMPLES)
def test_examples_of_docstrings(module: str, folder: Path, request: pytest.FixtureRequest) -> None:
    if module == "pgccd.robots.ompl":
        pytest.importorskip("ompl")
    importlib.import_module(module)
    checker = doctest.OutputChecker()
    for test in examples_of(module):
        names = namespace(module)
        if "client" in names:  # other tests use the default one
            request.addfinalizer(functools.partial(names["bullet"].disconnect, names["client"]))
        for example in test.examples:
            try:
                got = run(example, names)
            except Exception as error:
                pytest.fail(f"{test.name}: {example.source.strip()}: {type(error).__name__}: {error}")
            if example.want.strip():
                assert checker.check_output(example.want, got, doctest.ELLIPSIS), (test.name, example.want, got)


def test_all_examples_are_found() -> None:
    assert sum(len(examples_of(name)) for name in WITH_EXAMPLES) > 50
    assert all(examples_of(name) for name in NOT_ALONE)


def test_attributes_are_in_the_help() -> None:
    """Every public attribute of an object is named in the docstring of its class, or is a property with one."""
    names = two_bodies()
    scene, motion, x = names["scene"], names["motion"], names["x"]
    still, captured = pgccd.RigidMotion.at_rest(x, names["q"]), pgccd.CapturedDetection(scene, motion)
    voxels = pgccd.baselines.PCCCD.create([names["rock"]])
    voxels.detect(motion)
    objects: list[Any] = [names["mesh"], scene.meshes, scene, motion, still, names["bodies"], captured, voxels]
    objects += [pgccd.VertexMotion(x, x), pgccd.Trajectory(torch.stack([x, x])), names["hits"].stats, voxels.stats]
    objects += [detected(scene, motion, report) for report in ("first", "any")]
    objects += [detected(scene, motion, report, capacity=names["capacity"]) for report in ("first", "any")]
    objects += [pgccd.detect(scene, pgccd.Trajectory(torch.stack([x, x]), torch.stack([names["q"]] * 2)))]
    objects += [pgccd.CapturedCollision(scene, motion), pgccd.narrow.vertex_face(*[torch.rand(2, 4, 3)] * 2)]
    audited = pgccd.audit(scene, [(x, names["q"]), (x + 2.0 * names["v"], names["q"])])
    objects += [audited, audited.passages, audited.touching]
    unknown = []
    for each in objects:
        known = set(re.findall(r"\w+", type(each).__doc__ or ""))
        shown = [name for name in {*vars(each), *dir(type(each))} if not name.startswith("_")]
        for name in shown:
            member = inspect.getattr_static(type(each), name, None)
            is_defined = isinstance(member, (property, classmethod, types.FunctionType))
            if not (inspect.getdoc(getattr(type(each), name)) if is_defined else name in known):
                unknown.append(f"{type(each).__name__}.{name}")
    assert unknown == []


def public_classes() -> list[type]:
    """The classes that the packages for simulations, ranks and pictures make public."""
    packages = (distributed, pgccd.robots, sim, pgccd.simulators, pgccd.viz)
    classes = {getattr(package, name) for package in packages for name in package.__all__}
    return sorted((each for each in classes if inspect.isclass(each)), key=lambda each: each.__qualname__)


def own_bases(cls: type) -> list[type]:
    return [base for base in cls.__mro__ if base.__module__.startswith("pgccd")]


@pytest.mark.parametrize("cls", public_classes())
def test_attributes_of_classes_are_in_their_docstrings(cls: type) -> None:
    """Every public attribute that a class declares or sets has an entry in its docstring or in that of a base class, or
    is a property with a docstring. No comment documents it instead, which `help` does not show.
    """
    assert cls.__doc__
    entries, names = set(), set()
    for base in own_bases(cls):
        source = inspect.getsource(base)
        assert "#:" not in source, f"{base.__name__}: attributes belong in its docstring"
        for line in re.findall(r"^ {8}(\w+(?:, \w+)*): ", base.__doc__ or "", re.MULTILINE):
            entries |= set(line.split(", "))
        names |= {*vars(base), *inspect.get_annotations(base), *re.findall(r"\bself\.(\w+)(?:: [^=\n]+)? = ", source)}
        names |= {
            name
            for line in re.findall(r"^ +((?:self\.\w+, )+self\.\w+) = ", source, re.MULTILINE)
            for name in re.findall(r"self\.(\w+)", line)
        }
    unknown = []
    for name in sorted(name for name in names - entries if not name.startswith("_")):
        members = [vars(base)[name] for base in own_bases(cls) if name in vars(base)]
        defined = [each for each in members if callable(each) or hasattr(type(each), "__get__")]
        if not any(inspect.getdoc(getattr(each, "func", each)) for each in defined):
            unknown.append(name)
    assert unknown == []


def test_public_classes_are_found() -> None:
    assert {pgccd.viz.Snapshot, sim.Model, sim.Step, distributed.World} <= set(public_classes())
