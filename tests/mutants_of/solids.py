"""Mutants of solids: which vertices are candidates, rays through triangles, and what calls make of it."""

from __future__ import annotations

from mutants_of.mutant import Mutant

WINDING = "csrc/kernels/narrow/winding_item.h"
ENCLOSURES = "csrc/core/enclosures.h"
PYTHON = "pgccd/"
ON_SOLIDS = ("search/test_solids.py",)
ON_THICKNESS = ("search/test_thickness.py",)
ON_ENCLOSED = ("search/test_enclosed.py",)
PASSES = "turn != 0 && static_cast<int>(volume()) == turn ? turn : 0"
OFFSET = "(between + turned) - centre_of_solid"


def _winding(name: str, old: str, new: str, within: str = "") -> Mutant:
    return Mutant(f"winding-{name}", WINDING, old, new, ON_SOLIDS, within)


def _enclosures(name: str, old: str, new: str, within: str = "") -> Mutant:
    return Mutant(f"enclosures-{name}", ENCLOSURES, old, new, ON_SOLIDS, within)


def _python(name: str, file: str, old: str, new: str, killed_by: tuple[str, ...] = ON_SOLIDS) -> Mutant:
    return Mutant(f"solids-{name}", PYTHON + file, old, new, killed_by, switched=False)


MUTANTS = [
    _winding("counts-behind", PASSES, "turn"),
    _winding("no-order-of-passes", PASSES, "(turn != 0 && volume() != Sign::kZero ? turn : 0)"),
    _winding("nodes-behind-only", "dot(ray.direction, offset) >= -reach", "dot(ray.direction, offset) >= reach"),
    _winding(
        "thin-nodes",
        "norm_squared(cross(ray.direction, offset)) <= reach * reach",
        "norm_squared(cross(ray.direction, offset)) <= 0.9 * reach * reach",
    ),
    Mutant(
        "winding-above-is-at",
        WINDING,
        "points().point[corner].z > points().point[0].z",
        "points().point[corner].z >= points().point[0].z",
        ON_SOLIDS,
        equivalent="the ray then starts at z - e^2, which meets no vertex and no edge either",
    ),
    _winding("heights-in-double", "magnitude(height) > 4.0 * error_", "true"),
    Mutant(
        "winding-on-the-edge",
        WINDING,
        "side_of(2 + k, 2 + next) == upwards",
        "static_cast<int>(side_of(2 + k, 2 + next)) != -static_cast<int>(upwards)",
        ON_SOLIDS,
        equivalent="the ray then starts at y - e, which meets no vertex and no edge either",
    ),
    _winding("one-edge", "turn += static_cast<int>(upwards)", "turn = static_cast<int>(upwards)"),
    _winding(
        "not-turned-back", "offset.x * m.r0 + offset.y * m.r1 + offset.z * m.r2", "pair.orientation[solid] * offset"
    ),
    _winding("about-the-origin", "turned_back - mesh_centre(bodies, pair.body[solid])", "turned_back"),
    _winding("of-the-other-side", "side == 0 ? pair.centre.at_t0 : -pair.centre.at_t0", "pair.centre.at_t0"),
    _winding("of-the-first-side", "side == 1", "false", "{corner[0], corner[1], corner[2]}, side == 1}"),
    _enclosures("of-one-side", "side < 2", "side < 1"),
    _enclosures("first-piece", "piece < solids.piece_begin[mesh + 1]", "piece < solids.piece_begin[mesh] + 1"),
    _enclosures(
        "half-a-sphere",
        "most * most * (1.0 + kRounding)",
        "0.25 * most * most * (1.0 + kRounding)",
    ),
    _enclosures("about-the-origin", OFFSET, "between + turned"),
    _enclosures("however-placed", OFFSET, "turned - centre_of_solid"),
    _python(
        "auto-inwards",
        "geometry/solids.py",
        "return float(of_faces.sum()) > 1e-12",
        "return abs(float(of_faces.sum())) > 1e-12",
    ),
    _python("forgotten", "geometry/mesh.py", '"solid": False, ', ""),
    _python("digest", "geometry/digest.py", "if mesh.solid:", "if False:"),
    _python(
        "enclosed-where-surfaces-meet",
        "search/enclosed.py",
        "pairs[~torch.isin(keys, of_meeting)]",
        "pairs",
        ON_ENCLOSED,
    ),
    _python("enclosed-of-solids", "search/enclosed.py", "scene.meshes._bare", "scene.meshes", ON_SOLIDS),
    _python("enclosed-in-part", "search/enclosed.py", "rows[pieces ==", "rows[pieces <=", ON_ENCLOSED),
    _python(
        "enclosed-the-other-way",
        "search/enclosed.py",
        "hits.features[:, :1] < 0",
        "hits.features[:, :1] >= 0",
        ON_ENCLOSED,
    ),
    _python(
        "enclosed-with-margins",
        "search/enclosed.py",
        "bare.meshes, bare.margin = meshes, None",
        "bare.meshes = meshes",
        ON_ENCLOSED,
    ),
    _python("thickness-forgotten", "geometry/scene.py", "if self.meshes.thickness is None:", "if True:", ON_THICKNESS),
    _python(
        "thickness-in-place-of-margins",
        "geometry/scene.py",
        "return sum_of_margins(self.meshes.thickness.index_select(0, self._sound_index), self.margin)",
        "return self.meshes.thickness.index_select(0, self._sound_index)",
        ON_THICKNESS,
    ),
    _python(
        "thickness-rounded-down",
        "geometry/scene_columns.py",
        "torch.where(is_exact, plain, torch.nextafter(plain, torch.full_like(plain, torch.inf)))",
        "plain",
        ON_THICKNESS,
    ),
    _python(
        "thickness-of-what-is-enclosed",
        "geometry/mesh_set.py",
        """        other.thickness = None
        return other

    @cached_property
    def _closed""",
        """        return other

    @cached_property
    def _closed""",
        ON_THICKNESS,
    ),
    _python("thickness-not-in-digests", "geometry/digest.py", "if mesh.thickness:", "if False:", ON_THICKNESS),
    _python("audit-of-solids", "auditing/audit.py", "scene.meshes = scene.meshes._surfaces", "pass"),
    _python("distance-of-surfaces", "search/distance.py", "if scene.meshes.has_solids:", "if False:"),
    _python(
        "gradient-of-no-normal",
        "contacts/gradients.py",
        "torch.where(sound[:, None], found.normal, 0.0)",
        "found.normal",
    ),
    _python(
        "rates-of-no-normal",
        "contacts/approach.py",
        "torch.where(hits.differentiable[:, None], hits.normal, 0.0)",
        "hits.normal",
    ),
]
