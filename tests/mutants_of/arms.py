"""Mutants of the bound of how far links of arms stray from arcs."""

from __future__ import annotations

from mutants_of.mutant import Mutant

STRAY = "pgccd/robots/stray.py"
ON_STRAY = ("robots/test_stray.py",)
SEARCH = "pgccd/robots/path_search.py"
LINKS = "pgccd/robots/links.py"
MJCF = "pgccd/robots/mjcf.py"
URDF = "pgccd/robots/urdf.py"
ON_UNTESTED = ("robots/test_untested.py",)
ON_SEARCH = ("robots/test_path_search.py",)
ROBOT = "pgccd/robots/robot.py"
ATTACHED = "pgccd/robots/attached.py"
UNTESTED = "pgccd/robots/untested.py"
OBSTACLES = "pgccd/robots/obstacles.py"
ON_ATTACHED = ("robots/test_attached.py",)
ON_MOVING = ("robots/test_moving_obstacles.py",)
NOT_ATTAINED = "a term of higher order in the turn, of which no chain is known that attains it"


def _pose_error(name: str, old: str, new: str) -> Mutant:
    return Mutant(f"arm-pose-error-{name}", STRAY, old, new, ON_STRAY, switched=False)


MUTANTS = [
    Mutant(
        "links-fixed-to-the-root-are-neighbours",
        LINKS,
        "at[above] if is_fixed else groups[rigid[above]]",
        "groups[rigid[above]]",
        ON_UNTESTED,
        switched=False,
    ),
    Mutant(
        "links-neighbour-alone",
        LINKS,
        "at[above] if is_fixed else groups[rigid[above]]",
        "at[above]",
        ON_UNTESTED,
        switched=False,
    ),
    Mutant(
        "links-not-over-empty-ones",
        LINKS,
        "while above >= 0 and above not in at:",
        "while False:",
        ON_UNTESTED,
        switched=False,
    ),
    Mutant(
        "links-welded-are-tested", LINKS, "pairs.update(combinations(members, 2))", "pass", ON_UNTESTED, switched=False
    ),
    Mutant(
        "links-covers-are-tested",
        LINKS,
        "for pair in product(members, neighbours)",
        "for pair in product(members[:1], neighbours)",
        ON_UNTESTED,
        switched=False,
    ),
    Mutant(
        "links-siblings-are-neighbours",
        LINKS,
        "    return pairs",
        """    return pairs | {
        (min(pair), max(pair))
        for one, other in combinations(groups, 2)
        if one and other and rigid[tree.joints[one].parent] == rigid[tree.joints[other].parent] > 0
        for pair in product(groups[one], groups[other])
    }""",
        ON_UNTESTED,
        switched=False,
    ),
    Mutant(
        "mjcf-world-is-a-parent",
        MJCF,
        "filters_parents and weld[i] and weld[j] and (",
        "filters_parents and (",
        ON_UNTESTED,
        switched=False,
    ),
    Mutant(
        "mjcf-parents-are-tested",
        MJCF,
        "filters_parents and weld[i] and weld[j] and (",
        "False and (",
        ON_UNTESTED,
        switched=False,
    ),
    Mutant(
        "mjcf-filterparent",
        MJCF,
        "filters_parents = not int(",
        "filters_parents = True or not int(",
        ON_UNTESTED,
        switched=False,
    ),
    Mutant(
        "mjcf-own-bits-only",
        MJCF,
        "of_i[0] & of_j[1] or of_j[0] & of_i[1]",
        "of_i[0] & of_j[1]",
        ON_UNTESTED,
        switched=False,
    ),
    Mutant("mjcf-excludes-dropped", MJCF, "meet and (i, j) not in excluded", "meet", ON_UNTESTED, switched=False),
    Mutant("mjcf-pairs-dropped", MJCF, "if any(bits) or k in in_pairs:", "if any(bits):", ON_UNTESTED, switched=False),
    Mutant(
        "mjcf-bodies-as-a-whole",
        MJCF,
        "group = (*bits, k) if k in in_pairs else bits",
        "group = (1, 1)",
        ON_UNTESTED,
        switched=False,
    ),
    Mutant(
        "mjcf-coupling-constant", MJCF, "constant + factor * offset)", "factor * offset)", ON_UNTESTED, switched=False
    ),
    Mutant(
        "mjcf-coupling-factor", MJCF, "(coordinate, factor * scale,", "(coordinate, scale,", ON_UNTESTED, switched=False
    ),
    Mutant(
        "mjcf-inactive-constraints",
        MJCF,
        "if is_off or not model.eq_active0[k]:",
        "if False:",
        ON_UNTESTED,
        switched=False,
    ),
    Mutant("mjcf-higher-terms", MJCF, "if other < 0 or any(higher):", "if other < 0:", ON_UNTESTED, switched=False),
    Mutant(
        "srdf-enabled-stay-out",
        URDF,
        "(why.keys() | disabled) - enabled}",
        "why.keys() | disabled}",
        ON_UNTESTED,
        switched=False,
    ),
    Mutant(
        "arm-origin-0.999",
        STRAY,
        "0.125 * _acc",
        "0.124875 * _acc",
        (*ON_STRAY, "robots/test_path_search.py"),
        switched=False,
    ),
    Mutant("arm-rotation-0.999", STRAY, "* 0.125", "* 0.124875", ON_STRAY, switched=False),
    Mutant(
        "arm-joints-apart",
        STRAY,
        "(revolute + 2.0 * before)",
        "(revolute + 0.0 * before)",
        ON_STRAY,
        switched=False,
    ),
    Mutant(
        "arm-slide-0.999", STRAY, "2.0 * (prismatic * before)", "1.998 * (prismatic * before)", ON_STRAY, switched=False
    ),
    Mutant(
        "arm-speed-zero",
        STRAY,
        "0.5 * (ends[n] + speed)",
        "0.5 * ends[n]",
        ON_STRAY,
        equivalent=NOT_ATTAINED,
        switched=False,
    ),
    Mutant(
        "arm-crossing-of-neighbours",
        "pgccd/robots/kinematics.py",
        "min(1.0, np.sin(angle) + 1e-12)",
        "0.999 * min(1.0, np.sin(angle))",
        ON_STRAY,
        switched=False,
    ),
    Mutant("arm-rate", STRAY, "2.0 * _RATE * s", "0.0 * s", ON_STRAY, equivalent=NOT_ATTAINED, switched=False),
    Mutant(
        "arm-pose-error",
        STRAY,
        "_POSE_ERROR = 2.0**-46",
        "_POSE_ERROR = 0.0",
        ON_STRAY,
        switched=False,
    ),
    _pose_error("without-turns", "joints + turns[n]", "joints + 0.0 * turns[n]"),
    _pose_error("without-slides", "length + slides[n]", "length + 0.0 * slides[n]"),
    _pose_error("without-joints", "joints + places.present[n]", "joints"),
    _pose_error("without-lengths", "length + places.distance[n], joints", "length, joints"),
    _pose_error(
        "without-reach",
        "length, joints = chains.forth, chains.reach,",
        "length, joints = chains.forth, 0.0 * chains.reach,",
    ),
    _pose_error("without-scale", "chains.of_joints(q).abs() * chains.scale.abs()", "chains.of_joints(q).abs()"),
    _pose_error("without-offset", " + chains.offset.abs()", ""),
    _pose_error("scaled-0.99", "_POSE_ERROR * (joints * length)", "0.99 * _POSE_ERROR * (joints * length)"),
    Mutant("arm-turns-4", STRAY, "MOST_TURN = 1.0", "MOST_TURN = 4.0", ON_SEARCH, switched=False),
    Mutant("arm-first-steps-2", SEARCH, "0.99 * MOST_TURN", "1.98 * MOST_TURN", ON_SEARCH, switched=False),
    Mutant("arm-first-steps-4", SEARCH, "0.99 * MOST_TURN", "3.96 * MOST_TURN", ON_SEARCH, switched=False),
    Mutant(
        "arm-first-steps-unrounded",
        SEARCH,
        "0.99 * MOST_TURN)).ceil()",
        "0.99 * MOST_TURN)).floor()",
        ON_SEARCH,
        switched=False,
    ),
    Mutant(
        "arm-turns-unscaled",
        STRAY,
        "(chains.of_joints(step) * chains.scale).abs()",
        "chains.of_joints(step).abs()",
        (*ON_STRAY, *ON_SEARCH),
        switched=False,
    ),
    Mutant(
        "arm-rounding-between-waypoints",
        SEARCH,
        "torch.maximum(*way)",
        "torch.maximum(q0.abs(), q1.abs())",
        ON_SEARCH,
        switched=False,
    ),
    Mutant("arm-near-at-an-end", SEARCH, "length <= _SHORTEST", "left <= _SHORTEST", ON_SEARCH, switched=False),
    Mutant(
        "arm-sum-of-times",
        SEARCH,
        "(own > segment) | ((own == segment) & (at > toi))",
        "own + at > segment + toi",
        ON_SEARCH,
        switched=False,
    ),
    Mutant(
        "attached-of-carrier-tested", ROBOT, ' | {frozenset((link, name)): "attached"}', "", ON_ATTACHED, switched=False
    ),
    Mutant(
        "attached-touching-tested",
        ROBOT,
        '{frozenset((each, name)): "touching" for each in touched} | ',
        "",
        ON_ATTACHED,
        switched=False,
    ),
    Mutant(
        "attached-forgets-pairs",
        ROBOT,
        "self._left_out + LeftOut(reasons)",
        "LeftOut(reasons)",
        ON_ATTACHED,
        switched=False,
    ),
    Mutant(
        "attached-upright",
        ATTACHED,
        "frame, self.position, self.orientation",
        "frame, self.position, np.array([1.0, 0.0, 0.0, 0.0])",
        ON_ATTACHED,
        switched=False,
    ),
    Mutant(
        "attached-no-solid",
        ATTACHED,
        'solid=True if mesh.solid else "auto"',
        "solid=False",
        ON_ATTACHED,
        switched=False,
    ),
    Mutant(
        "detached-keeps-pairs", ROBOT, "self._left_out.without(name))", "self._left_out)", ON_ATTACHED, switched=False
    ),
    Mutant("allowed-of-all-links", ROBOT, " if self.link_names[own] == link}", "}", ON_ATTACHED, switched=False),
    Mutant("allowed-first-obstacle", ROBOT, "obstacles.names.index(name)", "0", ON_ATTACHED, switched=False),
    Mutant("allowed-unknown", UNTESTED, "if name not in names:", "if False:", ON_ATTACHED, switched=False),
    Mutant("moving-whole-rotation", OBSTACLES, " * length[:, None, None]", "", ON_MOVING, switched=False),
    Mutant(
        "moving-shorter-way",
        SEARCH,
        "            motion = RigidMotion.from_rotation(poses[0]",
        "            RigidMotion.from_rotation(poses[0]",
        ON_MOVING,
        switched=False,
    ),
    Mutant("moving-ends-early", SEARCH, "(end, when.end)", "(end, when.begin)", ON_MOVING, switched=False),
    Mutant(
        "moving-no-rounding",
        SEARCH,
        "obstacles._error.to(q.device)",
        "0 * obstacles._error.to(q.device)",
        ON_MOVING,
        switched=False,
    ),
    Mutant(
        "moving-rounding-of-turns",
        OBSTACLES,
        "(1.0 + norm(rotation).amax(dim=0)) * reach",
        "reach",
        ON_MOVING,
        switched=False,
    ),
    Mutant(
        "moving-not-fixed-links",
        ROBOT,
        "~obstacles.moves]",
        "torch.ones(obstacles.count, dtype=torch.bool)]",
        ON_MOVING,
        switched=False,
    ),
    Mutant(
        "moving-not-own-links",
        ROBOT,
        "2 - is_robot, 1 + 2 * is_robot",
        "2 - is_robot, 1 + is_robot",
        ON_MOVING,
        switched=False,
    ),
    Mutant(
        "moving-each-other",
        ROBOT,
        "2 - is_robot, 1 + 2 * is_robot",
        "is_robot * 0 + 1, is_robot * 0 + 1",
        ON_MOVING,
        switched=False,
    ),
]
