"""Mutants of the shapes of files and simulators."""

from __future__ import annotations

from mutants_of.mutant import Mutant

SHAPES, OBSTACLES = "pgccd/robots/shapes.py", "pgccd/robots/obstacles.py"
ROBOT, MJCF = "pgccd/robots/robot.py", "pgccd/robots/mjcf.py"
BODIES = "pgccd/simulators/bodies.py"
MUJOCO, NEWTON, BULLET = (f"pgccd/simulators/{name}_frames.py" for name in ("mujoco", "newton", "pybullet"))
ON_ORACLES = ("simulators/test_oracles.py",)
ON_SIMULATORS = ("simulators/test_simulators.py",)
ON_FILES = ("robots/test_files.py",)
ON_CERTIFY = ("robots/test_path_search.py",)


def _mutant(name: str, file: str, old: str, new: str, killed_by: tuple[str, ...], within: str = "") -> Mutant:
    return Mutant(f"reader-{name}", file, old, new, killed_by, within=within, switched=False)


MUTANTS = [
    _mutant("cylinder-inside", SHAPES, "around = radius / np.cos(np.pi / _SECTIONS)", "around = radius", ON_FILES),
    _mutant("ellipsoid-inside", SHAPES, "vertices * (radii / inner)", "vertices * radii", ON_FILES),
    _mutant("capsule-half", SHAPES, "[0.0, 0.0, half_length]]", "[0.0, 0.0, 0.9 * half_length]]", ON_ORACLES),
    _mutant(
        "placed-unturned",
        SHAPES,
        "turned(orientation, self.vertices) + position",
        "self.vertices + position",
        ON_ORACLES,
    ),
    _mutant("mirrored-inside-out", SHAPES, "np.prod(np.sign(scale)) < 0.0", "False", ON_SIMULATORS),
    _mutant("plane-not-centred", SHAPES, "self.centre + (self.vertices - self.centre) *", "self.vertices *", ON_FILES),
    _mutant(
        "plane-normal",
        SHAPES,
        "np.array([0.0, 0.0, 1.0]) if normal is None else normal",
        "np.array([0.0, 0.0, 1.0])",
        ON_ORACLES,
    ),
    _mutant("field-without-base", SHAPES, "bottom[:, 2] = -base", "bottom[:, 2] = 0.0", ON_ORACLES),
    _mutant(
        "field-without-walls", SHAPES, "(border, below, after_below), (border, after_below, after)", "", ON_ORACLES
    ),
    _mutant("field-other-diagonal", SHAPES, "(a, b, c), (a, c, d)", "(a, b, d), (b, c, d)", ON_ORACLES),
    _mutant("reach-without-thickness", SHAPES, "(1.0 + 2.0**-50) + self.thickness", "(1.0 + 2.0**-50)", ON_FILES),
    _mutant(
        "mjcf-plane-with-size", MJCF, "shapes.infinite_plane()", "shapes.rectangle(*(size[:2] + 1e-9))", ON_ORACLES
    ),
    _mutant("mjcf-field-height", MJCF, "heights * height, x, y, base", "heights, x, y, base", ON_ORACLES),
    _mutant(
        "robot-plane-narrow",
        ROBOT,
        "half = max(PLANE, 2.0 * (self.reach + slides + max(away, default=0.0)))",
        "half = PLANE",
        ON_FILES,
    ),
    _mutant("robot-leaves-plane", ROBOT, "return slides > self._room", "return slides > 2.0 * self._room", ON_FILES),
    _mutant("robot-reach-of-planes", ROBOT, "if not each.infinite), default=PLANE", "), default=PLANE", ON_FILES),
    _mutant("simulator-plane-narrow", BODIES, "max(PLANE, 4.0 * float((away + reach).max()))", "PLANE", ON_SIMULATORS),
    _mutant("simulator-leaves-plane", BODIES, "lateral + self._reach <=", "lateral <=", ON_SIMULATORS),
    _mutant("simulator-lateral-one-axis", BODIES, " + (away @ other) ** 2", "", ON_SIMULATORS),
    _mutant("simulator-thickness-dropped", SHAPES, "thickness=self.thickness)", "thickness=0.0)", ON_ORACLES),
    _mutant("mujoco-parents-tested", MUJOCO, "never |= related &", "never &= related &", ON_SIMULATORS),
    _mutant("mujoco-pairs-filtered", MUJOCO, "never &= ~np.isin(one", "never |= ~np.isin(one", ON_SIMULATORS),
    _mutant("mujoco-pairs-unseen", MUJOCO, "model.pair_geom2])] = True", "model.pair_geom2])] |= False", ON_SIMULATORS),
    _mutant(
        "newton-plane-whole",
        NEWTON,
        "0.5 * float(scale[0]), 0.5 * float(scale[1])",
        "float(scale[0]), float(scale[1])",
        ON_SIMULATORS,
    ),
    _mutant("newton-margin", NEWTON, ".thickened(float(margin))", ".thickened(0.0)", ON_SIMULATORS),
    _mutant("newton-scale", NEWTON, ".scaled(scale)", "", ON_SIMULATORS),
    _mutant("newton-transform", NEWTON, ".placed(placed[:3], _wxyz(placed[3:]))", "", ON_SIMULATORS),
    _mutant("bullet-hull-margin", BULLET, "_HULL = 1e-3", "_HULL = 0.9e-3", ON_SIMULATORS),
    _mutant("bullet-mesh-unit", BULLET, 'file.decode(), unit="m"', "file.decode()", ON_SIMULATORS),
    _mutant("bullet-mesh-scale", BULLET, 'unit="m"), np.array(size))', 'unit="m"), np.abs(size))', ON_ORACLES),
    _mutant(
        "bullet-capsule-whole",
        BULLET,
        "shapes.capsule(size[1], 0.5 * size[0])",
        "shapes.capsule(size[1], size[0])",
        ON_ORACLES,
    ),
    _mutant(
        "bullet-hull-placed-twice",
        BULLET,
        "return _hull(np.array(points)).thickened(thickness)",
        "made = _hull(np.array(points)).thickened(thickness)",
        ON_ORACLES,
    ),
    _mutant("bullet-unknown-dropped", BULLET, "if not found and len", "if False and len", ON_SIMULATORS),
    _mutant(
        "obstacles-invalid-turn", OBSTACLES, "(length - 1.0).abs() <= UNIT_TOLERANCE", "length.abs() >= 0.0", ON_CERTIFY
    ),
    _mutant(
        "obstacles-of-first-environment",
        "csrc/kernels/arms/arm.h",
        "row_count == 1 ? 0 : path",
        "row_count == 1 ? 0 : 0 * path",
        ON_CERTIFY,
    ),
]
