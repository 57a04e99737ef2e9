"""The command line: `pgccd simulate`, `pgccd detect`, `pgccd info`."""

import argparse
import functools
import json
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn

import torch

import pgccd
from pgccd import distributed, sim
from pgccd.about import describe_installation
from pgccd.checkpoint.lock import FolderError
from pgccd.detection.broad import BROAD_PHASES
from pgccd.detection.narrow import REPORTS
from pgccd.distributed.launch.agreement import on_first, together
from pgccd.files import load_motion, load_scene
from pgccd.geometry.origin import Origin
from pgccd.runtime.memory import is_out_of_memory
from pgccd.sim.checkpoint import Header, require_checkpoint
from pgccd.sim.distributed import command
from pgccd.sim.pictures import write_pictures
from pgccd.sim.progress import Progress, terminal_progress
from pgccd.sim.run_folder import mesh_files
from pgccd.sim.summary import summary_lines, totals

_COMMANDS = ("simulate", "detect", "info")

_DETECT_NOTES = """\
poses.npz holds, for N bodies: position_t0 (N, 3) and orientation_t0 (N, 4), and either
  position_t1 (N, 3) and orientation_t1 (N, 4), or
  linear_velocity (N, 3), angular_velocity (N, 3) in radians and dt, a number.
A pose puts a point v of a mesh file at position + R (v - origin), and the body turns about its origin: that of the
file's coordinates, unless a scene file says otherwise. Orientations are unit quaternions (w, x, y, z), body to world.

scene.json: {"meshes": ["robot.ply", "rock.obj"], "mesh_index": [0, 0, 1], "poses": "poses.npz"}; paths are relative to
it; optional: "group", "mask", "world", "static", "margin", lists with one value per body; "origin", one value per mesh:
[x, y, z] in the file's coordinates, "centroid" (the SBV centre) or "center_of_mass"."""


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
            options = _build_parser().parse_args(arguments)
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
    parser = _Parser(prog="pgccd", description="Continuous collision detection for very many moving meshes.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="command", parser_class=_Parser)

    simulate = commands.add_parser("simulate", help="run the nanorobot model", description="Runs the nanorobot model.")
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
    add("--resume", metavar="DIR", help="continue the run in this folder; auto: the one in --out, if there is one")
    add("--overwrite", action="store_true", help="replace an earlier run in --out")
    add("--no-pictures", action="store_true", help="do not write world.png and world.html")
    command.add_arguments(simulate)
    simulate.set_defaults(run=_simulate)

    detect = commands.add_parser(
        "detect",
        help="find the collisions of one step of any meshes",
        description="Finds the collisions of one step.",
        epilog=_DETECT_NOTES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = detect.add_argument
    add("meshes", nargs="*", metavar="MESH", help="mesh files, one per body")
    add("--motion", metavar="NPZ", help="poses of the bodies at both ends of the step")
    add("--scene", metavar="JSON", help="instead of MESH and --motion: meshes shared by many bodies")
    add("--report", choices=list(REPORTS), default="first", help="which contacts to report (first)")
    add("--min-separation", type=float, default=0.0, metavar="LENGTH", help="distance that counts as touching (0)")
    add("--tolerance", type=float, metavar="LENGTH", help="of a reported contact (1e-6 of the smaller radius)")
    add("--device", default="cpu", help="cpu, cuda, ... (cpu)")
    add("--broad-phase", choices=BROAD_PHASES, default="auto", help="broad phase; does not change the result (auto)")
    add("--json", action="store_true", help="print one JSON object")
    detect.set_defaults(run=_detect)

    info = commands.add_parser("info", help="version, build and devices; statistics of mesh files")
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


def _simulate(options: argparse.Namespace) -> int:
    try:
        comm = command.connect_ranks(options)
    except ValueError as error:
        raise ArgumentError("", error) from error
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
    for line in summary_lines(finished):
        print(line)
    print(f"log: {folder / sim.LOG_FILE}")
    figures = totals(finished)
    if not options.no_pictures:
        try:
            figures |= write_pictures(finished, folder)
        except ImportError as error:
            print(f"no picture: {error}", file=sys.stderr)
        except OSError as error:
            problem = f"pictures cannot be written to {folder}: {error.strerror or error}; the run is complete"
            raise ArgumentError("--out", problem) from error
    print(" ".join(f"{name}={value}" for name, value in figures.items()))
    if finished.interrupted:
        print(f"interrupted; to continue: pgccd simulate --resume {folder}", file=sys.stderr)


def _run_or_resume(options: argparse.Namespace, device: torch.device, comm: distributed.Comm) -> tuple[sim.Run, Path]:
    out = options.out or Path("out/simulate")
    settings: dict[str, Any] = {"device": device, "broad_phase": options.broad_phase}
    settings["checkpoint_every"] = options.checkpoint_every
    begin: Callable[..., sim.Run] = sim.run
    go_on: Callable[..., sim.Run] = sim.resume
    if comm.size > 1:
        spread: dict[str, Any] = {"options": command.distributed_options(options)}
        spread["keep_last_step"] = not options.no_pictures
        begin = functools.partial(sim.distributed.run, comm, **spread)
        go_on = functools.partial(sim.distributed.resume, comm, **spread)
    given = {"robots": options.robots, "pattern": options.world, "seed": options.seed}
    given = {name: value for name, value in given.items() if value is not None}
    try:
        folder = command.folder_to_resume(comm, options.resume, out)
        if folder is not None:
            header = on_first(comm, lambda: require_checkpoint(folder)).run
            _require_same_world(folder, header, given)
            files = options.mesh or on_first(comm, lambda: mesh_files(folder))
            meshes = together(comm, lambda: _load_meshes(files, "--mesh", "centroid"))
            with _progress(comm, header.steps_made, options.steps or header.steps_wanted) as progress:
                return go_on(folder, options.steps, meshes=meshes, progress=progress, **settings), folder
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
    settings |= {"notes": notes, "overwrite": options.overwrite}
    try:
        with _progress(comm, 0, steps) as progress:
            return begin(config, steps, out, meshes=meshes, progress=progress, **settings), out
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


def _progress(comm: distributed.Comm, steps_made: int, steps: int) -> AbstractContextManager[Progress | None]:
    return terminal_progress(steps_made, steps) if comm.rank == 0 else nullcontext()


def _load_meshes(files: Sequence[str] | None, argument: str, origin: Origin = (0, 0, 0)) -> list[pgccd.Mesh] | None:
    try:
        return None if files is None else [pgccd.Mesh.load(name, origin) for name in files]
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


def _detect(options: argparse.Namespace) -> int:
    device = _device(options.device)
    if options.scene is not None and (options.meshes or options.motion is not None):
        raise ArgumentError("--scene", "takes the place of MESH and --motion")
    if options.scene is None and not options.meshes:
        raise ArgumentError("MESH", "expected mesh files, or --scene")
    if options.scene is None and options.motion is None:
        raise ArgumentError("--motion", "expected an npz file with the poses")
    source = "--motion" if options.scene is None else "--scene"
    try:
        if options.scene is not None:
            scene, motion = load_scene(options.scene, device)
        else:
            scene = pgccd.Scene(_load_meshes(options.meshes, "MESH") or [], device=device)
            motion = load_motion(options.motion, device)
    except (ImportError, ValueError) as error:
        raise ArgumentError(source, error) from error
    try:
        hits = pgccd.detect(
            scene,
            motion,
            options.report,
            options.min_separation,
            tolerance=options.tolerance,
            broad_phase=options.broad_phase,
        )
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
    rows = _contact_rows(hits)
    if options.json:
        print(json.dumps({"contacts": rows, "stats": asdict(hits.stats)}))
        return 0
    for row in rows:
        print("  ".join(f"{name}={_plain(value)}" for name, value in row.items()))
    print(f"bodies={hits.stats.bodies} pcs={hits.stats.pcs} contacts={len(hits)} unresolved={hits.stats.unresolved}")
    return 0


def _contact_rows(hits: pgccd.Contacts | pgccd.CollidingPairs) -> list[dict[str, Any]]:
    columns: dict[str, list[Any]] = {"pair": hits.pairs.tolist()}
    if isinstance(hits, pgccd.Contacts):
        columns |= {name: getattr(hits, name).tolist() for name in ("toi", "kind", "features", "point", "normal")}
        columns["kind"] = [pgccd.Kind.names()[kind] for kind in columns["kind"]]
        columns["status"] = [pgccd.Status.names()[status] for status in hits.status.tolist()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _plain(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(_plain(item) for item in value)
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _info(options: argparse.Namespace) -> int:
    for name, value in describe_installation().items():
        print(f"{name:<20}{value}")
    for name, mesh in zip(options.meshes, _load_meshes(options.meshes, "MESH") or [], strict=True):
        centre = ", ".join(f"{x:.9g}" for x in mesh.centre.tolist())
        size = f"{len(mesh.vertices)} vertices, {len(mesh.faces)} faces"
        print(f"{name}: {size}, SBV centre ({centre}), radius {mesh.radius:.9g}")
    return 0
