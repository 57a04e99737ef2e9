"""The command line: results, and one clear line for every mistake."""

from __future__ import annotations

import json
import os
import re
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from support.forked_job import ForkedJob

import pgccd
from pgccd import files
from pgccd.__main__ import run
from pgccd.cli import main
from pgccd.sim import robot_mesh

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture
def meshes(tmp_path: Path) -> list[str]:
    pytest.importorskip("trimesh")
    names = []
    for name in ("a.obj", "b.obj"):
        (tmp_path / name).write_text(TETRAHEDRON)
        names.append(str(tmp_path / name))
    return names


@pytest.fixture
def poses(tmp_path: Path) -> str:
    """Two bodies flying at each other along x, initially 4 apart."""
    start = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    turn = np.array([[1.0, 0.0, 0.0, 0.0]] * 2)
    path = tmp_path / "poses.npz"
    np.savez(path, position_t0=start, orientation_t0=turn, position_t1=start[::-1], orientation_t1=turn)
    return str(path)


def test_simulate_ends_with_its_figures_and_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "run"
    arguments = ["simulate", "--robots", "60", "--steps", "4", "--world", "skewed", "--seed", "3", "--out", str(folder)]
    assert main(arguments) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    found = re.fullmatch(
        r"robots=60 steps=4 pcs=(\d+) contacts=(\d+) seconds_per_step=\d+\.\d+ page=(\S+) picture=(\S+)", last
    )
    assert found
    records = [json.loads(line) for line in (folder / "steps.jsonl").read_text().splitlines()]
    assert int(found[1]) == sum(record["pcs"] for record in records)
    assert int(found[2]) == sum(record["contacts"] for record in records)
    assert all(Path(name).stat().st_size > 10_000 for name in found.groups()[2:])


def test_simulate_resumes_with_mixed_meshes(
    tmp_path: Path, meshes: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    robot = robot_mesh()
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in robot.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (robot.faces + 1).tolist()]
    (tmp_path / "robot.obj").write_text("\n".join(lines))
    world = ["--robots", "40", "--mesh", meshes[0], str(tmp_path / "robot.obj"), "--no-pictures"]
    assert main(["simulate", *world, "--steps", "6", "--out", str(tmp_path / "whole")]) == 0
    assert main(["simulate", *world, "--steps", "2", "--out", str(tmp_path / "part")]) == 0
    assert main(["simulate", "--resume", str(tmp_path / "part"), "--steps", "6", "--no-pictures"]) == 0
    assert "page=" not in capsys.readouterr().out
    hashes = [
        [json.loads(line)["state_hash"] for line in (tmp_path / name / "steps.jsonl").read_text().splitlines()]
        for name in ("whole", "part")
    ]
    assert hashes[0] == hashes[1] and len(hashes[0]) == 6


def test_detect_prints_the_contact(meshes: list[str], poses: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["detect", *meshes, "--motion", poses]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 and lines[0].startswith("pair=0,1  toi=0.37") and "contacts=1" in lines[1]


@pytest.mark.parametrize("broad_phase", ["auto", "sweep", "grid", "lbvh"])
def test_broad_phase_is_named_and_changes_nothing(
    broad_phase: str, tmp_path: Path, meshes: list[str], poses: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["detect", *meshes, "--motion", poses, "--json"]) == 0
    default = json.loads(capsys.readouterr().out)
    assert main(["detect", *meshes, "--motion", poses, "--json", "--broad-phase", broad_phase]) == 0
    named = json.loads(capsys.readouterr().out)
    assert named["contacts"] == default["contacts"] != []
    assert named["stats"]["broad_phase"] == ("sweep" if broad_phase == "auto" else broad_phase)

    folders = [tmp_path / "default", tmp_path / "named"]
    world = ["simulate", "--robots", "80", "--steps", "3", "--no-pictures", "--out"]
    assert main([*world, str(folders[0])]) == main([*world, str(folders[1]), "--broad-phase", broad_phase]) == 0
    logs = [(folder / "steps.jsonl").read_text().splitlines() for folder in folders]
    hashes = [[json.loads(line)["state_hash"] for line in log] for log in logs]
    assert hashes[0] == hashes[1] and len(hashes[0]) == 3


def test_detect_as_json_and_by_scene_and_velocity(
    tmp_path: Path, meshes: list[str], poses: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["detect", *meshes, "--motion", poses, "--json", "--report", "all"]) == 0
    whole = json.loads(capsys.readouterr().out)
    assert whole["stats"]["contacts"] == len(whole["contacts"]) >= 1
    assert whole["contacts"][0]["status"] == "TOUCH"

    start = np.load(poses)["position_t0"]
    velocity = np.array([[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]])
    moving = {"linear_velocity": velocity, "angular_velocity": 0.0 * velocity, "dt": 2.0}
    np.savez(tmp_path / "v.npz", position_t0=start, orientation_t0=np.load(poses)["orientation_t0"], **moving)
    scene = {"meshes": ["a.obj"], "mesh_index": [0, 0], "poses": "v.npz"}
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    assert main(["detect", "--scene", str(tmp_path / "scene.json"), "--json", "--report", "all"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["contacts"] == whole["contacts"]

    (tmp_path / "scene.json").write_text(json.dumps(scene | {"world": [0, 1]}))
    assert main(["detect", "--scene", str(tmp_path / "scene.json"), "--report", "any"]) == 0
    assert "contacts=0" in capsys.readouterr().out


def test_detect_along_trajectories_and_of_deforming_bodies(
    tmp_path: Path, meshes: list[str], poses: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["detect", *meshes, "--motion", poses, "--json"]) == 0
    (step,) = json.loads(capsys.readouterr().out)["contacts"]
    given = np.load(poses)
    start, turn = given["position_t0"], given["orientation_t0"]
    away = np.stack([start + [0.0, 9.0, 0.0] * np.array([[0], [1]]), start, given["position_t1"]])
    np.savez(tmp_path / "path.npz", position=away, orientation=np.stack([turn] * 3))
    assert main(["detect", *meshes, "--motion", str(tmp_path / "path.npz"), "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["contacts"]
    assert found.pop("segment") == 1 and found.pop("time") == pytest.approx((1.0 + step["toi"]) / 2.0) and found == step
    scene = {"meshes": ["a.obj"], "mesh_index": [0, 0], "poses": "path.npz"}
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    assert main(["detect", "--scene", str(tmp_path / "scene.json")]) == 0
    assert capsys.readouterr().out.startswith("pair=0,1  segment=1  toi=0.37")

    corners = pgccd.Mesh.load(meshes[0]).vertices.numpy()
    vertices = (away[:, :, None] + corners).reshape(3, -1, 3)
    for name, columns in (("step", {"x_t0": vertices[1], "x_t1": vertices[2]}), ("path", {"position": vertices})):
        np.savez(tmp_path / f"{name}.npz", **columns)
        assert main(["detect", *meshes, "--motion", str(tmp_path / f"{name}.npz"), "--json"]) == 0
        (same,) = json.loads(capsys.readouterr().out)["contacts"]
        assert same["toi"] == pytest.approx(step["toi"], abs=1e-5) and same["pair"] == step["pair"]


def test_pages(tmp_path: Path, meshes: list[str], poses: str, capsys: pytest.CaptureFixture[str]) -> None:
    page, model = str(tmp_path / "page.html"), str(tmp_path / "model.glb")
    assert main(["detect", *meshes, "--motion", poses, "--page", page]) == 0
    out = capsys.readouterr().out.splitlines()
    assert len(out) == 2 and out[1].endswith(f"contacts=1 unresolved=0 page={page}")
    assert "<h1>2 bodies, 1 contact</h1>" in Path(page).read_text()
    assert main(["detect", *meshes, "--motion", poses, "--page", model, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["page"] == model and Path(model).read_bytes()[:4] == b"glTF"
    picture = str(tmp_path / "picture.png")
    assert main(["detect", *meshes, "--motion", poses, "--page", picture, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["page"] == picture and Path(picture).read_bytes()[1:4] == b"PNG"
    assert main(["view", *meshes, "--page", page, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"page": page, "bodies": 2}
    assert "<h1>2 bodies</h1>" in Path(page).read_text() and '"moving":false' in Path(page).read_text()
    assert main(["view", *meshes, "--motion", poses, "--page", page]) == 0
    assert capsys.readouterr().out == f"bodies=2 page={page}\n" and '"moving":true' in Path(page).read_text()


def test_view_opens_a_browser(
    tmp_path: Path, meshes: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda address: opened.append(address) or True)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("DISPLAY", ":0")
    assert main(["view", *meshes]) == 0
    assert capsys.readouterr().out.strip() == f"bodies=2 page={opened[0].removeprefix('file://')}"


def test_no_command_lists_all_with_examples(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    out = capsys.readouterr().out
    for name in ("view", "detect", "simulate", "info"):
        assert re.search(rf"^    {name} ", out, re.MULTILINE) and f"  pgccd {name} " in out
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0 and capsys.readouterr().out == f"pgccd {pgccd.__version__}\n"


def test_quiet_and_json(tmp_path: Path, meshes: list[str], poses: str, capsys: pytest.CaptureFixture[str]) -> None:
    run = ["simulate", "--robots", "30", "--steps", "2", "--no-pictures", "--overwrite", "--out", str(tmp_path / "run")]
    assert main([*run, "--quiet"]) == 0
    quiet = capsys.readouterr()
    assert quiet.err == "" and re.fullmatch(r"robots=30 steps=2 pcs=\d+ .*\n", quiet.out)
    assert main([*run, "--json"]) == 0
    printed = capsys.readouterr()
    figures = json.loads(printed.out)
    assert (figures["robots"], figures["steps"], figures["interrupted"]) == (30, 2, False)
    assert figures["seconds_per_step"] > 0.0 and Path(figures["log"]).is_file() and "step 2/2" in printed.err
    assert main(["detect", *meshes, "--motion", poses, "--quiet"]) == 0
    assert re.fullmatch(r"bodies=2 pcs=1 contacts=1 unresolved=0\n", capsys.readouterr().out)
    assert main(["info", meshes[0], "--json"]) == 0
    about = json.loads(capsys.readouterr().out)
    assert about["pgccd"] == pgccd.__version__ and about["meshes"][0]["faces"] == 4


def test_a_folder_that_cannot_be_written_is_refused_before_the_first_step(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("pgccd.sim.Simulation.step", lambda *_: pytest.fail("a step was made"))
    monkeypatch.setattr("pgccd.sim.model.Model.start", lambda *_: pytest.fail("the world was made"))
    assert main(["simulate", "--robots", "30", "--steps", "1", "--out", "/proc/run"]) == 2
    assert "argument --out: cannot write to /proc/run" in capsys.readouterr().err


def inform_nobody() -> int:
    read, write = os.pipe()
    os.close(read)
    os.dup2(write, sys.stdout.fileno())
    sys.argv = ["pgccd", "info"]
    return run()


def test_output_whose_reader_has_ended(tmp_path: Path) -> None:
    with ForkedJob(1, tmp_path, inform_nobody) as job:
        assert (job.finish(), job.said) == ([-signal.SIGPIPE], "")


def test_info_names_version_and_kernels(meshes: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", meshes[0]]) == 0
    out = capsys.readouterr().out
    assert re.search(r"^kernels for +cpu", out, re.MULTILINE)
    assert "4 vertices, 4 faces, SBV centre (0.25, 0.25, 0.25)" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fly"], "command"),
        (["simulate", "--robots", "many"], "argument --robots"),
        (["simulate", "--robots", "0"], "argument --robots"),
        (["simulate", "--robots", "3000000000"], "argument --robots"),
        (["simulate", "--steps", "-1"], "argument --steps"),
        (["simulate", "--world", "flat"], "argument --world"),
        (["simulate", "--seed", str(2**70)], "argument --seed"),
        (["simulate", "--device", "abacus"], "argument --device"),
        (["simulate", "--device", "cuda:63"], "argument --device"),
        (["simulate", "--checkpoint-every", "-2"], "argument --checkpoint-every"),
        (["simulate", "--mesh", "no.ply"], "argument --mesh: no mesh file at no.ply"),
        (["simulate", "--resume", "nowhere"], "argument --resume: no checkpoint at nowhere"),
        (["simulate", "--resume", "nowhere", "--robots", "5"], "argument --robots: not allowed with --resume"),
        (["simulate", "--out", "file.txt/sub"], "argument --out"),
        (["simulate", "--broad-phase", "octree"], "argument --broad-phase"),
        (["detect"], "argument MESH"),
        (["detect", "A", "B"], "argument --motion"),
        (["detect", "A", "B", "--motion", "poses.npz"], "argument MESH: no mesh file at A"),
        (["detect", "a.obj", "b.obj", "--motion", "no.npz"], "argument --motion: no.npz cannot be read"),
        (["detect", "a.obj", "b.obj", "--motion", "empty.npz"], "argument --motion: empty.npz has no 'position_t0'"),
        (["detect", "a.obj", "--motion", "poses.npz"], "argument --motion: motion: has 2 bodies, the scene 1"),
        (["detect", "a.obj", "b.obj", "--motion", "poses.npz", "--min-separation", "-1"], "argument --min-separation"),
        (["detect", "a.obj", "b.obj", "--motion", "poses.npz", "--tolerance", "nan"], "argument --tolerance"),
        (["detect", "--scene", "no.json"], "argument --scene: no.json cannot be read"),
        (["detect", "--scene", "file.txt"], "argument --scene: file.txt cannot be read"),
        (["detect", "a.obj", "--scene", "no.json"], "argument --scene: takes the place"),
        (["detect", "a.obj", "b.obj", "--motion", "mixed.npz"], "mixed.npz has 'position_t0' beside 'x_t0'"),
        (
            ["detect", "a.obj", "b.obj", "--motion", "bad.npz"],
            "bad.npz: position: waypoint 1, vertex 2: expected finite",
        ),
        (
            ["detect", "no.obj", "--motion", "no.npz", "--page", "no/page.html"],
            "argument --page: no/page.html cannot be",
        ),
        (["detect", "no.obj", "--motion", "no.npz", "--page", "."], "argument --page: expected a name that ends in"),
        (["view", "no.obj", "--page", "folder.html"], "argument --page: folder.html is a folder"),
        (["view"], "argument MESH"),
        (["audit", "run.json"], "argument MESH: expected mesh files, got run.json: a scene file is given as --scene"),
        (["view", "no.ply"], "argument MESH: no mesh file at no.ply"),
        (["view", "no.ply", "--page", "file.txt/page.html"], "argument --page: file.txt/page.html cannot be written"),
        (
            ["view", "a.obj", "--motion", "poses.npz", "--page", "p.html"],
            "argument --motion: motion: has 2 bodies, the scene 1",
        ),
        (["info", "no.ply"], "argument MESH: no mesh file at no.ply"),
    ],
)
def test_mistakes_get_one_line_and_code_2(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    meshes: list[str],
    poses: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file.txt").write_text("text")
    (tmp_path / "folder.html").mkdir()
    np.savez(tmp_path / "empty.npz")
    np.savez(tmp_path / "mixed.npz", x_t0=np.zeros((8, 3)), x_t1=np.zeros((8, 3)), position_t0=np.zeros((2, 3)))
    bad = np.zeros((3, 8, 3))
    bad[1, 2, 0] = np.nan
    np.savez(tmp_path / "bad.npz", position=bad)
    try:
        code = main(arguments)
    except SystemExit as exit_:
        code = exit_.code
    assert code == 2
    error = capsys.readouterr().err.strip()
    assert message in error and "\n" not in error and "Traceback" not in error


@pytest.mark.parametrize(
    "error",
    [
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 8 GiB"),
        RuntimeError("out of memory: no room for 4096 more bytes; fewer bodies at a time take less"),
    ],
)
def test_too_little_memory_is_a_mistake_too(
    meshes: list[str],
    poses: str,
    error: Exception,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(*_arguments: object, **_options: object) -> None:
        raise error

    monkeypatch.setattr("pgccd.detect", fail)
    monkeypatch.setattr("pgccd.sim.Simulation.step", fail)
    for arguments, option in (
        (["detect", *meshes, "--motion", poses], "--motion"),
        (["simulate", "--robots", "20", "--steps", "1", "--out", str(tmp_path)], "--robots"),
    ):
        assert main(arguments) == 2
        assert re.search(
            rf"error: argument {option}: too .* for the memory of cpu: .*out of memory", capsys.readouterr().err
        )


def test_other_errors_are_not_taken_for_too_little_memory(
    meshes: list[str], poses: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_arguments: object, **_options: object) -> None:
        raise RuntimeError("out of luck")

    monkeypatch.setattr("pgccd.detect", fail)
    with pytest.raises(RuntimeError, match="out of luck"):
        main(["detect", *meshes, "--motion", poses])


def test_unknown_keys_of_files_are_named(tmp_path: Path, meshes: list[str], poses: str) -> None:
    columns = dict(np.load(poses))
    scene = {"meshes": ["a.obj"], "mesh_index": [0, 0], "poses": "poses.npz"}

    def load(**changed: object) -> None:
        (tmp_path / "scene.json").write_text(json.dumps(scene | changed))
        files.load_scene(tmp_path / "scene.json")

    load()
    with pytest.raises(
        ValueError, match="scene.json has an unknown key 'gruop', perhaps for 'group'; known are .*mask"
    ):
        load(gruop=[1, 1])
    for key, value in (("meshes", "a.obj"), ("poses", 3), ("group", ["a", "b"]), ("mesh_index", [[0], [0, 1]])):
        with pytest.raises(ValueError, match=f"scene.json: {key}: expected"):
            load(**{key: value})
    (tmp_path / "list.json").write_text("[]")
    with pytest.raises(ValueError, match="list.json: expected an object"):
        files.load_scene(tmp_path / "list.json")

    def load_motion(**changed: object) -> None:
        np.savez(tmp_path / "moved.npz", **(columns | changed))
        files.load_motion(tmp_path / "moved.npz")

    with pytest.raises(ValueError, match="moved.npz has an unknown key 'positon_t1', perhaps for 'position_t1'; known"):
        load_motion(positon_t1=columns["position_t1"])
    with pytest.raises(ValueError, match="moved.npz has 'position_t1' beside velocities"):
        load_motion(linear_velocity=columns["position_t0"])
    with pytest.raises(ValueError, match="moved.npz: position_t0: expected numbers, got complex128"):
        load_motion(position_t0=1j * columns["position_t0"])


def test_names_of_saved_scenes_are_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh = pgccd.Mesh.box([1.0, 1.0, 1.0])
    x, q = torch.zeros(3, 3, 3), torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(3, 3, 4)
    x[:, 1, 0] = torch.tensor([4.0, -4.0, 0.5])  # through body 0, then into it
    x[:, 2, 2] = 9.0
    names = ["table, left", 'cup "blue"', "lamp"]
    path = str(files.save_scene(tmp_path / "run.json", pgccd.Scene([mesh], [0, 0, 0]), zip(x, q, strict=True), names))
    pair, row = names[:2], '  names="table, left","cup \\"blue\\""  segment=0  toi=0.375  '
    assert main(["audit", "--scene", path]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"pair=0,1{row}")
    assert lines[1:] == [
        'touching  pair=0,1  names="table, left","cup \\"blue\\""  first=2  last=2',
        "bodies=3 frames=3 passages=1 touching=1 enclosed=0",
    ]
    assert main(["audit", "--scene", path, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["passages"][0]["names"] == pair and found["touching"]["names"] == [pair]
    assert main(["detect", "--scene", path]) == 0
    assert capsys.readouterr().out.startswith(f"pair=0,1{row}")
    assert main(["detect", "--scene", path, "--json", "--report", "any"]) == 0
    assert json.loads(capsys.readouterr().out)["contacts"] == [{"pair": [0, 1], "names": pair}]
    page = tmp_path / "page.html"
    assert main(["audit", "--scene", path, "--page", str(page), "--quiet"]) == 0
    assert capsys.readouterr().out.count("\n") == 1
    assert '"names":{"0":"table, left","1":"cup \\"blue\\""}' in page.read_text()
    files.save_scene(path, *files.load_scene(path))
    assert main(["audit", "--scene", path, "--json"]) == 0
    without = json.loads(capsys.readouterr().out)
    assert "names" not in without["passages"][0] and list(without["touching"]) == ["pairs", "first", "last"]
    content = json.loads(Path(path).read_text()) | {"names": ["table"]}
    Path(path).write_text(json.dumps(content))
    assert main(["detect", "--scene", path]) == 2
    assert "argument --scene: " in (error := capsys.readouterr().err) and "names: expected 3 strings" in error


def test_robots(tmp_path: Path, capsys: pytest.CaptureFixture[str], meshes: list[str]) -> None:
    pytest.importorskip("yourdfpy")
    box = '<collision><origin xyz="1 0 0"/><geometry><box size="1.6 0.1 0.1"/></geometry></collision>'
    joint = '<joint name="j" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 0 1"/></joint>'
    robot = tmp_path / "rod.urdf"
    robot.write_text(f'<robot name="rod"><link name="base"/><link name="rod">{box}</link>{joint}</robot>')
    page = str(tmp_path / "robot.html")
    assert main(["view", str(robot), "--page", page]) == 0
    assert capsys.readouterr().out.strip() == f"bodies=1 page={page}"
    path = str(tmp_path / "path.npz")
    np.savez(path, q=np.linspace(-0.5, 0.5, 9)[:, None])
    assert main(["detect", str(robot), meshes[0], "--motion", path, "--json", "--page", page]) == 0
    contacts = json.loads(capsys.readouterr().out)["contacts"]
    assert len(contacts) == 1 and contacts[0]["names"] == ["rod", "a.obj"] and 0.25 < contacts[0]["time"] < 0.26
    assert Path(page).stat().st_size > 10_000
    np.savez(path, q=np.zeros((3, 2)))
    assert main(["detect", str(robot), "--motion", path]) == 2
    assert "argument --motion: q: expected shape (..., 1), got (3, 2)" in capsys.readouterr().err
    np.savez(path, position=np.zeros((3, 2)))
    assert main(["detect", str(robot), "--motion", path]) == 2
    assert "expected q (T, J), got position" in capsys.readouterr().err
    robot.write_text("<robot")
    assert main(["view", str(robot)]) == 2
    assert "argument MESH: " in capsys.readouterr().err
