"""Mutants of the bound of how far links of arms stray from arcs."""

from __future__ import annotations

from mutants_of.mutant import Mutant

KINEMATICS = "csrc/kernels/arms/kinematics_item.h"
SPAN = "csrc/kernels/arms/span_item.h"
MEMORY = "csrc/kernels/arms/search_memory.h"
PATHS = "csrc/kernels/arms/path_search_item.h"
TABLES = "pgccd/robots/tables.py"
ON_STRAY = ("robots/test_stray.py",)
LINKS = "pgccd/robots/links.py"
MJCF = "pgccd/robots/mjcf.py"
URDF = "pgccd/robots/urdf.py"
ON_UNTESTED = ("robots/test_untested.py",)
CURVE = "csrc/kernels/arms/curve_item.h"
ON_CURVES = ("robots/test_curves.py",)
ON_SEARCH = ("robots/test_path_search.py",)
ON_VALIDATOR = ("robots/test_validator.py",)
ROBOT = "pgccd/robots/robot.py"
ATTACHED = "pgccd/robots/attached.py"
UNTESTED = "pgccd/robots/untested.py"
OBSTACLES = "pgccd/robots/obstacles.py"
ON_ATTACHED = ("robots/test_attached.py",)
ON_MOVING = ("robots/test_moving_obstacles.py",)
NOT_ATTAINED = "a term of higher order in the turn, of which no chain is known that attains it"


# Expressions of the bound.
OF_ROTATION = "(1.0 + 2.0 * arm_detail::kRate * turn + arm_detail::kAngle * (turn * turn))"
COUNTED = "1.0 + (joint.turns() ? motion.largest : 0.0)"
MEASURED = "distance + (joint.slides() ? motion.largest : 0.0)"
VALUES = "kCurveError * (degree * degree * largest(coordinate))"
PARTS = "most_turn(arm, segment) / (0.99 * kMostTurn)"
TOLERANCE = "kContactTolerance * resolution"


def _arm(name: str, old: str, new: str, within: str = "", equivalent: str = "") -> Mutant:
    return Mutant(f"arm-{name}", KINEMATICS, old, new, (*ON_STRAY, *ON_SEARCH), within, equivalent)


def _search(name: str, file: str, old: str, new: str, within: str = "") -> Mutant:
    modules = (*ON_SEARCH, *ON_STRAY, *ON_MOVING, "kernels/test_arms.py")
    return Mutant(f"arm-{name}", file, old, new, modules, within)


def _moving(name: str, old: str, new: str) -> Mutant:
    return Mutant(f"moving-{name}", SPAN, old, new, (*ON_MOVING, "kernels/test_arms.py"))


def _on_curves(name: str, file: str, old: str, new: str, within: str = "") -> Mutant:
    return Mutant(f"arm-{name}", file, old, new, ON_CURVES, within)


def _curve(name: str, old: str, new: str, within: str = "") -> Mutant:
    return _on_curves(f"curve-{name}", CURVE, old, new, within)


def _spline(name: str, old: str, new: str) -> Mutant:
    return Mutant(f"spline-{name}", "pgccd/motion/splines.py", old, new, ("motion/test_splines.py",), switched=False)


def _clearance(name: str, old: str, new: str) -> Mutant:
    return Mutant(
        f"clearance-{name}", "pgccd/robots/path_clearance.py", old, new, ("robots/test_clearance.py",), switched=False
    )


def _validator(name: str, old: str, new: str) -> Mutant:
    return Mutant(
        f"validator-{name}", "csrc/kernels/arms/validator.h", old, new, (*ON_VALIDATOR, "kernels/test_arms.py")
    )


MUTANTS = [
    _spline("conversion-exact", "_CONVERSION = 2.0**-47", "_CONVERSION = 2.0**-60"),
    _spline("gap-forgotten", "made.error = jump + ", "made.error = "),
    _spline("line-999", "bend * (0.125 / parts**2)", "bend * (0.124875 / parts**2)"),
    _spline("values-exact", "_VALUES * self.degree**2 * size", "0.0 * size"),
    _spline("error-forgotten", "* size + self.error", "* size"),
    _spline(
        "late-times", "torch.where(toi > 0.0, earlier, begin)", "torch.where(toi > 0.0, time * (1.0 + 1e-15), begin)"
    ),
    _clearance("strays-once", "2.0 * (stray[part, pair[:, 0]]", "1.0 * (stray[part, pair[:, 0]]"),
    _clearance("no-strays", "copies.margin = sum_of_margins(stray.reshape(-1), copies.margin)", "pass"),
    _clearance("too-early-an-end", "< (self.upper - slack)[path]", "< (self.upper - 2.0 * slack)[path]"),
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
    _arm("origin-0.999", "0.125 * acceleration", "0.124875 * acceleration"),
    _arm("rotation-0.999", f"{OF_ROTATION} * 0.125", f"{OF_ROTATION} * 0.124875"),
    _arm("joints-apart", "motion.step + 2.0 * motion.turn_before", "motion.step + 0.0 * motion.turn_before"),
    _arm("turns-before-forgotten", "before.turn_before", "0.0 * before.turn_before"),
    _arm("slide-0.999", "2.0 * (motion.step * motion.turn_before)", "1.998 * (motion.step * motion.turn_before)"),
    _arm("speed-zero", "0.5 * (ends + speed)", "0.5 * ends", equivalent=NOT_ATTAINED),
    Mutant(
        "arm-crossing-of-neighbours",
        "pgccd/robots/kinematics.py",
        "min(1.0, np.sin(angle) + 1e-12)",
        "0.999 * min(1.0, np.sin(angle))",
        ON_STRAY,
        switched=False,
    ),
    _arm("rate", "2.0 * arm_detail::kRate * turn", "0.0 * turn", equivalent=NOT_ATTAINED),
    _arm(
        "pose-error",
        "arm_detail::kPoseError * (error_count * error_length)",
        "0.99 * (arm_detail::kPoseError * (error_count * error_length))",
    ),
    _arm("pose-error-without-turns", COUNTED, "1.0"),
    _arm("pose-error-without-joints", COUNTED, COUNTED.replace("1.0", "0.0")),
    _arm("pose-error-without-slides", MEASURED, "distance"),
    _arm("pose-error-without-lengths", MEASURED, f"0.0 * {MEASURED}"),
    _arm("pose-error-without-reach", "reach", "0.0 * reach", within="error_length = reach,"),
    _arm(
        "pose-error-without-scale",
        "span.curve.largest(joint.coordinate) * scale",
        "span.curve.largest(joint.coordinate)",
    ),
    _arm("pose-error-without-offset", "magnitude(place.offset)", "0.0", within="scale + magnitude(place.offset)"),
    _search("first-parts-2", SPAN, "0.99 * kMostTurn", "1.98 * kMostTurn"),
    _search("first-parts-unrounded", SPAN, f"std::ceil({PARTS})", f"std::floor({PARTS})"),
    _search(
        "turns-unscaled",
        KINEMATICS,
        "curve.rate(arm.joints[k].coordinate) * magnitude(arm.places[k].scale)",
        "curve.rate(arm.joints[k].coordinate)",
    ),
    Mutant("arm-turns-4", TABLES, "MOST_TURN = 1.0", "MOST_TURN = 4.0", ON_STRAY, switched=False),
    Mutant(
        "arm-turns-unscaled-in-python",
        TABLES,
        "(steps[:, joint.coordinate] * joint.scale).abs()",
        "steps[:, joint.coordinate].abs()",
        ON_STRAY,
        switched=False,
    ),
    _search(
        "rounding-between-waypoints",
        KINEMATICS,
        "span.curve.largest(joint.coordinate)",
        "larger(magnitude(span.curve.value(joint.coordinate, span.begin)), "
        "magnitude(span.curve.value(joint.coordinate, span.end)))",
    ),
    _curve("deviation-999", "0.125 * (length * length)", "0.999 * 0.125 * (length * length)"),
    _curve("deviation-of-shorter-parts", "0.125 * (length * length)", "0.125 * (length * length * length)"),
    _curve("second-derivative", "degree * (degree - 1) * most", "degree * degree * most * 0.49"),
    _curve("second-differences", "k + 1 < degree", "k + 2 < degree"),
    _curve("values-exact", VALUES, "0.0"),
    _curve("values-999", VALUES, f"0.99 * {VALUES}"),
    _curve("error-forgotten", "error", "0.0", f"{VALUES} +\n           error"),
    _curve("error-forgotten-of-waypoints", "error", "0.0", "if (degree == 1) return error;"),
    _curve("rate-999", "degree * most", "0.97 * degree * most", "return degree * most;"),
    _curve(
        "rate-of-the-ends",
        "degree * most",
        "magnitude(point(coordinate, degree) - point(coordinate, 0))",
        "return degree * most;",
    ),
    _curve("binomial", "binomial * (degree - k + 1) / k", "binomial * (degree - k) / k"),
    _on_curves("deviation-of-chords", KINEMATICS, "motion.deviation * (away + reach)", "motion.deviation * away"),
    _on_curves("deviation-at-the-body", KINEMATICS, "motion.deviation * (away + reach)", "motion.deviation * reach"),
    _on_curves("deviation-of-sliders", KINEMATICS, "motion.deviation", "0.0", "deviation += motion.deviation;"),
    _on_curves(
        "deviation-while-turning", KINEMATICS, "motion.step > 0.0 || motion.deviation > 0.0", "motion.step > 0.0"
    ),
    _on_curves(
        "deviation-at-rest", KINEMATICS, "error + deviation * arm_detail::kBoundRounding", "error + 0.0 * deviation"
    ),
    _on_curves(
        "deviation-unscaled",
        KINEMATICS,
        "scale",
        "1.0",
        "motion.deviation = span.curve.deviation(joint.coordinate, span.begin, span.end) * scale",
    ),
    _on_curves("curves-of-too-long-turns", SPAN, "kLongestTurn", "1e300", "k / paths.degree - 1)) <= kLongestTurn"),
    _search("near-too-early", SPAN, f"2.0 * stray + {TOLERANCE}", f"stray + {TOLERANCE}"),
    _search("near-at-an-end", SPAN, "span.end - span.begin <= kShortestSpan", "span.end - span.begin <= 0.5"),
    Mutant(
        "arm-sum-of-times",
        MEMORY,
        "segment > other_segment || (segment == other_segment && toi > other_toi)",
        "segment + toi > other_segment + other_toi",
        ("kernels/test_arms.py",),
    ),
    _search("last-part-forgotten", SPAN, "end", "begin", within="return k == parts ? end"),
    _search(
        "starts-untested",
        PATHS,
        "span.segment == 0 && span.begin == 0.0",
        "false",
        within="{tolerance, span.segment == 0 && span.begin == 0.0, false}",
    ),
    _search("one-of-both-strays", PATHS, "memory.stray[0] + memory.stray[1]", "memory.stray[0]"),
    _search("ball-of-half-the-way", PATHS, "reach + norm(half)", "0.5 * (reach + norm(half))"),
    _search("margins-forgotten", SPAN, "add_up(scene.margin[body], arc.stray)", "scene.margin[body]"),
    _validator("ways-of-origins", "norm(start - known.position[side])", "0.999 * norm(start - known.position[side])"),
    _validator("ways-along-arcs", "norm(end - start)", "0.999 * norm(end - start)"),
    _validator("turns", "reach[side] * turn", "0.999 * reach[side] * turn"),
    _validator("turns-along-arcs", "norm(load_vec3(bodies.rotation + 3 * side))", "0.0"),
    _validator("turns-before", "2.0 * smaller(apart(-1.0), apart(1.0))", "1.998 * smaller(apart(-1.0), apart(1.0))"),
    _validator("strays", "3.0 * stray[side]", "2.997 * stray[side]"),
    Mutant(
        "validator-learns-of-contacts",
        PATHS,
        "if (touch.toi == static_cast<double>(INFINITY)) team_.learn(pair, bodies);",
        "team_.learn(pair, bodies);",
        ON_VALIDATOR,
        equivalent="what is learned is tested at rest: bodies that are apart there are",
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
    _moving("whole-rotation", "(end - begin) * rotation", "1.0 * rotation"),
    _moving("ends-early", "at(end)", "at(begin)"),
    _moving("no-rounding", "obstacles.error[obstacle]", "0.0 * obstacles.error[obstacle]"),
    _moving("starts-late", "orientation_at(turned, rotation, begin)", "orientation_at(turned, rotation, end)"),
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
