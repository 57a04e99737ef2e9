"""Mutants of what solvers ask of contacts: the rate of approach, what recedes, and normals of surfaces."""

from __future__ import annotations

from mutants_of.mutant import CONTACTS, Mutant

APPROACH = "pgccd/contacts/approach.py"
SEARCH = "pgccd/search/approaching.py"
SITE, ROWS = CONTACTS + "site_item.h", CONTACTS + "contacts.h"
RECESSION, CORNERS = CONTACTS + "recession_item.h", CONTACTS + "moving_corners.h"
SURFACE = CONTACTS + "surface_item.h"
ON_APPROACH = ("contacts/test_approach.py",)
ON_RECESSION = ("contacts/test_recession.py", "contacts/test_approach.py")
ON_SEARCH = ("search/test_search_of_approaching.py", "contacts/test_approach.py")
ON_GRADIENTS = ("contacts/test_gradients.py",)
ON_NORMALS = ("contacts/test_surface_cones.py", "contacts/test_normals.py")
ON_SAME_SURFACES = ("search/test_search_of_approaching.py::test_normals_of_contacts_with_the_same_surfaces",)
ON_BOUNDS = ("contacts/test_recession.py::test_rows_that_name_no_features",)


def _rate(name: str, file: str, old: str, new: str, killed_by: tuple[str, ...] = ON_APPROACH) -> Mutant:
    return Mutant(f"rate-{name}", file, old, new, killed_by)


def _python(name: str, file: str, old: str, new: str, killed_by: tuple[str, ...]) -> Mutant:
    return Mutant(name, file, old, new, killed_by, switched=False)


def _recedes(name: str, old: str, new: str, within: str = "", file: str = RECESSION, equivalent: str = "") -> Mutant:
    return Mutant(f"recedes-{name}", file, old, new, ON_RECESSION, within, equivalent)


def _normals(
    name: str, old: str, new: str, within: str = "", killed_by: tuple[str, ...] = ON_NORMALS, file: str = SURFACE
) -> Mutant:
    return Mutant(f"normals-{name}", file, old, new, killed_by, within)


MUTANTS = [
    _rate("sign", ROWS, "-dot_of(normal, site.velocity())", "dot_of(normal, site.velocity())"),
    _rate("reversed", ROWS, "is_reversed[row] != 0 ? -closing : closing", "closing"),
    _rate("of-one-body", SITE, "(rate[1] - rate[0])", "rate[1]"),
    _rate(
        "turns-back",
        SITE,
        "load_vec3(paths->rotation + 3 * body[side])",
        "-load_vec3(paths->rotation + 3 * body[side])",
    ),
    _rate("of-edge-in-face-at-face-coordinates", SITE, "kind != kKindEFAB + side", "true"),
    _rate("of-others", ROWS, "length_of(0.5 * arms)", "0.0 * length_of(arms)"),
    _python("rate-gradient-of-one-body", APPROACH, "(speed[:, 1] - speed[:, 0])", "speed[:, 1]", ON_GRADIENTS),
    _python(
        "rate-gradient-at-the-first-corner",
        APPROACH,
        "(weights[:, :, :, None] * velocity).sum(2)",
        "velocity[:, :, 0]",
        ON_GRADIENTS,
    ),
    _python(
        "rate-gradient-between-edges",
        APPROACH,
        "torch.stack([1.0 - v, zero, v], 1)",
        "torch.stack([1.0 - v, v, zero], 1)",
        ON_GRADIENTS,
    ),
    _python(
        "rate-gradient-turns-back",
        "pgccd/contacts/gradients.py",
        "travel + torch.linalg.cross(rotation.expand_as(arm), arm)",
        "travel - torch.linalg.cross(rotation.expand_as(arm), arm)",
        ON_GRADIENTS,
    ),
    *(
        Mutant(f"contacts-{name}", SITE, old, "false", ON_BOUNDS)
        for name, old in (
            ("of-no-kind", "kind < 0 || kind >= kKinds"),
            ("of-no-body", "!is_within(body, paths.count)"),
            ("of-no-feature", "!is_within(feature, count)"),
        )
    ),
    _recedes("slack-1.001", "gap_ - slack_", "gap_ - 1.001 * slack_", "needed = gap_ - slack_;\n    const CornersAt"),
    _recedes("gap-0.999", "gap_ - slack_", "0.999 * gap_ - slack_", "needed = gap_ - slack_;\n    const CornersAt"),
    _recedes(
        "at-toi-only",
        "start + change + (b_last.lowest() - a_last.highest()) - error >= needed",
        "a_last.highest() < INFINITY",
    ),
    _recedes("before-the-end", "start + change", "start + 0.9999 * change", "return start + change + (b_last"),
    _recedes("beyond-the-step", "start + change", "start + 1.0001 * change", "return start + change + (b_last"),
    _recedes("before-the-end-on-lines", "1.0", "0.9999", "a_last = CornersAt::of(a, {}, 1.0)"),
    _recedes(
        "beyond-the-step-on-arcs",
        "(static_cast<double>(window) / contacts_detail::kWindows)",
        "(1.0001 * static_cast<double>(window) / contacts_detail::kWindows)",
    ),
    _recedes(
        "before-the-end-on-arcs",
        "(static_cast<double>(window) / contacts_detail::kWindows)",
        "(0.9 * static_cast<double>(window) / contacts_detail::kWindows)",
    ),
    _recedes("no-error", "kRounding * size", "0.0 * size"),
    _recedes("error-of-one", "sets.other.size(angle_[1])", "0.0"),
    _recedes("unresolved", "status[row] != kTouch", "false", file=ROWS),
    _recedes(
        "intersecting",
        "given.contacts.kind[row] > kKindEE",
        "false",
        "status[row] != kTouch || given.contacts.kind[row] > kKindEE",
        ROWS,
    ),
    _recedes("larger-slack", "smaller(slack[site.body[0]], slack[site.body[1]])", "slack[site.body[1]]", file=ROWS),
    _recedes(
        "some-faces",
        "!stay_along_some(sets, side, face, beside)",
        "f == 0 && !stay_along_some(sets, side, face, beside)",
    ),
    _recedes("faces-of-one", "feature.what == kFace", "feature.what == kFace || side == 1"),
    _recedes(
        "without-surfaces",
        "smaller(gap_, smaller(height_above(surfaces, 0, of_surface), height_above(surfaces, 1, of_surface)))",
        "gap_",
    ),
    _recedes("height-anywhere", "is_over && dot_of(inward, point - corner[k]) >= 0.0", "is_over"),
    _python("recedes-height-of-any-face", RECESSION, "kParallel = 1e-5", "kParallel = 10.0", ON_RECESSION),
    _recedes("from-the-other-side", "!(dot_of(direction, site_.offset) >= -site_.noise)", "false"),
    _recedes("one-sided", "is_sided || stay(sets, -along)", "true"),
    _recedes("never-slides", "magnitude(closing) <= kSliding * length_of(velocity_)", "false"),
    _recedes("slides-on-either-side", "!(apart_at_toi(sets, -along) >= -slack_)", "true"),
    _recedes("at-toi-as-before", "is_apart_ || !(site_.toi > 0.0)", "true"),
    _recedes("chord", "larger(high, 0.0)", "0.0 * high"),
    _recedes("chord-0.99", "larger(high, 0.0) * length", "0.99 * larger(high, 0.0) * length"),
    _recedes("chord-of-all", "of_b.highest() - of_a.lowest()", "of_b.lowest() - of_a.highest()"),
    _recedes("tangent", "0.5 * low * bottom", "0.5 * (of_b.high[m] - of_a.low[k]) * bottom"),
    _recedes("tangent-slope", "of_b.rate[m] - of_a.rate[k]", "of_b.rate[m]"),
    _recedes(
        "curvature", "square * radius * length * length / 8.0", "0.0 * square * radius * length * length", file=CORNERS
    ),
    _recedes(
        "curvature-of-circles",
        "-square * larger(least, -radius)",
        "-square * larger(least, -0.5 * radius)",
        file=CORNERS,
    ),
    _recedes("turns-back", "cross(axis, corners.first[k])", "cross(corners.first[k], axis)"),
    _recedes("no-turn", "at.start - corners.constant[k]", "0.0 * (at.start - corners.constant[k])"),
    _recedes("centre-stays", "start + change * time", "start + 0.0 * change * time", "last = start + change * time;"),
    _recedes("first-window-only", "begin < kWindows", "begin < wide"),
    _recedes(
        "nearest-points-elsewhere",
        "rotate(spin, turn, site_.nearest[side])",
        "site_.nearest[side]",
    ),
    _python("approaching-first-window-only", SEARCH, "left = left[until[left] < 1.0]", "left = left[:0]", ON_SEARCH),
    _python(
        "approaching-in-any-order",
        SEARCH,
        "earliest_of_each(place[rows], count, contacts.toi[rows])",
        "earliest_of_each(place[rows], count)",
        ON_SEARCH,
    ),
    _python(
        "approaching-known-to-recede", SEARCH, "early & (count == receding[chosen])[place]", "early | ~early", ON_SEARCH
    ),
    _python(
        "approaching-until-the-first-known", SEARCH, "(contacts.toi <= first[place])", "(contacts.toi < 0.0)", ON_SEARCH
    ),
    _python("approaching-any-segment", SEARCH, "len(found), segment, found.toi", "len(found), found.toi", ON_SEARCH),
    _python("approaching-one-segment", SEARCH, "low, number = low + number, 2 * number", "low = len(order)", ON_SEARCH),
    _normals("kept", "admits(normal)", "is_nonzero(normal)", "if (admits(normal)) return"),
    _normals("clamped", "admits(normal)", "false", "if (admits(normal)) return"),
    _normals("farthest", "dot_of(normal, candidate)", "-dot_of(normal, candidate)"),
    _normals("all-convex", "dot_of(normal, of_apex) < -kFlat * distance", "dot_of(normal, of_apex) < INFINITY"),
    _normals("flat-is-convex", "-kFlat * distance", "kFlat * distance"),
    _normals(
        "concave-is-convex",
        "dot_of(normal, of_apex) < -kFlat * distance",
        "magnitude(dot_of(normal, of_apex)) > kFlat * distance",
    ),
    _normals("none-convex", "count == 1 || dot_of(normal, of_apex) < -kFlat * distance", "count < 0"),
    _normals("rims-not-convex", "count == 1", "false", "count == 1 || dot_of(normal"),
    _normals("fins-convex", "count > 2", "count > 3"),
    _normals("no-edges", "is_behind(out, edge.apex[1]) && is_nonzero(across)", "false"),
    _normals("sound-anyway", "is_behind(out, edge.apex[0]) && is_behind(out, edge.apex[1])", "true"),
    _normals("sound-of-one-face", "is_behind(out, edge.apex[1])", "true"),
    _normals("behind-anyway", "!is_behind(out, faces[f].away[k])", "false"),
    _normals("no-faces", "is_nonzero(faces[f].normal)", "false"),
    _normals("side", "sign_of(height)", "-sign_of(height)"),
    _normals("noise", "magnitude(height) > noise", "magnitude(height) > 0.0", "magnitude(height) > noise ? sign"),
    _normals("no-noise", "is_apart ? site.noise : 0.0", "0.0"),
    _normals("guessed-for-all", "is_guessed && !have_equal_bits(given, of_features)", "false", "", ON_SAME_SURFACES),
    _normals("of-any-place", "!(at == place)", "false", "", ON_SAME_SURFACES),
    _normals("no-reach", "reach > kOneSided * back ? 1.0 : 0.0", "0.0"),
    _normals("no-solid", "sign == 0.0", "false", "if (sign == 0.0) sign = solid;"),
    _normals("beside", "over != 0.0 && solid != 0.0", "false"),
    _normals("over-all", "is_elsewhere || dot_of(inward, towards) >= 0.0", "true"),
    _normals("no-partner", "magnitude(facing) > 0.5", "magnitude(facing) > 2.0"),
    _normals("outside", "side == 1 ? -1.0 : 1.0", "1.0"),
    _normals("reversed", "site.is_reversed(given)", "false"),
    _normals("parallel", "-unit_or_zero(site.velocity())", "unit_or_zero(site.velocity())"),
    _normals("last", "one.edge_count == 0", "one.edge_count > 0", "one.edge_count == 0 && other"),
    _normals("last-of-a-face", "one.support.what == kFace", "false", "last_is_one = one.support.what == kFace"),
    _normals("last-of-the-second-face", "other.support.what != kFace", "true"),
    _normals(
        "last-of-the-smaller-face",
        "one.largest_face() > other.largest_face()",
        "one.largest_face() < other.largest_face()",
    ),
    _normals("of-vertices-features", "one.admits(mean) && other.admits(mean)", "false"),
    _normals("of-vertices-unweighted", "(weight(faces[f]) / (largest > 0.0 ? largest : 1.0))", "1.0"),
    _normals("of-vertices-beside", "!(length[k] > kAtCorner * longest)", "false"),
]
