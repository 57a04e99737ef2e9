"""Mutants of what solvers ask of contacts: the rate of approach, what recedes, and normals of surfaces."""

from __future__ import annotations

from mutants_of.mutant import Mutant

APPROACH = "pgccd/contacts/approach.py"
SEARCH = "pgccd/search/approaching.py"
SITES = "pgccd/contacts/sites.py"
NORMALS = "pgccd/contacts/normals.py"
ON_APPROACH = ("contacts/test_approach.py",)
ON_SEARCH = ("search/test_search_of_approaching.py", "contacts/test_approach.py")
ON_WOULD = ("search/test_search_of_approaching.py::test_what_certainly_fails_would_fail",)
ON_GRADIENTS = ("contacts/test_gradients.py",)
ON_NORMALS = ("contacts/test_surface_cones.py", "contacts/test_normals.py")


def _mutant(name: str, file: str, old: str, new: str, within: str = "", equivalent: str = "") -> Mutant:
    killed_by = {APPROACH: ON_APPROACH, SEARCH: ON_SEARCH}.get(file, ON_NORMALS)
    return Mutant(name, file, old, new, killed_by, within, equivalent, switched=False)


MUTANTS = [
    Mutant("edge-in-face-at-face-coordinates", SITES, "if len(rows) == 0:", "if True:", ON_APPROACH, switched=False),
    _mutant("rate-sign", APPROACH, "rate = -dot(normal, ", "rate = dot(normal, "),
    _mutant("rate-reversed", APPROACH, "torch.where(is_reversed, -rate, rate)", "rate"),
    Mutant(
        "rate-of-one-body",
        SITES,
        "(self._of_nearest(1, self._rates) - self._of_nearest(0, self._rates))",
        "self._of_nearest(1, self._rates)",
        ON_APPROACH,
        switched=False,
    ),
    Mutant(
        "rate-turns-back",
        SITES,
        "return cross(rotation, self.arms(side, owner, vertex))",
        "return -cross(rotation, self.arms(side, owner, vertex))",
        ON_APPROACH,
        switched=False,
    ),
    Mutant(
        "rate-gradient-of-one-body",
        APPROACH,
        "(speed[:, 1] - speed[:, 0])",
        "speed[:, 1]",
        ON_GRADIENTS,
        switched=False,
    ),
    Mutant(
        "rate-gradient-at-the-first-corner",
        APPROACH,
        "(weights[:, :, :, None] * velocity).sum(2)",
        "velocity[:, :, 0]",
        ON_GRADIENTS,
        switched=False,
    ),
    Mutant(
        "rate-gradient-between-edges",
        APPROACH,
        "torch.stack([1.0 - v, zero, v], 1)",
        "torch.stack([1.0 - v, v, zero], 1)",
        ON_GRADIENTS,
        switched=False,
    ),
    Mutant(
        "rate-gradient-turns-back",
        "pgccd/contacts/gradients.py",
        "travel + torch.linalg.cross(rotation.expand_as(arm), arm)",
        "travel - torch.linalg.cross(rotation.expand_as(arm), arm)",
        ON_GRADIENTS,
        switched=False,
    ),
    _mutant("recedes-slack-1.001", APPROACH, "needed = gap - slack", "needed = gap - 1.001 * slack"),
    _mutant("recedes-gap-0.999", APPROACH, "needed = gap - slack", "needed = 0.999 * gap - slack"),
    _mutant("recedes-at-toi-only", APPROACH, "torch.minimum(*gaps)", "gaps[0]"),
    _mutant("recedes-beyond-the-step", APPROACH, "(self.toi[:, None], 1.0):", "(self.toi[:, None], 1.0001):"),
    _mutant("recedes-before-the-end", APPROACH, "(self.toi[:, None], 1.0):", "(self.toi[:, None], 0.9999):"),
    _mutant(
        "recedes-beyond-the-step-on-arcs",
        APPROACH,
        "toi + (1.0 - toi) * torch.linspace",
        "toi + 1.0001 * (1.0 - toi) * torch.linspace",
    ),
    _mutant(  # not by 0.9999: `may_stay` looks at the very end too
        "recedes-before-the-end-on-arcs",
        APPROACH,
        "toi + (1.0 - toi) * torch.linspace",
        "toi + 0.9 * (1.0 - toi) * torch.linspace",
    ),
    _mutant("recedes-unresolved", APPROACH, "(status == Status.TOUCH) & (sites.kind", "(sites.kind"),
    _mutant(
        "recedes-intersecting",
        APPROACH,
        "(status == Status.TOUCH) & (sites.kind <= Kind.EE)",
        "(status == Status.TOUCH)",
    ),
    _mutant("recedes-some-faces", APPROACH, '"amin", 1.0) > 0.0', '"amax", 1.0) > 0.0'),
    _mutant(
        "recedes-faces-of-one",
        APPROACH,
        "for side in (0, 1):\n        place, face =",
        "for side in (0,):\n        place, face =",
    ),
    _mutant(
        "recedes-no-surface-gap",
        APPROACH,
        "gap = torch.minimum(gap, torch.minimum(",
        "_ = torch.minimum(gap, torch.minimum(",
    ),
    _mutant(
        "recedes-from-the-other-side",
        APPROACH,
        "(dot(directions, offset[place][:, None]) >= -noise[place][:, None])",
        "(norm(directions) > 0.0)",
    ),
    _mutant("recedes-one-sided", APPROACH, "stays[came] = is_sided | ", "stays[came] = is_sided | ~is_sided | "),
    Mutant(
        "recedes-roughly", APPROACH, "(needed - _ROUGHLY * size)", "(needed - 0.0 * size)", ON_WOULD, switched=False
    ),
    Mutant(
        "recedes-some-of-its-time",
        APPROACH,
        "self.toi + part * (1.0 - self.toi)",
        "self.toi + 0.5 * part",
        ON_WOULD,
        switched=False,
    ),
    _mutant("recedes-chord", APPROACH, "high.clamp(min=0.0) * length", "0.0 * high * length"),
    _mutant("recedes-chord-0.99", APPROACH, "length * length / 8.0", "0.99 * length * length / 8.0"),
    _mutant("recedes-tangent", APPROACH, "0.5 * low * bottom", "0.5 * high * bottom"),
    _mutant(
        "recedes-curvature",
        APPROACH,
        "stray = square * radius * step * step / 8.0",
        "stray = 0.0 * square * radius * step * step",
    ),
    _mutant(
        "recedes-turns-back", APPROACH, "across, cross(axis, across), angle", "across, -cross(axis, across), angle"
    ),
    _mutant(
        "recedes-no-turn",
        APPROACH,
        "return cls(fixed, zero, across,",
        "return cls(fixed, zero, 0.0 * across,",
    ),
    _mutant(
        "recedes-centre-stays",
        APPROACH,
        "gap = start + change * time + (at_b",
        "gap = start + 0.0 * change * time + (at_b",
    ),
    _mutant(
        "approaching-first-batch-only",
        SEARCH,
        "open_pairs[(at < torch.minimum(first, last))[open_pairs]]",
        "open_pairs[:0]",
    ),
    _mutant("approaching-first-window-only", SEARCH, "left = left[until[left] < 1.0]", "left = left[:0]"),
    _mutant(
        "approaching-in-any-order", SEARCH, "order = order[torch.argsort(contacts.toi[order], stable=True)]", "pass"
    ),
    _mutant("approaching-any-segment", SEARCH, "len(found), segment, found.toi", "len(found), found.toi"),
    _mutant("approaching-one-segment", SEARCH, "low, number = low + number, 2 * number", "low = len(order)"),
    _mutant(
        "normals-kept",
        NORMALS,
        "is_changed = ~is_kept & (first < len(owner))",
        "is_changed = is_kept & ~is_kept & (first < len(owner))",
    ),
    _mutant("normals-clamped", NORMALS, "is_changed = ~is_kept & (first", "is_changed = (is_kept | ~is_kept) & (first"),
    _mutant(
        "normals-farthest",
        NORMALS,
        "nearness = torch.where(usable, dot(normal[owner], candidates)",
        "nearness = torch.where(usable, -dot(normal[owner], candidates)",
    ),
    _mutant(
        "normals-all-convex",
        NORMALS,
        "(dot(normal, of_apex) < -_FLAT * distance)",
        "(dot(normal, of_apex) < torch.inf)",
    ),
    _mutant("normals-flat-is-convex", NORMALS, "< -_FLAT * distance", "< _FLAT * distance"),
    _mutant(
        "normals-concave-is-convex",
        NORMALS,
        "(dot(normal, of_apex) < -_FLAT * distance)",
        "(dot(normal, of_apex).abs() > _FLAT * distance)",
    ),
    _mutant(
        "normals-none-convex", NORMALS, "is_convex & (count <= 2) & (norm(along) > 0.0)", "is_convex & (count < 0)"
    ),
    _mutant(
        "normals-no-edges",
        NORMALS,
        "usable = torch.cat([norm(self.normals) > 0.0, is_sound])",
        "usable = torch.cat([norm(self.normals) > 0.0, is_sound & ~is_sound])",
    ),
    _mutant(
        "normals-sound-anyway",
        NORMALS,
        "is_sound = _is_behind(outside * across[:, None], self.edge_away).all(1) & ",
        "is_sound = ",
    ),
    _mutant(
        "normals-behind-anyway",
        NORMALS,
        "behind = _is_behind(outside * normal[self.owner][:, None], self.away).all(1)",
        "behind = norm(self.normals) >= 0.0",
    ),
    _mutant(
        "normals-no-faces",
        NORMALS,
        "usable = torch.cat([norm(self.normals) > 0.0, is_sound])",
        "usable = torch.cat([norm(self.normals) > 9.0, is_sound])",
    ),
    _mutant(
        "normals-side",
        NORMALS,
        "sign = torch.where(height.abs() > noise[owner], torch.sign(height), 0.0)",
        "sign = torch.where(height.abs() > noise[owner], -torch.sign(height), 0.0)",
    ),
    _mutant("normals-noise", NORMALS, "height.abs() > noise[owner]", "height.abs() > 0.0 * noise[owner]"),
    _mutant(
        "normals-no-noise",
        NORMALS,
        "torch.where(apart[:, None], offset, 0.0), torch.where(apart, noise, 0.0)",
        "offset, 0.0 * noise",
    ),
    Mutant(
        "normals-guessed-for-all",
        NORMALS,
        "~(one.is_guessed | other.is_guessed)[group]",
        "(group >= 0)",
        ("search/test_search_of_approaching.py::test_normals_of_contacts_with_the_same_surfaces",),
        switched=False,
    ),
    _mutant("normals-no-reach", NORMALS, "is_above.double() - is_below.double()", "0.0 * is_above.double()"),
    _mutant("normals-no-solid", NORMALS, "sign = torch.where(sign == 0.0, solid, sign)", "_ = solid"),
    _mutant("normals-beside", NORMALS, "sign = torch.where((over != 0.0) & (solid != 0.0), over, sign)", "_ = over"),
    _mutant("normals-over-all", NORMALS, "is_elsewhere | (dot(inward, point) >= 0.0)", "is_elsewhere | ~is_elsewhere"),
    _mutant("normals-no-partner", NORMALS, "facing.abs() > 0.5", "facing.abs() > 2.0"),
    _mutant("normals-outside", NORMALS, "outside = -1.0 if own.side == 1 else 1.0", "outside = 1.0"),
    _mutant("normals-reversed", NORMALS, "torch.where(some.is_reversed(normal)[:, None], -normal, normal)", "normal"),
    _mutant(
        "normals-parallel", NORMALS, "normal, -unit_or_zero(some.velocity())", "normal, unit_or_zero(some.velocity())"
    ),
    _mutant("normals-last", NORMALS, "one.is_rigid & (~other.is_rigid | is_larger)", "~one.is_rigid"),
    _mutant("normals-last-of-a-face", NORMALS, "last_is_one | (sides[0].what == FACE)", "last_is_one"),
    _mutant("normals-last-of-the-second-face", NORMALS, " & (sides[1].what != FACE)\n", "\n"),
    _mutant("normals-last-of-the-smaller-face", NORMALS, "one.largest_face() > other", "one.largest_face() < other"),
    _mutant("normals-of-vertices-features", NORMALS, "coincide & one.admits(mean)", "~coincide & one.admits(mean)"),
    _mutant("normals-of-vertices-unweighted", NORMALS, "weight[:, None] * self.normals", "self.normals"),
    _mutant("normals-of-vertices-beside", NORMALS, "corners, 0.0)", "corners, corners)"),
]
