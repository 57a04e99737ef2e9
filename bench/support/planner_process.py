"""Runs one motion planner on problems, in a process of its own: planners need different versions of NumPy.

    python planner_process.py NAME PROBLEMS RESULT --seed N --seconds S

Every planner reads the URDF and the SRDF of a problem, has its default settings, and returns its path as it was found
and as it was simplified. Without a planner's package the exit status is 3.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

NOT_INSTALLED = 3
ARM = [f"panda_joint{k}" for k in range(1, 8)]
#: A problem as described in the file; the path of its URDF and SRDF, without an ending.
Problem = dict[str, Any]
#: Paths (T, 7) by name, in the order in which they are made, and the seconds that it took to have each.
Found = dict[str, tuple[np.ndarray, float]]


def main() -> None:
    """Runs the planner."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=list(PLANNERS))
    parser.add_argument("problems", type=Path)
    parser.add_argument("result", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=5.0, help="to plan, where a planner has such a limit")
    arguments = parser.parse_args()
    make, packages = PLANNERS[arguments.name]
    try:
        plan = make(arguments.seed, arguments.seconds)
        versions = {package: importlib.metadata.version(package) for package in packages}
    except ImportError as error:
        print(error)
        sys.exit(NOT_INSTALLED)
    rows: list[dict[str, Any]] = []
    for problem in json.loads(arguments.problems.read_text()):
        row: dict[str, Any] = {"kind": problem["kind"], "number": problem["number"], "paths": [], "failed": None}
        begin = time.perf_counter()
        try:
            found, more = plan(problem)
            for name, (path, seconds) in found.items():
                row["paths"].append({"name": name, "q": np.asarray(path).tolist(), "seconds": seconds})
            row |= more
        except UnsolvedError as error:
            row["failed"] = str(error)
        rows.append(row | {"wall": time.perf_counter() - begin})
    arguments.result.write_text(json.dumps({"versions": versions, "rows": rows}))


class UnsolvedError(Exception):
    """No path was found, and why."""


#: A path of a problem, and what else is known of it.
Plan = Callable[[Problem], tuple[Found, dict[str, Any]]]


class Discrete:
    """Whether configurations collide, by pinocchio and coal, with the pairs of the SRDF whose boxes overlap in a tree
    (eight times as fast as all pairs).
    """

    def __init__(self, path: str) -> None:
        import pinocchio as pin

        self._pin, urdf = pin, f"{path}.urdf"
        self.model = pin.buildModelFromUrdf(urdf)
        self.geometry = pin.buildGeomFromUrdf(self.model, urdf, pin.GeometryType.COLLISION)
        self.geometry.addAllCollisionPairs()
        pin.removeCollisionPairs(self.model, self.geometry, f"{path}.srdf")
        self.state, self._places = self.model.createData(), pin.GeometryData(self.geometry)
        tree = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager
        self._tree = tree(self.model, self.geometry, self._places)
        self.calls, self.seconds = 0, 0.0

    def collides(self, q: np.ndarray) -> bool:
        """Whether any pair touches; ends at the first one."""
        begin = time.perf_counter()
        found = self._pin.computeCollisions(self.model, self.state, self._tree, q, True)
        self.seconds += time.perf_counter() - begin
        self.calls += 1
        return bool(found)

    def pairs(self) -> set[frozenset[str]]:
        """The names of the links that are tested against each other."""
        objects, frames = self.geometry.geometryObjects, self.model.frames
        link = [frames[each.parentFrame].name for each in objects]
        return {frozenset((link[pair.first], link[pair.second])) for pair in self.geometry.collisionPairs}


def ompl_setup(low: np.ndarray, high: np.ndarray, fraction: float | None = None) -> Any:
    """A `SimpleSetup` of a space with these limits and, by default, OMPL's resolution of motions."""
    from ompl import base, geometric

    space, bounds = base.RealVectorStateSpace(len(low)), base.RealVectorBounds(len(low))
    for k in range(len(low)):
        bounds.setLow(k, float(low[k]))
        bounds.setHigh(k, float(high[k]))
    space.setBounds(bounds)
    if fraction is not None:
        space.setLongestValidSegmentFraction(fraction)
    return geometric.SimpleSetup(space)


def discrete_checker(information: Any, discrete: Discrete) -> Any:
    """A state validity checker of OMPL with `discrete`."""
    from ompl import base

    class Checker(base.StateValidityChecker):
        def isValid(self, state: Any) -> bool:  # noqa: N802
            q = np.array([state[k] for k in range(7)])
            return bool(information.satisfiesBounds(state)) and not discrete.collides(q)

    return Checker(information)


def ompl_state(information: Any, q: list[float]) -> Any:
    """A state with these values."""
    state = information.allocState()
    for k, value in enumerate(q):
        state[k] = value
    return state


def ompl_plan(setup: Any, problem: Problem, seconds: float) -> Found:
    """RRT-Connect from start to goal, with OMPL's simplification of the path."""
    from ompl import geometric

    information = setup.getSpaceInformation()
    setup.setPlanner(geometric.RRTConnect(information))
    ends = [ompl_state(information, problem[end]) for end in ("start", "goal")]
    setup.setStartAndGoalStates(*ends)
    begin = time.perf_counter()
    setup.solve(seconds)
    found = time.perf_counter() - begin
    if not setup.haveExactSolutionPath():
        raise UnsolvedError(f"no path within {seconds:g} s")
    raw = waypoints(setup.getSolutionPath())
    begin = time.perf_counter()
    setup.simplifySolution()
    simplified = found + time.perf_counter() - begin
    return {"found": (raw, found), "simplified": (waypoints(setup.getSolutionPath()), simplified)}


def waypoints(path: Any) -> np.ndarray:
    """(T, 7) of a path of OMPL."""
    return np.array([[state[k] for k in range(7)] for state in path.getStates()])


def ompl_seeded(seed: int) -> None:
    """OMPL without messages, and with this seed."""
    from ompl import util

    util.setLogLevel(util.LogLevel.LOG_ERROR)
    util.RNG.setSeed(seed)


def with_ompl(fraction: float | None, seed: int, seconds: float) -> Plan:
    """OMPL's RRT-Connect, whose states are checked by pinocchio and coal at a resolution."""
    import pinocchio

    del pinocchio
    ompl_seeded(seed)

    def plan(problem: Problem) -> tuple[Found, dict[str, Any]]:
        discrete = Discrete(problem["path"])
        low, high = discrete.model.lowerPositionLimit, discrete.model.upperPositionLimit
        setup = ompl_setup(low, high, fraction)
        information = setup.getSpaceInformation()
        checker = discrete_checker(information, discrete)
        setup.setStateValidityChecker(checker)
        found = ompl_plan(setup, problem, seconds)
        return found, {"checks": discrete.calls, "checking": discrete.seconds}

    return plan


def with_vamp(seed: int, seconds: float) -> Plan:
    """VAMP's RRT-Connect, which knows the Panda as spheres, boxes as they are, and cylinders as capsules around."""
    import vamp

    robot, function, planning, simplifying = vamp.configure_robot_and_planner_with_kwargs("panda", "rrtc")
    del seconds  # it has a limit of iterations

    def world_of(problem: Problem) -> Any:
        world = vamp.Environment()
        for solid in problem["solids"]:
            at, turn, size = solid["position"], [0.0, 0.0, solid["yaw"]], solid["size"]
            if len(size) == 3:
                world.add_cuboid(vamp.Cuboid(at, turn, [0.5 * length for length in size]))
            else:
                world.add_capsule(vamp.Cylinder(at, turn, *size))
        return world

    def plan(problem: Problem) -> tuple[Found, dict[str, Any]]:
        world = world_of(problem)
        if "check" in problem:
            q = problem["check"]
            spheres = [[ball.x, ball.y, ball.z, ball.r] for ball in robot.fk(q)]
            return {}, {"valid": bool(robot.validate(q, world)), "spheres": spheres}
        start, goal = problem["start"], problem["goal"]
        for end, q in (("start", start), ("goal", goal)):
            if not robot.validate(q, world):
                raise UnsolvedError(f"spheres collide at the {end}")
        sampler = robot.halton()
        sampler.skip(seed)
        begin = time.perf_counter()
        result = function(start, goal, world, planning, sampler)
        found = time.perf_counter() - begin
        if not result.solved:
            raise UnsolvedError("no path within its iterations")
        begin = time.perf_counter()
        simple = robot.simplify(result.path, world, simplifying, sampler)
        simplified = found + time.perf_counter() - begin
        paths = (np.asarray(path.numpy(), dtype=np.float64) for path in (result.path, simple.path))
        return dict(zip(("found", "simplified"), zip(paths, (found, simplified), strict=True), strict=True)), {}

    return plan


def with_mplib(seed: int, seconds: float) -> Plan:
    """MPlib: its RRT-Connect with steps of 0.1, and the timed trajectory of 0.1 s a point that it returns."""
    import mplib

    del seconds  # its own default

    def plan(problem: Problem) -> tuple[Found, dict[str, Any]]:
        mplib.pymp.set_global_seed(seed)
        # It reads meshes relative to the file alone.
        urdf = Path(f"{problem['path']}.urdf")
        root = ElementTree.parse(urdf)
        for mesh in root.iter("mesh"):
            mesh.set("filename", os.path.relpath(mesh.get("filename", ""), urdf.parent))
        urdf = urdf.with_name(f"{urdf.stem}_relative.urdf")
        root.write(urdf)
        planner = mplib.Planner(urdf, "panda_hand_tcp", srdf=f"{problem['path']}.srdf")
        start, goal = np.array(problem["start"]), np.array(problem["goal"])
        planner.robot.set_qpos(start, True)
        paths: Found = {}
        for name, is_simplified in (("found", False), ("simplified", True)):
            begin = time.perf_counter()
            status, path = planner.planner.plan(start, [goal], time=1.0, range=0.1, simplify=is_simplified)
            if status != "Exact solution":
                raise UnsolvedError(status)
            paths[name] = np.asarray(path), time.perf_counter() - begin
        begin = time.perf_counter()
        result = planner.plan_qpos([goal], start)
        if result["status"] == "Success":
            paths["trajectory"] = np.asarray(result["position"]), time.perf_counter() - begin
        return paths, {}

    return plan


def with_roboplan(seed: int, seconds: float) -> Plan:
    """RoboPlan's RRT-Connect (it has RRT by default) and its shortcuts."""
    from roboplan import core, rrt

    def plan(problem: Problem) -> tuple[Found, dict[str, Any]]:
        description = core.loadUrdfSceneDescription(f"{problem['path']}.urdf", [])
        scene = core.Scene("scene", description)
        scene.importSrdf(Path(f"{problem['path']}.srdf").read_text())
        planner = rrt.RRT(scene, rrt.RRTOptions(group_name="arm", rrt_connect=True, max_planning_time=seconds))
        planner.setRngSeed(seed)
        start, goal = (core.JointConfiguration(ARM, np.array(problem[end])) for end in ("start", "goal"))
        begin = time.perf_counter()
        try:
            path = planner.plan(start, goal)
        except RuntimeError as error:
            raise UnsolvedError(str(error)) from error
        found = time.perf_counter() - begin
        shortcutter = core.PathShortcutter(scene, core.PathShortcuttingOptions(group_name="arm", seed=seed))
        begin = time.perf_counter()
        short = shortcutter.shortcut(path)
        simplified = found + time.perf_counter() - begin
        both = (np.array(each.positions) for each in (path, short))
        return dict(zip(("found", "simplified"), zip(both, (found, simplified), strict=True), strict=True)), {}

    return plan


def with_tesseract(seed: int, seconds: float) -> Plan:
    """Tesseract's OMPL planner: RRT-Connect on two threads, the shortest of ten paths, not simplified. No seed."""
    import tesseract_robotics
    from tesseract_robotics import tesseract_command_language as language
    from tesseract_robotics import tesseract_common as common
    from tesseract_robotics import tesseract_environment as environment
    from tesseract_robotics import tesseract_motion_planners as planners
    from tesseract_robotics import tesseract_motion_planners_ompl as of_ompl

    del seed, seconds  # it has 5 seconds by default
    # Its collision library is a plugin, which is not found by itself.
    library = next(Path(tesseract_robotics.__file__).parents[1].glob("*.libs/libtesseract_collision_bullet_factories*"))
    plugin = f"""contact_manager_plugins:
  search_paths: [{library.parent}]
  search_libraries: [{library.stem.removeprefix("lib")}]
  discrete_plugins:
    default: BulletDiscreteBVHManager
    plugins: {{BulletDiscreteBVHManager: {{class: BulletDiscreteBVHManagerFactory}}}}
"""
    chain = common.ManipulatorInfo()
    chain.manipulator, chain.tcp_frame, chain.working_frame = "arm", "panda_hand_tcp", "panda_link0"

    def plan(problem: Problem) -> tuple[Found, dict[str, Any]]:
        urdf, srdf = (Path(f"{problem['path']}.{ending}") for ending in ("urdf", "srdf"))
        own = [urdf.with_name(f"{urdf.stem}_tesseract{ending}") for ending in (".urdf", ".srdf", ".yaml")]
        own[2].write_text(plugin)
        # Meshes as they are, not their convex hulls.
        meshes = '<robot xmlns:tesseract="tesseract" tesseract:make_convex="false" '
        own[0].write_text(urdf.read_text().replace('filename="/', 'filename="file:///').replace("<robot ", meshes))
        line = f'<contact_managers_plugin_config filename="file://{own[2].resolve()}"/></robot>'
        own[1].write_text(srdf.read_text().replace("<robot ", '<robot version="1.0.0" ').replace("</robot>", line))
        world = environment.Environment()
        files = [common.FilesystemPath(str(path)) for path in own[:2]]
        if not world.init(*files, common.GeneralResourceLocator()):
            raise RuntimeError("Tesseract does not read the files")
        world.setState(ARM, np.array(problem["start"]))
        program = language.CompositeInstruction("planners")
        program.setManipulatorInfo(chain)
        for end in ("start", "goal"):
            waypoint = language.JointWaypoint(ARM, np.array(problem[end]))
            to = language.JointWaypointPoly_wrap_JointWaypoint(waypoint)
            move = language.MoveInstruction(to, language.MoveInstructionType_FREESPACE, "planners")
            program.appendMoveInstruction(language.MoveInstructionPoly_wrap_MoveInstruction(move))
        profiles = language.ProfileDictionary()
        profiles.addProfile("ompl", "planners", of_ompl.OMPLRealVectorPlanProfile())
        request = planners.PlannerRequest()
        request.instructions, request.env, request.profiles = program, world, profiles
        planner = of_ompl.OMPLMotionPlanner("ompl")
        begin = time.perf_counter()
        response = planner.solve(request)
        found = time.perf_counter() - begin
        if not response.successful:
            raise UnsolvedError(response.message)
        path = []
        for instruction in response.results.flatten():
            # Each object must outlive the ones made of it.
            move = language.InstructionPoly_as_MoveInstructionPoly(instruction)
            at = move.getWaypoint()
            state = language.WaypointPoly_as_StateWaypointPoly(at)
            path.append(np.array(state.getPosition()).ravel().copy())
        return {"found": (np.array(path), found)}, {}

    return plan


#: By name: how a planner is made, of a seed and seconds, and the packages whose versions count.
PLANNERS: dict[str, tuple[Callable[[int, float], Plan], tuple[str, ...]]] = {
    "ompl": (lambda seed, seconds: with_ompl(None, seed, seconds), ("ompl", "pin", "coal")),
    "ompl, half": (lambda seed, seconds: with_ompl(0.005, seed, seconds), ("ompl", "pin", "coal")),
    "vamp": (with_vamp, ("vamp-planner",)),
    "mplib": (with_mplib, ("mplib",)),
    "roboplan": (with_roboplan, ("roboplan",)),
    "tesseract": (with_tesseract, ("tesseract-robotics",)),
}

if __name__ == "__main__":
    main()
