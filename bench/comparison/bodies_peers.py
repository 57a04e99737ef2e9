"""Physics engines and collision libraries on many robots. Each is a `BodiesProgram` of bodies.py."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from support import peers
from support.near_pairs import rotate
from support.scenes import MixedWorld

from comparison.program import Program
from pgccd import sim

_SPECULATIVE = "speculative contacts (no toi)"


def available(world: MixedWorld, device: str) -> list[Any]:
    """The installed programs; on a GPU only those that run there."""
    programs: list[Any] = []
    newton = peers.load("newton")
    if newton is not None:
        programs += [Newton(newton, world, shape, device) for shape in ("hulls", "meshes")]
    if device == "cuda":
        return programs
    for module, make in (("mujoco", MuJoCo), ("pybullet", PyBullet), ("fcl", Fcl)):
        loaded = peers.load(module)
        if loaded is not None:
            programs.append(make(loaded, world))
    ipctk = peers.load_ipctk()
    if ipctk is not None:
        programs.append(Ipctk(ipctk, world))
    return programs


def _mesh(world: MixedWorld) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) relative to the origin, faces (F, 3)."""
    mesh = world.model.meshes.meshes[0]
    return (mesh.vertices - mesh.origin).numpy(), mesh.faces.numpy().astype(np.int32)


def _columns(state: sim.RobotState) -> tuple[np.ndarray, ...]:
    """Position, orientation (w, x, y, z), velocity and angular velocity, all in the world frame."""
    columns = (state.position, state.orientation, state.velocity, state.angular_velocity)
    return tuple(column.cpu().numpy() for column in columns)


def _end(state: sim.RobotState) -> tuple[np.ndarray, np.ndarray]:
    """Positions and orientations at the end of the step."""
    angle = torch.linalg.vector_norm(state.angular_velocity, dim=1, keepdim=True)
    axis = 0.5 * torch.sinc(0.5 * angle / torch.pi) * state.angular_velocity
    w, v, w0, v0 = torch.cos(0.5 * angle), axis, state.orientation[:, :1], state.orientation[:, 1:]
    turned = torch.cat([w * w0 - (v * v0).sum(1, keepdim=True), w * v0 + w0 * v + torch.linalg.cross(v, v0)], dim=1)
    return (state.position + state.velocity).cpu().numpy(), turned.cpu().numpy()


class Newton:
    """Newton's collision pipeline: sweep and prune, then contacts within a gap that follows from the velocities."""

    def __init__(self, newton: Any, world: MixedWorld, shape: str, device: str) -> None:
        import warp

        warp.config.log_level = warp.LOG_ERROR
        warp.config.verbose = False
        self._warp = warp
        vertices, faces = _mesh(world)
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        builder.default_shape_cfg.gap = builder.default_shape_cfg.margin = 0.0
        mesh = newton.Mesh(vertices.astype(np.float32), faces.ravel())
        add = builder.add_shape_mesh if shape == "meshes" else builder.add_shape_convex_hull
        robots = len(world.state)
        for _ in range(robots):
            add(body=builder.add_body(), mesh=mesh)
        self._model = builder.finalize(device=device)
        self._state = self._model.state()
        # Several times the need of such a world; the pipeline warns on overflow.
        capacity = {"rigid_contact_max": 100 * robots, "shape_pairs_max": 100 * robots}
        self._pipeline = newton.CollisionPipeline(
            self._model, broad_phase="sap", reduce_contacts=False, speculative_contact_gap_max=1e9, **capacity
        )
        self._contacts = self._pipeline.contacts()
        where = "GPU" if device == "cuda" else "CPU, 1 thread"
        shapes = "convex hulls" if shape == "hulls" else "meshes"
        self.program = Program(
            f"Newton, {shapes}", "newton", f"{_SPECULATIVE}; {shapes}, float32", "toi; proof; rotation", where
        )

    def load(self, state: sim.RobotState) -> None:
        position, orientation, velocity, spin = _columns(state)
        self._state.body_q.assign(np.hstack([position, np.roll(orientation, -1, axis=1)]).astype(np.float32))
        self._state.body_qd.assign(np.hstack([velocity, spin]).astype(np.float32))
        self._warp.synchronize()

    def find(self) -> None:
        self._pipeline.collide(self._state, self._contacts, dt=1.0)
        # A program that uses the contacts reads their count; on a GPU this also synchronises.
        self._count = int(self._contacts.rigid_contact_count.numpy()[0])

    def pairs(self) -> np.ndarray:
        shapes = (self._contacts.rigid_contact_shape0, self._contacts.rigid_contact_shape1)
        return np.stack([each.numpy()[: self._count] for each in shapes], axis=1)


class MuJoCo:
    """MuJoCo's collision detection with speculative contacts, found by conservative advancement."""

    program = Program("MuJoCo, speculative", "mujoco", f"{_SPECULATIVE}; convex hulls", "toi; proof; concave meshes")

    def __init__(self, mujoco: Any, world: MixedWorld) -> None:
        self._mujoco = mujoco
        vertices, faces = _mesh(world)
        spec = mujoco.MjSpec()
        spec.option.timestep, spec.option.gravity = 1.0, [0.0, 0.0, 0.0]
        spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SPECULATIVE)
        spec.add_mesh(name="robot", uservert=vertices.ravel(), userface=faces.ravel())
        for _ in range(len(world.state)):
            body = spec.worldbody.add_body()
            body.add_freejoint()
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="robot")
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)

    def load(self, state: sim.RobotState) -> None:
        position, orientation, velocity, spin = _columns(state)
        inverse = torch.from_numpy(orientation * [1.0, -1.0, -1.0, -1.0])
        # Angular velocities of free joints are in the body frame.
        local = np.stack([rotate(q, torch.from_numpy(s)[None])[0] for q, s in zip(inverse, spin, strict=True)])
        self._data.qpos[:] = np.hstack([position, orientation]).ravel()
        self._data.qvel[:] = np.hstack([velocity, local]).ravel()
        self._mujoco.mj_fwdPosition(self._model, self._data)
        self._mujoco.mj_fwdVelocity(self._model, self._data)

    def find(self) -> None:
        self._mujoco.mj_collision(self._model, self._data)

    def pairs(self) -> np.ndarray:
        return self._data.contact.geom.copy()


class PyBullet:
    """A whole step of PyBullet without gravity, friction and damping: separate detection is not offered."""

    program = Program(
        "PyBullet, a whole step", "pybullet", "discrete contacts and response; convex hulls", "toi; motion; meshes"
    )

    def __init__(self, pybullet: Any, world: MixedWorld) -> None:
        self._bullet = pybullet
        self._client = pybullet.connect(pybullet.DIRECT)
        pybullet.setGravity(0.0, 0.0, 0.0)
        pybullet.setTimeStep(1.0)
        shape = pybullet.createCollisionShape(pybullet.GEOM_MESH, vertices=_mesh(world)[0].tolist())
        self._bodies = []
        for position in world.state.position.tolist():
            # Maximal coordinates: plain rigid bodies, faster here than one-link articulations.
            body = pybullet.createMultiBody(1.0, shape, basePosition=position, useMaximalCoordinates=True)
            pybullet.changeDynamics(
                body, -1, linearDamping=0.0, angularDamping=0.0, restitution=1.0, lateralFriction=0.0
            )
            self._bodies.append(body)

    def load(self, state: sim.RobotState) -> None:
        columns = (column.tolist() for column in _columns(state))
        for body, position, (w, x, y, z), velocity, spin in zip(self._bodies, *columns, strict=True):
            self._bullet.resetBasePositionAndOrientation(body, position, (x, y, z, w))
            self._bullet.resetBaseVelocity(body, velocity, spin)

    def find(self) -> None:
        self._bullet.stepSimulation()

    def pairs(self) -> np.ndarray:
        number = {body: index for index, body in enumerate(self._bodies)}
        return np.array([(number[each[1]], number[each[2]]) for each in self._bullet.getContactPoints()], dtype=int)


class Fcl:
    """FCL's dynamic tree and mesh test at the end of the step, each near pair through a Python callback."""

    program = Program(
        "python-fcl, tree of boxes", "python-fcl", "which meshes overlap at the end", "toi; contacts during the step"
    )

    def __init__(self, fcl: Any, world: MixedWorld) -> None:
        self._fcl = fcl
        vertices, faces = _mesh(world)
        model = fcl.BVHModel()
        model.beginModel(len(vertices), len(faces))
        model.addSubModel(vertices, faces)
        model.endModel()
        self._objects = [fcl.CollisionObject(model, fcl.Transform()) for _ in range(len(world.state))]
        self._manager = fcl.DynamicAABBTreeCollisionManager()
        self._manager.registerObjects(self._objects)
        self._manager.setup()

    def load(self, state: sim.RobotState) -> None:
        self._ends = _end(state)

    def find(self) -> None:
        fcl, found = self._fcl, []
        for each, position, orientation in zip(self._objects, *self._ends, strict=True):
            each.setTransform(fcl.Transform(orientation, position))
        self._manager.update()
        request = fcl.CollisionRequest()

        def near(first: Any, second: Any, _data: Any) -> bool:
            if fcl.collide(first, second, request, fcl.CollisionResult()):
                found.append((first.getTranslation().tobytes(), second.getTranslation().tobytes()))
            return False

        self._manager.collide(None, near)
        self._found = found

    def pairs(self) -> np.ndarray:
        # The callback gets copies of the objects: identify them by position.
        number = {position.tobytes(): index for index, position in enumerate(self._ends[0])}
        return np.array([(number[first], number[second]) for first, second in self._found], dtype=int)


class Ipctk:
    """IPC Toolkit's collision-free step for the whole scene, along straight lines."""

    program = Program(
        "ipctk, LBVH + Additive CCD", "ipctk", "one step for all bodies; meshes, straight paths", "which pairs; arcs"
    )

    def __init__(self, ipctk: Any, world: MixedWorld) -> None:
        vertices, faces = _mesh(world)
        edges = world.model.meshes.meshes[0].edges.numpy()
        robots, count = len(world.state), len(vertices)
        shift = count * np.arange(robots)[:, None, None]
        self._ipctk, self._vertices = ipctk, torch.from_numpy(vertices)
        start = self._placed(world.state.position.numpy(), world.state.orientation.numpy())
        self._mesh = ipctk.CollisionMesh(
            start, *((rows + shift).reshape(-1, rows.shape[1]).astype(np.int32) for rows in (edges, faces))
        )
        self._mesh.can_collide = ipctk.make_vertex_patches_filter(np.repeat(np.arange(robots, dtype=np.int32), count))

    def _placed(self, position: np.ndarray, orientation: np.ndarray) -> np.ndarray:
        at = rotate(torch.from_numpy(orientation), self._vertices) + torch.from_numpy(position)[:, None]
        return np.asfortranarray(at.reshape(-1, 3).numpy())

    def load(self, state: sim.RobotState) -> None:
        self._ends = (self._placed(*_columns(state)[:2]), self._placed(*_end(state)))

    def find(self) -> float:
        ipctk = self._ipctk
        return ipctk.compute_collision_free_stepsize(self._mesh, *self._ends, 0.0, ipctk.LBVH(), ipctk.AdditiveCCD())

    def pairs(self) -> None:
        """None: it returns no pairs."""
