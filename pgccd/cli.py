"""The command line: `pgccd view`, `pgccd detect`, `pgccd audit`, `pgccd simulate`, `pgccd info`."""

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn

import torch

import pgccd
from pgccd import distributed, sim
from pgccd.about import describe_installation
from pgccd.checkpoint.files import KEEP
from pgccd.checkpoint.lock import FolderError
from pgccd.distributed.checkpoint.reading import open_stored
from pgccd.distributed.launch.agreement import on_first, together
from pgccd.files import bodies_and_poses, frame_columns, iterate_frames, load_configurations, load_motion
from pgccd.geometry.origin import Origin
from pgccd.runtime.memory import is_out_of_memory
from pgccd.search.broad import BROAD_PHASES
from pgccd.search.detect import CollideOptions
from pgccd.search.narrow import REPORTS
from pgccd.sim import command
from pgccd.sim.pictures import shown_steps, write_pictures
from pgccd.sim.progress import Progress, terminal_progress
from pgccd.sim.run_checkpoint import Header, require_checkpoint
from pgccd.sim.run_folder import mesh_files
from pgccd.sim.summary import Totals
from pgccd.viz import Page
from pgccd.viz.animation import AnyHits, AnyMotion, Motions
from pgccd.viz.display import is_page, open_page, require_writable

_COMMANDS = ("view", "detect", "audit", "simulate", "info")
# Readers of robots, by the suffix of the file.
_ROBOTS: dict[str, Callable[[str], pgccd.robots.Robot]] = {
    ".urdf": lambda path: pgccd.robots.load_urdf(path),
    ".xml": lambda path: pgccd.robots.load_mjcf(path),
}

_EXAMPLES = """\
examples:
  pgccd view robot.ply                                     a mesh in the browser
  pgccd view arm.ply box.obj --motion trajectory.npz       bodies on their paths
  pgccd detect a.ply b.ply --motion poses.npz              the collisions of one step
  pgccd detect --scene scene.json --page contacts.html     and a page that shows them
  pgccd detect --scene scene.json --json                   for programs
  pgccd detect arm.urdf table.obj --motion path.npz        a robot (URDF or MJCF) among obstacles
  pgccd audit --scene scene.json --page passages.html      what a rollout tunnelled through
  pgccd simulate --robots 2000 --steps 10 --out out/try    the nanorobot model
  pgccd info robot.ply                                     version, devices; size of a mesh

pgccd COMMAND --help lists the options of a command."""

_FILE_NOTES = """\
poses.npz holds, for N bodies, one of these:
  position_t0 (N, 3), orientation_t0 (N, 4), position_t1 (N, 3), orientation_t1 (N, 4);
  position_t0, orientation_t0, position_t1, rotation (N, 3), vectors;
  position_t0, orientation_t0, linear_velocity (N, 3), angular_velocity (N, 3) in radians, and dt, a number;
  a trajectory of T waypoints: position (T, N, 3), orientation (T, N, 4); optionally rotation (T - 1, N, 3), vectors;
  deforming bodies: x_t0, x_t1 (X, 3), the vertices of all bodies, or position (T, X, 3) alone;
  for any trajectory, optionally margin (T - 1, N); for rigid bodies, optionally path, "rigid" or "linear".
If the first MESH is a robot (.urdf, or .xml for MJCF), it holds q (T, J): configurations, between which joints move at
constant rates. All other MESH files are then obstacles. Contacts may be due to the margins of links (see
pgccd.robots.certify).
Lengths of mesh files that state their unit (Collada, 3MF, glTF) are converted to metres.
A pose puts a point v of a mesh file at position + R (v - origin), and the body turns about its origin: the origin of
the file's coordinates, unless a scene file says otherwise. Orientations are unit quaternions (w, x, y, z), body to
world.

scene.json: {"meshes": ["robot.ply", "rock.obj"], "mesh_index": [0, 0, 1], "poses": "poses.npz"}; paths are relative to
it; optional: "group", "mask", "world", "static", "self_collision", "margin", "names", lists with one value per body;
"exclude", pairs of bodies that are never tested; "origin", one value per mesh: [x, y, z] in the converted coordinates,
"centroid" (the SBV centre) or "center_of_mass"; "solid", one value per mesh: true, false or "auto"; "thickness", one
length per mesh. In Python, pgccd.files.save_scene and the simulators of pgccd.simulators write such files, with their
meshes in an npz file."""


class ArgumentError(Exception):
    """A one-line message about an invalid argument."""

    def __init__(self, argument: str, problem: object) -> None:
        super().__init__(f"argument {argument}: {problem}" if argument else str(problem))


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:  # without the usage text
        raise ArgumentError("", message)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code: 0, 2 for bad arguments, 130 when interrupted."""
    arguments = sys.argv[1:] if arguments is None else arguments
    name = arguments[0] if arguments and arguments[0] in _COMMANDS else ""
    try:
        try:
            parser = _build_parser()
            options = parser.parse_args(arguments)
            if options.command is None:
                parser.print_help()
                return 0
            if options.command == "simulate":
                _check_simulate(options)
        except ArgumentError as error:
            if name == "simulate":  # other ranks must not wait for this one
                problem = command.tell_ranks(error)
                raise ArgumentError("", problem) from problem
            raise
        return options.run(options)
    except ArgumentError as error:
        if name == "simulate" and command.is_told_by_rank_0(error):
            return 2
        print(f"{f'pgccd {name}'.strip()}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


def _build_parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="pgccd",
        description="Continuous collision detection for very many moving meshes.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"pgccd {pgccd.__version__}")
    commands = parser.add_subparsers(dest="command", metavar="command", parser_class=_Parser)
    as_json = _Parser(add_help=False)
    as_json.add_argument("--json", action="store_true", help="print one JSON object")
    output = _Parser(add_help=False, parents=[as_json])
    output.add_argument("--quiet", action="store_true", help="print the last line only, and no progress")

    def with_files(name: str, summary: str, description: str) -> argparse.ArgumentParser:
        made = commands.add_parser(
            name,
            parents=[output],
            help=summary,
            description=description,
            epilog=_FILE_NOTES,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        made.add_argument("meshes", nargs="*", metavar="MESH", help="mesh files, one per body")
        made.add_argument("--motion", metavar="NPZ", help="poses of the bodies: of one step, or a trajectory")
        made.add_argument("--scene", metavar="JSON", help="instead of MESH and --motion: meshes shared by many bodies")
        return made

    view = with_files(
        "view",
        "show meshes, and their paths, in the browser",
        "Writes an interactive page of bodies, on their paths if there is a --motion, without looking for collisions.",
    )
    where = "HTML page, .png picture or .glb model to write (a temporary page, opened in the browser)"
    view.add_argument("--page", type=Path, metavar="FILE", help=where)
    view.set_defaults(run=_view)

    detect = with_files(
        "detect",
        "find the collisions of any meshes in one step or along a trajectory",
        "Finds the collisions of one step, or along a trajectory.",
    )
    add = detect.add_argument
    add("--page", type=Path, metavar="FILE", help="write an interactive HTML page of the contacts; or a .png or .glb")
    add("--report", choices=list(REPORTS), default="first", help="which contacts; any: only colliding pairs (first)")
    add("--min-separation", type=float, default=0.0, metavar="LENGTH", help="distance that counts as touching (0)")
    add("--tolerance", type=float, metavar="LENGTH", help="of a reported contact (1e-6 of the smaller radius)")
    add("--device", default="cpu", help="cpu, cuda, ... (cpu)")
    add("--broad-phase", choices=BROAD_PHASES, default="auto", help="broad phase; does not change the result (auto)")
    detect.set_defaults(run=_detect)

    audit = with_files(
        "audit",
        "find the contacts between the frames of a rollout that the frames do not show",
        "Finds the passages between the frames of a trajectory that the frames do not show: pairs of bodies that are\n"
        "apart at two frames, and touch in between. A file with position and orientation, or with position alone, is\n"
        "read frame by frame, and may be larger than memory.",
    )
    add = audit.add_argument
    add("--page", type=Path, metavar="FILE", help="write an HTML page of the deepest passages; or a .png or .glb")
    add("--min-separation", type=float, default=0.0, metavar="LENGTH", help="distance that counts as touching (0)")
    add("--tolerance", type=float, metavar="LENGTH", help="of a reported contact (1e-6 of the smaller radius)")
    add("--device", default="cpu", help="cpu, cuda, ... (cpu)")
    audit.set_defaults(run=_audit)

    simulate = commands.add_parser(
        "simulate", parents=[output], help="run the nanorobot model", description="Runs the nanorobot model."
    )
    add = simulate.add_argument
    add("--robots", type=int, metavar="N", help="number of robots (10000)")
    add("--steps", type=int, metavar="S", help="total number of steps (20; with --resume: that of the run)")
    add("--world", choices=sim.PATTERNS, help="movement pattern (random)")
    add("--mesh", nargs="+", metavar="FILE", help="meshes of the robots, assigned in turn (the built-in robot)")
    add("--device", default="cpu", help="cpu, cuda, cuda:1, ... (cpu)")
    add("--broad-phase", choices=BROAD_PHASES, default="auto", help="broad phase; does not change the result (auto)")
    add("--seed", type=int, help="random seed (0)")
    add("--out", type=Path, metavar="DIR", help="folder of the log, checkpoints and pictures (out/simulate)")
    add("--checkpoint-every", type=int, default=0, metavar="K", help="steps between checkpoints (one at the end)")
    add("--keep", type=int, default=KEEP, metavar="N", help=f"checkpoints to keep: the newest ones ({KEEP})")
    add("--resume", metavar="DIR", help="continue the run in this folder; auto: the one in --out, if there is one")
    add("--overwrite", action="store_true", help="replace an earlier run in --out")
    add("--no-pictures", action="store_true", help="do not write world.png and world.html")
    command.add_arguments(simulate)
    simulate.set_defaults(run=_simulate)

    info = commands.add_parser("info", parents=[as_json], help="version, build and devices; statistics of mesh files")
    info.add_argument("meshes", nargs="*", metavar="MESH", help="mesh files to describe")
    info.set_defaults(run=_info)
    return parser


def _check_simulate(options: argparse.Namespace) -> None:
    """Checks that need no connection between ranks."""
    if options.resume not in (None, "auto"):
        for name in ("robots", "world", "seed", "out"):
            if getattr(options, name) is not None:
                raise ArgumentError(f"--{name}", "not allowed with --resume, which continues the existing world")
        if options.overwrite:
            raise ArgumentError("--overwrite", "not allowed with --resume")
    elif options.robots is not None and options.robots < 1:
        raise ArgumentError("--robots", f"expected at least 1, got {options.robots}")
    if options.steps is not None and options.steps < 0:
        raise ArgumentError("--steps", f"expected a number >= 0, got {options.steps}")
    if options.checkpoint_every < 0:
        raise ArgumentError("--checkpoint-every", f"expected a number >= 0, got {options.checkpoint_every}")
    if options.keep < 1:
        raise ArgumentError("--keep", f"expected at least 1, got {options.keep}")


def _simulate(options: argparse.Namespace) -> int:
    try:
        comm = command.connect_ranks(options)
    except ValueError as error:
        text = str(error)
        argument = "--device" if text.startswith("device: ") else ""
        raise ArgumentError(argument, text.removeprefix("device: ")) from error
    with command.stopping(comm):
        try:
            device = together(comm, lambda: _device(options.device))
            finished, folder = _run_or_resume(options, device, comm)
        except NotImplementedError as error:
            raise ArgumentError("--device", f"this build of pgccd has no kernels for {options.device}") from error
        except RuntimeError as error:
            if not is_out_of_memory(error):
                raise
            raise ArgumentError("--robots", f"too many for the memory of {options.device}: {error}") from error
        except ValueError as error:  # an option that differs between ranks, or is invalid on another rank
            raise ArgumentError("", error) from error
        if comm.rank == 0:
            _print_run(finished, folder, options)
    return 130 if finished.interrupted else 0


def _print_run(finished: sim.Run, folder: Path, options: argparse.Namespace) -> None:
    totals = Totals(finished)
    if not (options.quiet or options.json):
        for line in totals.lines:
            print(line)
        print(f"log: {folder / sim.LOG_FILE}")
    figures = totals.figures
    if not options.no_pictures:
        try:
            figures |= write_pictures(finished, folder)
        except ImportError as error:
            print(f"no picture: {error}", file=sys.stderr)
        except OSError as error:
            problem = f"pictures cannot be written to {folder}: {error.strerror or error}; the run is complete"
            raise ArgumentError("--out", problem) from error
    if options.json:
        figures |= {"seconds_per_step": float(figures["seconds_per_step"]), "log": folder / sim.LOG_FILE}
        print(json.dumps(figures | {"interrupted": finished.interrupted}, default=str))
    else:
        print(" ".join(f"{name}={value}" for name, value in figures.items()))
    if finished.interrupted:
        print(f"interrupted; to continue: pgccd simulate --resume {folder}", file=sys.stderr)


def _run_or_resume(options: argparse.Namespace, device: torch.device, comm: distributed.Comm) -> tuple[sim.Run, Path]:
    out = options.out or Path("out/simulate")
    settings: dict[str, Any] = {"device": device, "checkpoint_every": options.checkpoint_every, "keep": options.keep}
    settings |= {"comm": comm, "options": command.rank_options(options)}

    def kept(config: sim.ModelConfig) -> int:
        return 0 if options.no_pictures else shown_steps(config)

    given = {"robots": options.robots, "pattern": options.world, "seed": options.seed}
    given = {name: value for name, value in given.items() if value is not None}
    try:
        folder = command.folder_to_resume(comm, options.resume, out)
        if folder is not None:
            header = open_stored(comm, lambda index: require_checkpoint(folder, index)).run
            _require_same_world(folder, header, given)
            files = options.mesh or on_first(comm, lambda: mesh_files(folder))
            meshes = together(comm, lambda: _load_meshes(files, "--mesh", "centroid"))
            with _progress(comm, options, header.steps_made, options.steps or header.steps_wanted) as progress:
                settings["keep_steps"] = kept(header.config)
                return sim.resume(folder, options.steps, meshes=meshes, progress=progress, **settings), folder
    except (ValueError, OSError) as error:
        raise ArgumentError("--resume", error) from error
    try:
        config = sim.ModelConfig(**given)
    except ValueError as error:
        field, _, problem = str(error).partition(": ")
        raise ArgumentError(_option(field), problem) from error
    meshes = together(comm, lambda: _load_meshes(options.mesh, "--mesh", "centroid"))
    steps = 20 if options.steps is None else options.steps
    notes = {"mesh_files": [str(Path(name).resolve()) for name in options.mesh or []]}
    settings |= {"notes": notes, "overwrite": options.overwrite, "keep_steps": kept(config)}
    try:
        with _progress(comm, options, 0, steps) as progress:
            return sim.run(config, steps, out, meshes=meshes, progress=progress, **settings), out
    except (FolderError, sim.CheckpointError) as error:
        raise ArgumentError("--out", str(error).removeprefix("folder: ")) from error


def _require_same_world(folder: Path, header: Header, given: dict[str, Any]) -> None:
    """Raises unless the run that `--resume auto` continues has the options given."""
    for name, value in given.items():
        there = getattr(header.config, name)
        if there != value:
            raise ArgumentError(_option(name), f"the run in {folder} has {there}, got {value}")


def _option(field: str) -> str:
    """The option that sets a field of the configuration."""
    return "--" + field.replace("pattern", "world")


def _progress(
    comm: distributed.Comm, options: argparse.Namespace, steps_made: int, steps: int
) -> AbstractContextManager[Progress | None]:
    is_shown = comm.rank == 0 and not options.quiet
    return terminal_progress(steps_made, steps) if is_shown else nullcontext()


def _load_meshes(files: Sequence[str] | None, argument: str, origin: Origin = (0, 0, 0)) -> list[pgccd.Mesh] | None:
    try:
        # In metres, as robots and scene files: files may state different units.
        return None if files is None else [pgccd.Mesh.load(name, origin, unit="m") for name in files]
    except (ValueError, OSError, ImportError) as error:
        raise ArgumentError(argument, str(error).removeprefix("path: ")) from error


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ArgumentError("--device", f"expected cpu, cuda or cuda:INDEX, got {name!r}") from error
    device = distributed.choose_device(device)
    if device.type not in ("cpu", "cuda"):
        raise ArgumentError("--device", f"expected cpu, cuda or cuda:INDEX, got {name!r}")
    if device.type == "cuda" and not 0 <= (device.index or 0) < torch.cuda.device_count():
        raise ArgumentError("--device", f"{name} is not available: torch sees {torch.cuda.device_count()} CUDA devices")
    return device


def _inputs(
    options: argparse.Namespace, device: torch.device, needs_motion: bool, by_frames: bool = False
) -> tuple[pgccd.Scene, Any, str, list[str] | None]:
    """The scene and motion that the options name, the option of the motion, and the names of the bodies, if files have
    them. With `by_frames` the motion is an iterator over frames, if the file allows it.
    """
    read = _load_frames if by_frames else load_motion
    if options.page is not None:
        try:
            require_writable(options.page)
        except (OSError, ValueError) as error:
            raise ArgumentError("--page", str(error).removeprefix("path: ")) from error
    if options.scene is not None and (options.meshes or options.motion is not None):
        raise ArgumentError("--scene", "takes the place of MESH and --motion")
    if options.scene is None and not options.meshes:
        raise ArgumentError("MESH", "expected mesh files, or --scene")
    for name in options.meshes or ():
        if Path(name).suffix == ".json":
            raise ArgumentError("MESH", f"expected mesh files, got {name}: a scene file is given as --scene {name}")
    if options.scene is None and options.motion is None and needs_motion:
        raise ArgumentError("--motion", "expected an npz file with the poses")
    source = "--motion" if options.scene is None else "--scene"
    try:
        if options.meshes and Path(options.meshes[0]).suffix in _ROBOTS:
            scene, motion, names = _robot(options, device)
            return scene, motion, source, names
        if options.scene is not None:
            scene, poses, of_bodies = bodies_and_poses(options.scene, device)
            return scene, read(poses, device), source, of_bodies
        scene = pgccd.Scene(_load_meshes(options.meshes, "MESH") or [], device=device)
        if options.motion is not None:
            return scene, read(options.motion, device), source, None
    except (ImportError, ValueError) as error:
        raise ArgumentError(source, error) from error
    position = torch.zeros((scene.body_count, 3), dtype=torch.float64)
    orientation = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).repeat(scene.body_count, 1)
    return scene, pgccd.RigidMotion.at_rest(position, orientation), source, None


def _load_frames(path: str | Path, device: torch.device) -> Any:
    path = Path(path)
    return load_motion(path, device) if frame_columns(path) is None else iterate_frames(path, device)


def _robot(options: argparse.Namespace, device: torch.device) -> tuple[pgccd.Scene, AnyMotion, list[str]]:
    """A robot and its obstacles, on its path through configurations; without --motion, with all joints at 0. Bodies
    have the names of the robot's links and of the obstacles' files.
    """
    file, *others = options.meshes
    try:
        robot = _ROBOTS[Path(file).suffix](file)
    except (OSError, ValueError) as error:
        raise ArgumentError("MESH", str(error).removeprefix("path: ")) from error
    if robot.untested and not options.quiet:
        pairs = ", ".join(f"{a} - {b} ({why})" for a, b, why in robot.untested)
        print(f"untested pairs of links: {pairs}", file=sys.stderr)
    obstacles = pgccd.robots.Obstacles(_load_meshes(others, "MESH") or []) if others else None
    q = torch.zeros((2, robot.joint_count), dtype=torch.float64)
    if options.motion is not None:
        q = load_configurations(options.motion)
    names = [robot.link_names[link] for link in robot.body_link.tolist()] + [Path(other).name for other in others]
    return robot.scene(obstacles).to(device), robot.trajectory(q.to(device), obstacles), names


def _write_page(
    options: argparse.Namespace,
    scene: pgccd.Scene,
    motion: Motions,
    hits: AnyHits = None,
    names: list[str] | None = None,
) -> Path:
    """Writes the page that the options ask for; returns its path."""
    try:
        if options.page is not None and not is_page(options.page):
            return pgccd.show(scene, motion, hits, path=options.page, names=names)
        page = Page.of(scene, motion, hits, names=names)
        if not options.quiet:
            for sentence in page.left_out:
                print(sentence, file=sys.stderr)
        if options.page is not None:
            return page.save(options.page)
        open_page(page)
    except (OSError, ImportError) as error:
        raise ArgumentError("--page", str(error).removeprefix("path: ")) from error
    except ValueError as error:
        raise ArgumentError("--motion" if options.scene is None else "--scene", error) from error
    assert page.path is not None
    return page.path


def _view(options: argparse.Namespace) -> int:
    scene, motion, *_ = _inputs(options, torch.device("cpu"), needs_motion=False)
    path = _write_page(options, scene, motion)
    if options.json:
        print(json.dumps({"page": str(path), "bodies": scene.body_count}))
    else:
        print(f"bodies={scene.body_count} page={path}")
    return 0


def _detect(options: argparse.Namespace) -> int:
    device = _device(options.device)
    scene, motion, source, names = _inputs(options, device, needs_motion=True)
    with _naming_options(source, device):
        given: CollideOptions = {"tolerance": options.tolerance, "broad_phase": options.broad_phase}
        hits: pgccd.Contacts | pgccd.CollidingPairs
        if options.report == "any":
            hits = pgccd.collide(scene, motion, options.min_separation, **given)
        else:
            hits = pgccd.detect(scene, motion, options.report, options.min_separation, **given)
    rows = _contact_rows(hits, names)
    page = {} if options.page is None else {"page": str(_write_page(options, scene, motion, hits, names))}
    if options.json:
        print(json.dumps({"contacts": rows, "stats": asdict(hits.stats)} | page))
        return 0
    for row in [] if options.quiet else rows:
        print("  ".join(f"{name}={_plain(value)}" for name, value in row.items()))
    stats = hits.stats
    figures: dict[str, Any] = {"bodies": stats.bodies, "pcs": stats.pcs, "contacts": len(hits)}
    print(" ".join(f"{name}={v}" for name, v in (figures | {"unresolved": stats.unresolved} | page).items()))
    return 0


def _audit(options: argparse.Namespace) -> int:
    device = _device(options.device)
    scene, rollout, source, names = _inputs(options, device, needs_motion=True, by_frames=True)
    if isinstance(rollout, (pgccd.RigidMotion, pgccd.VertexMotion)):
        raise ArgumentError(source, "expected a trajectory: position (T, N, 3), orientation (T, N, 4)")
    with _naming_options(source, device):
        found = pgccd.audit(scene, rollout, options.min_separation, tolerance=options.tolerance)
    page: dict[str, Any] = {}
    if options.page is not None and len(found.passages):
        page["page"] = str(_write_page(options, scene, *found.steps(), names))
    elif options.page is not None:
        print(f"no passages, so {options.page} is not written", file=sys.stderr)
    rows = _contact_rows(found.passages, names)
    if options.json:
        touching = {name: getattr(found.touching, name).tolist() for name in ("pairs", "first", "last")}
        touching |= _names_of(touching["pairs"], names)
        listed = {"passages": rows, "touching": touching, "enclosed": _contact_rows(found.enclosed, names)}
        print(json.dumps({"frames": found.frames} | listed | page))
        return 0
    for row in [] if options.quiet else rows:
        print("  ".join(f"{name}={_plain(value)}" for name, value in row.items()))
    for row in [] if options.quiet else _touching_rows(found.touching, names):
        print("touching  " + "  ".join(f"{name}={_plain(value)}" for name, value in row.items()))
    figures = {"bodies": scene.body_count, "frames": found.frames}
    figures |= {name: len(getattr(found, name)) for name in ("passages", "touching", "enclosed")}
    print(" ".join(f"{name}={value}" for name, value in (figures | page).items()))
    return 0


@contextmanager
def _naming_options(source: str, device: torch.device) -> Iterator[None]:
    """Errors of a search of the bodies from `source` name options."""
    try:
        yield
    except ValueError as error:
        name, _, problem = str(error).partition(": ")
        own = {"min_separation": "--min-separation", "tolerance": "--tolerance"}
        raise ArgumentError(own.get(name, source), problem if name in own else error) from error
    except NotImplementedError as error:
        raise ArgumentError("--device", f"this build of pgccd has no kernels for {device.type}") from error
    except RuntimeError as error:
        if not is_out_of_memory(error):
            raise
        raise ArgumentError(source, f"too much for the memory of {device}: {error}") from error


def _names_of(pairs: list[list[int]], names: Sequence[str] | None) -> dict[str, list[Any]]:
    """The names of pairs of bodies as a column, if they have names."""
    return {} if names is None else {"names": [[names[body] for body in pair] for pair in pairs]}


def _touching_rows(touching: pgccd.Touching, names: Sequence[str] | None) -> list[dict[str, Any]]:
    pairs = touching.pairs.tolist()
    columns: dict[str, list[Any]] = {"pair": pairs} | _names_of(pairs, names)
    columns |= {name: getattr(touching, name).tolist() for name in ("first", "last")}
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _contact_rows(hits: pgccd.Contacts | pgccd.CollidingPairs, names: Sequence[str] | None) -> list[dict[str, Any]]:
    pairs = hits.pairs.tolist()
    columns: dict[str, list[Any]] = {"pair": pairs} | _names_of(pairs, names)
    if isinstance(hits, pgccd.Contacts):
        kept = ["segment", "toi", "time"] if isinstance(hits, pgccd.TrajectoryContacts) else ["toi"]
        kept += ["approach", "measure"] if isinstance(hits, pgccd.Passages) else []
        columns |= {name: getattr(hits, name).tolist() for name in (*kept, "kind", "features", "point", "normal")}
        # Bodies inside of solids have no normal.
        columns["normal"] = [None if math.isnan(x) else [x, y, z] for x, y, z in columns["normal"]]
        columns["kind"] = [pgccd.Kind.names()[kind] for kind in columns["kind"]]
        columns["status"] = [pgccd.Status.names()[status] for status in hits.status.tolist()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _plain(value: Any) -> str:
    if isinstance(value, list):
        # Names of bodies may contain commas and spaces.
        items = (json.dumps(item, ensure_ascii=False) if isinstance(item, str) else item for item in value)
        return ",".join(_plain(item) for item in items)
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _info(options: argparse.Namespace) -> int:
    installation = describe_installation()
    if options.json:
        sizes = []
        for name, mesh in zip(options.meshes, _load_meshes(options.meshes, "MESH") or [], strict=True):
            row: dict[str, Any] = {"file": name} | _sizes(mesh)
            sizes.append(row | {"centre": mesh.centre.tolist(), "radius": mesh.radius})
        print(json.dumps(installation | {"meshes": sizes}))
        return 0
    for name, text in installation.items():
        print(f"{name:<20}{text}")
    for name, mesh in zip(options.meshes, _load_meshes(options.meshes, "MESH") or [], strict=True):
        centre = ", ".join(f"{x:.9g}" for x in mesh.centre.tolist())
        size = ", ".join(f"{count} {what}" for what, count in _sizes(mesh).items() if count)
        print(f"{name}: {size}, SBV centre ({centre}), radius {mesh.radius:.9g}")
    return 0


def _sizes(mesh: pgccd.Mesh) -> dict[str, int]:
    """Numbers of vertices, and of triangles, segments and points."""
    counts = {"vertices": len(mesh.vertices), "faces": mesh.triangle_count}
    return counts | {"segments": mesh.segment_count, "points": mesh.point_count}
