"""Mutants of the readers of meshes, scenes and motions in files."""

from __future__ import annotations

from mutants_of.mutant import Mutant

POLYGONS, FORMATS, MESHES, CHECKS, POINTS = (
    f"pgccd/geometry/{name}.py" for name in ("polygons", "mesh_formats", "mesh_files", "file_checks", "point_files")
)
SCENES = "pgccd/files.py"
ON_FORMATS = ("geometry/test_mesh_formats.py",)
ON_CHECKS = ("geometry/test_file_checks.py",)
ON_MESHES = ("geometry/test_mesh_files.py",)
ON_POINTS = ("geometry/test_point_files.py",)
ON_SCENES = ("test_files.py", "auditing/test_runs.py")


def _mutant(
    name: str, file: str, old: str, new: str, killed_by: tuple[str, ...], within: str = "", equivalent: str = ""
) -> Mutant:
    return Mutant(f"file-{name}", file, old, new, killed_by, within, equivalent, switched=False)


MUTANTS = [
    # Polygons.
    _mutant("notch-filled", POLYGONS, "            if is_convex(corners):\n", "            if True:\n", ON_FORMATS),
    _mutant(
        "notch-unseen",
        POLYGONS,
        "is_needed or not all(is_convex(found.vertices[polygon]) for polygon in every if len(polygon) > 3)",
        "is_needed",
        ON_FORMATS,
    ),
    _mutant("notch-of-quads", POLYGONS, "if len(corners) <= 3:", "if len(corners) <= 4:", ON_FORMATS),
    _mutant("notch-of-quads-unseen", POLYGONS, "[^\\s#]+){4}", "[^\\s#]+){5}", ON_FORMATS),
    _mutant("notch-of-collada", MESHES, "        require_convex_polygons(data)\n", "", ON_FORMATS),
    _mutant("notch-of-collada-polygons", POLYGONS, '(b"<polylist", b"<polygons", ', '(b"<polylist", ', ON_FORMATS),
    _mutant("notch-of-collada-with-prefix", POLYGONS, ', b":polylist", b":polygons")', ")", ON_FORMATS),
    _mutant("polygon-turned", POLYGONS, "(signed < 0.0)", "(signed > 0.0)", ON_FORMATS),
    _mutant("polygon-as-cut", POLYGONS, "triangles[:, ::-1], triangles)", "triangles, triangles)", ON_FORMATS),
    _mutant(
        "polygon-crosses-itself",
        POLYGONS,
        "if abs(np.abs(signed).sum() - area) > _ROUNDING * area:",
        "if False:",
        ON_FORMATS,
    ),
    _mutant("polygon-twice-round", POLYGONS, "return bool(turn < 3.0 * np.pi)", "return True", ON_FORMATS),
    _mutant("polygon-halves-cancel", POLYGONS, "if not area > _ROUNDING * ", "if not area > 0.0 * ", ON_FORMATS),
    _mutant("polygon-rounded-is-concave", POLYGONS, "-_ROUNDING * np.abs(crosses).max() - ", "-", ON_FORMATS),
    _mutant("polygon-rounded-by-its-reader", POLYGONS, " - 4.0 * error * lengths", "", ON_FORMATS),
    _mutant("polygon-error-too-large", POLYGONS, "4.0 * error * lengths", "4e3 * error * lengths", ON_FORMATS),
    _mutant("polygon-seen-from-its-side", POLYGONS, "np.abs(normal).argmin()", "np.abs(normal).argmax()", ON_FORMATS),
    _mutant("polygon-index-negative", POLYGONS, "0 <= min(polygon) <= max", "min(polygon) <= max", ON_FORMATS),
    _mutant(
        "polygon-index-beyond", POLYGONS, "max(polygon) < len(found.vertices)", "max(polygon) < np.inf", ON_FORMATS
    ),
    _mutant("obj-index-base", POLYGONS, "row - 1 if row > 0", "row if row > 0", ON_FORMATS),
    _mutant("obj-index-backwards", POLYGONS, "else len(vertices) + row", "else len(vertices) + row - 1", ON_FORMATS),
    _mutant(
        "obj-backwards-amid", POLYGONS, "return found, 0 < backwards", "return found, 1 < 0 < backwards", ON_FORMATS
    ),
    _mutant("obj-texture-index", POLYGONS, 'corner.split(b"/", 1)[0]', 'corner.split(b"/")[-1]', ON_FORMATS),
    _mutant(
        "obj-groups-joined", POLYGONS, "parts.setdefault((object_, group)", 'parts.setdefault((object_, "")', ON_FORMATS
    ),
    _mutant(
        "obj-continued", POLYGONS, 'data.replace(b"\\\\\\r\\n", b" ").replace(b"\\\\\\n", b" ")', "data", ON_FORMATS
    ),
    _mutant("off-triangles-only", POLYGONS, 'if all(line[0] == b"3" for line in faces):', "if faces:", ON_FORMATS),
    _mutant("ply-other-name", POLYGONS, ', columns.get("vertex_index"))', ")", ON_FORMATS),
    _mutant("ply-mixed", POLYGONS, "len(sizes) > 1 and not is_text", "False", ON_CHECKS),
    # Strips, fans and buffers of glTF; meshes of MuJoCo; text.
    _mutant("strip-orientation", FORMATS, "triangles[1::2, [1, 0, 2]]", "triangles[1::2]", ON_FORMATS),
    _mutant("strip-joints-kept", FORMATS, "return triangles[~repeats]", "return triangles", ON_FORMATS),
    _mutant(
        "fan-turned",
        FORMATS,
        "rows[1:-1], rows[2:]], axis=1)\n\n\ndef _strip",
        "rows[2:], rows[1:-1]], axis=1)\n\n\ndef _strip",
        ON_FORMATS,
    ),
    _mutant("lines-kept", FORMATS, 'each.get("mode", _TRIANGLES) >= _TRIANGLES', "True", ON_FORMATS),
    _mutant(
        "gltf-mode-default",
        FORMATS,
        'mode = primitive.get("mode", _TRIANGLES)',
        'mode = primitive.get("mode", _STRIP)',
        ON_FORMATS,
    ),
    _mutant(
        "gltf-offset-of-accessor",
        FORMATS,
        'view.get("byteOffset", 0) + accessor.get("byteOffset", 0)',
        'view.get("byteOffset", 0)',
        ON_FORMATS,
    ),
    _mutant(
        "gltf-offset-of-view",
        FORMATS,
        'view.get("byteOffset", 0) + accessor.get("byteOffset", 0)',
        'accessor.get("byteOffset", 0)',
        ON_FORMATS,
    ),
    _mutant(
        "gltf-offset-of-buffer",
        FORMATS,
        'view.get("byteOffset", 0) + begins[view["buffer"]]',
        'view.get("byteOffset", 0)',
        ON_FORMATS,
    ),
    _mutant("gltf-bytes", FORMATS, '5121: "<u1"', '5121: "<u2"', ON_FORMATS),
    _mutant("gltf-words", FORMATS, '5125: "<u4"', '5125: "<u2"', ON_FORMATS),
    _mutant("gltf-sparse", FORMATS, '"sparse" in accessor or "bufferView"', '"bufferView"', ON_FORMATS),
    _mutant("gltf-quoted-name", FORMATS, "unquote(uri)", "uri", ON_FORMATS),
    _mutant("gltf-buffer-missing", FORMATS, "            if binary is None:\n", "            if False:\n", ON_FORMATS),
    _mutant("mujoco-sizes", FORMATS, "or expected != len(data):", "or expected > len(data):", ON_CHECKS),
    _mutant("mujoco-negative", FORMATS, "if min(header or [-1]) < 0 or expected", "if expected", ON_CHECKS),
    _mutant("mujoco-after-points", FORMATS, "expected - 12 * faces)", "16 + 12 * vertices)", ON_CHECKS),
    _mutant("collada-looks", FORMATS, "return ElementTree.tostring(root)", "return data", ON_CHECKS),
    # Units, placement, welding.
    _mutant("unit-dropped", MESHES, "stated / wanted", "1.0", ON_FORMATS),
    _mutant("unit-inverted", MESHES, "stated / wanted", "wanted / stated", ON_FORMATS),
    _mutant("unit-unnamed", MESHES, "return 1.0, stated", "return 1.0, None", ON_FORMATS),
    _mutant(
        "unit-of-gltf",
        MESHES,
        '(".glb", ".gltf"):\n        return 1.0',
        '(".glb", ".gltf"):\n        return None',
        ON_FORMATS,
    ),
    _mutant("unit-number", MESHES, "float(number or 1.0) * metres", "metres", ON_FORMATS),
    _mutant("unit-not-positive", MESHES, "if not 0.0 < length < np.inf:", "if not length < np.inf:", ON_FORMATS),
    _mutant("unit-infinite", MESHES, "if not 0.0 < length < np.inf:", "if not 0.0 < length:", ON_FORMATS),
    _mutant(
        "unit-unknown",
        MESHES,
        "    if metres is None:\n",
        "    if metres is None and (metres := 1.0) < 0.0:\n",
        ON_FORMATS,
    ),
    _mutant("inch", MESHES, '{"inch": 0.0254,', '{"inch": 0.025,', ON_FORMATS),
    _mutant("foot", MESHES, '"foot": 0.3048}', '"foot": 0.3}', ON_FORMATS),
    _mutant("micron", MESHES, '"micron": 1e-6', '"micron": 1e-3', ON_FORMATS),
    _mutant("centimetre", MESHES, '"centimeter": 1e-2', '"centimeter": 1e-1', ON_FORMATS),
    _mutant("in-feet", MESHES, '"ft": 0.3048}', '"ft": 0.3}', ON_FORMATS),
    _mutant("in-centimetres", MESHES, '"cm": 1e-2,', '"cm": 1e-1,', ON_FORMATS),
    _mutant("mirrored-inside-out", MESHES, "np.linalg.det(transform[:3, :3]) < 0.0", "False", ON_FORMATS),
    _mutant("placed-unmoved", MESHES, "transform[:3, :3].T + transform[:3, 3]", "transform[:3, :3].T", ON_MESHES),
    _mutant("placed-turned-back", MESHES, "vertices @ transform[:3, :3].T", "vertices @ transform[:3, :3]", ON_MESHES),
    _mutant("joined-index-base", MESHES, "[part.faces + begin for", "[part.faces for", ON_MESHES),
    _mutant("objects-joined", MESHES, "if not apart or len(faces) == 1:", "if True:", ON_FORMATS),
    _mutant("objects-of-one-name", MESHES, "geom_name=part.name or str(number)", "geom_name=str(number)", ON_FORMATS),
    _mutant(
        "objects-in-other-order",
        MESHES,
        "key=lambda each: order[each[2]])",
        "key=lambda each: -order[each[2]])",
        ON_CHECKS,
    ),
    _mutant(
        "points-left-out",
        MESHES,
        "    if others and any(geometry.kinds is None and len(geometry.faces) for geometry in found):\n",
        "    if False:\n",
        ON_MESHES,
    ),
    _mutant("gltf-lines-joined", MESHES, 'in (".glb", ".gltf") and any(', 'in (".gltf",) and any(', ON_POINTS),
    _mutant("mirrored-segments", MESHES, "geometry.kinds is None and np.linalg.det", "np.linalg.det", ON_POINTS),
    _mutant("point-twice", MESHES, "    repeats[alone] = True\n", "", ON_POINTS),
    _mutant("segments-after-points", MESHES, '[np.argsort(geometry.kinds[kept], kind="stable")]', "", ON_POINTS),
    _mutant("strips-as-points", POINTS, "            other = name\n", "            pass\n", ON_POINTS),
    _mutant("vertices-as-points", POINTS, "    if not records:\n", "    if False:\n", ON_POINTS),
    _mutant("line-backwards", POINTS, "else before + number", "else len(begins) + number", ON_POINTS),
    _mutant("edge-out-of-range", POINTS, "(rows < count)", "(rows <= count)", ON_POINTS),
    _mutant("fewer-than-declared", MESHES, "declared is not None and read < declared", "False", ON_CHECKS),
    _mutant(
        "weld-by-one-coordinate", MESHES, "!= ordered[:-1]).any(axis=1)", "!= ordered[:-1]).all(axis=1)", ON_MESHES
    ),
    _mutant(
        "weld-keeps-the-last",
        MESHES,
        "order[begins][",
        "np.append(order[1:][begins[1:]] * 0 + order[:-1][begins[1:]], order[-1])[",
        ON_MESHES,
    ),
    _mutant("flat-faces-kept", MESHES, "kept = np.flatnonzero(~repeats)", "kept = np.arange(len(faces))", ON_MESHES),
    _mutant("not-finite-after-welding", MESHES, "    arguments.check_corners(vertices, faces)\n", "", ON_MESHES),
    # What files declare.
    _mutant("stl-longer", CHECKS, "size == 50 * count", "size >= 50 * count", ON_CHECKS),
    _mutant("stl-solid-is-text", CHECKS, ' and b"\\0" not in data', "", ON_CHECKS),
    _mutant("stl-mark", CHECKS, "data.removeprefix(codecs.BOM_UTF8).lstrip()", "data.lstrip()", ON_FORMATS),
    _mutant("stl-upper-case", CHECKS, "lstrip()[:5].lower() ==", "lstrip()[:5] ==", ON_FORMATS),
    _mutant(
        "stl-upper-case-of-words",
        CHECKS,
        "data = data.removeprefix(codecs.BOM_UTF8).lower()",
        "data = data.removeprefix(codecs.BOM_UTF8)",
        ON_CHECKS,
    ),
    _mutant(
        "stl-mark-before-words",
        CHECKS,
        "data = data.removeprefix(codecs.BOM_UTF8).lower()",
        "data = data.lower()",
        ON_FORMATS,
    ),
    _mutant("stl-vertices", CHECKS, ' or count[b"vertex"] != 3 * facets', "", ON_CHECKS),
    _mutant("stl-facets-ended", CHECKS, 'if count[b"endfacet"] != facets or ', "if ", ON_CHECKS),
    _mutant("stl-solids-ended", CHECKS, ' or count[b"endsolid"] != count[b"solid"]:', ":", ON_CHECKS),
    _mutant("obj-zero", CHECKS, "if 0 in rows:", "if False:", ON_CHECKS),
    _mutant(
        "obj-beyond",
        CHECKS,
        "if max(map(abs, rows)) > len(vertices):",
        "if max(map(abs, rows)) > len(vertices) + 1:",
        ON_CHECKS,
    ),
    _mutant(
        "obj-before-the-first",
        CHECKS,
        "if -min(rows) > bisect.bisect(vertices, match.start()):",
        "if False:",
        ON_CHECKS,
    ),
    _mutant("obj-two-corners", CHECKS, "if len(rows) < 3:", "if len(rows) < 2:", ON_CHECKS),
    _mutant("off-short-vertices", CHECKS, "sum(len(row) >= 3 for row in vertices)", "len(vertices)", ON_CHECKS),
    _mutant("off-short-faces", CHECKS, "if len(line.words) <= row[0]:", "if False:", ON_CHECKS),
    _mutant("off-longer", CHECKS, "if len(lines) > 1 + vertex_count + face_count:", "if False:", ON_CHECKS),
    _mutant("ply-big-endian", CHECKS, '">" if "big" in kind else "<"', '"<"', ON_CHECKS),
    _mutant("ply-longer", CHECKS, "if next(lines, None) is not None:", "if False:", ON_CHECKS),
    _mutant("ply-length-of-list", CHECKS, "if not row[at].isdigit():", "if False:", ON_CHECKS),
    _mutant("ply-lists-of-one-length", CHECKS, "if all((rows[", "if all((rows[:1][", ON_CHECKS),
    _mutant("rows-missing", CHECKS, "if found < declared:", "if found < declared - 1:", ON_CHECKS),
    _mutant("collada-other-inputs", CHECKS, "stride = 1 + max(", "stride = 1 + 0 * max(", ON_CHECKS),
    _mutant("collada-all-scenes", CHECKS, "for url in shown or scenes)", "for url in scenes)", ON_CHECKS),
    _mutant(
        "collada-skins",
        CHECKS,
        "triangles += sum(triangles_of(skin",
        "triangles += 0 * sum(triangles_of(skin",
        ON_CHECKS,
    ),
    _mutant("gltf-children", CHECKS, 'waiting += node.get("children", [])', "pass", ON_CHECKS),
    _mutant("gltf-first-scene", CHECKS, 'scenes[content.get("scene", 0)]', "scenes[0]", ON_CHECKS),
    _mutant("gltf-fans", CHECKS, "6: rows - 2", "6: 0", ON_FORMATS),
    # Scenes and motions.
    _mutant("key-unknown", SCENES, "        if key not in known:\n", "        if False:\n", ON_SCENES),
    _mutant("key-of-another-motion", SCENES, "if name not in (*required, *others):", "if False:", ON_SCENES),
    _mutant("key-missing", SCENES, "        if name not in arrays:\n", "        if False:\n", ON_SCENES),
    _mutant("ends-beside-velocities", SCENES, "if by_velocity and (both", "if False and (both", ON_SCENES),
    _mutant("numbers-complex", SCENES, 'kind not in "fiu"', 'kind not in "fiubc"', ON_SCENES),
    _mutant(
        "motion-margin",
        SCENES,
        'columns.get("rotation"), columns.get("margin")',
        'columns.get("rotation"), None',
        ON_SCENES,
    ),
    _mutant(
        "motion-rotation",
        SCENES,
        'columns.get("rotation"), columns.get("margin")',
        'None, columns.get("margin")',
        ON_SCENES,
    ),
    _mutant("motion-steps", SCENES, "if dt.numel() != 1:", "if dt.numel() < 1:", ON_SCENES),
    _mutant("configurations-beside", SCENES, 'if set(arrays) != {"q"}:', 'if "q" not in arrays:', ON_SCENES),
    _mutant("configurations-shape", SCENES, "if q.dim() != 2:", "if False:", ON_SCENES),
    _mutant("frames-transposed", SCENES, "len(shape) != 3 or is_transposed or", "len(shape) != 3 or", ON_SCENES),
    _mutant("frames-end-early", SCENES, "if len(content) < size:", "if False:", ON_SCENES),
    _mutant("frames-of-the-shorter", SCENES, "itertools.zip_longest(*columns)", "zip(*columns)", ON_SCENES),
    _mutant("frames-with-margins", SCENES, "if names == set(kind)", "if names >= set(kind)", ON_SCENES),
    _mutant("scene-in-file-units", SCENES, 'origin, unit="m", solid', "origin, solid", ON_FORMATS),
    _mutant("scene-solids", SCENES, "solid=solid)", "solid=False)", ON_SCENES),
    _mutant(
        "scene-origins", SCENES, "Mesh.load(path.parent / name, origin,", "Mesh.load(path.parent / name,", ON_SCENES
    ),
    _mutant(
        "scene-columns",
        SCENES,
        "for key in _OPTIONAL if key in content}",
        "for key in () if key in content}",
        ON_SCENES,
    ),
    _mutant("scene-origin-count", SCENES, " or len(values) != len(files):", ":", ON_SCENES),
    # Written files.
    _mutant("saved-frame-twice", SCENES, "known = min(count, 1)", "known = 0", ON_SCENES),
    _mutant("saved-former-scene", SCENES, "        path.unlink(missing_ok=True)", "        pass", ON_SCENES),
    _mutant("saved-static", SCENES, 'state["static"] = scene.static.bool()', "pass", ON_SCENES),
    _mutant("saved-default-of-all", SCENES, "if values.ndim or values != _DEFAULTS[name]", "if values.ndim", ON_SCENES),
    _mutant("saved-rounding", SCENES, 'if "rounding" in columns:', "if False:", ON_SCENES),
    _mutant("saved-name-cut", SCENES, "arrays[name].item() != value", "False", ON_SCENES),
    _mutant("saved-world-negative", SCENES, "    _ = scene.world_count  # which checks them\n", "", ON_SCENES),
    _mutant("saved-margins-of-others", SCENES, "        motion._margins(None, scene.body_count)\n", "", ON_SCENES),
    _mutant("names-of-others", "pgccd/arguments.py", "if len(names) != count:", "if False:", ON_SCENES),
    _mutant("mesh-number-missing", SCENES, "if number not in states:", "if False:", ON_SCENES),
    _mutant("frames-rounded", SCENES, ' - {"rounding"}', "", ON_SCENES),
]
