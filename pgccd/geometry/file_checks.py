"""Compares what mesh files declare with what they hold. Readers drop rows that are missing or that they do not
understand, and the surface would have holes.
"""

import bisect
import codecs
import itertools
import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from pgccd.geometry.mesh_formats import collada_root

# Scalar types of PLY files.
_PLY_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2"},
    **{"uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}


class _Line(NamedTuple):
    """A line of a text."""

    number: int  #: from 1
    words: list[bytes]


def declared_triangles(path: Path) -> int | None:
    """Number of triangles that a file describes, a polygon of n corners as n - 2; None for other kinds of files.

    Raises:
        ValueError: it holds less or more than it declares, or names vertices that are not there.
    """
    count = _COUNTERS.get(path.suffix.lower())
    return None if count is None else count(path.read_bytes())


def _stl(data: bytes) -> int | None:
    size = len(data) - 84
    count = int.from_bytes(data[80:84], "little")
    if size >= 0 and size == 50 * count:
        return count
    if _is_stl_text(data):
        return _stl_text(data)
    if size < 0:
        return None
    raise ValueError(
        f"a binary STL file, whose header declares {count} triangles of 50 bytes, but {size} bytes follow it: the file "
        "is truncated, or the number is wrong"
    )


def _is_stl_text(data: bytes) -> bool:
    """Whether an STL file is text, in upper or lower case, with or without a byte-order mark."""
    return data.removeprefix(codecs.BOM_UTF8).lstrip()[:5].lower() == b"solid" and b"\0" not in data


def _stl_text(data: bytes) -> int:
    data = data.removeprefix(codecs.BOM_UTF8).lower()
    words = re.findall(rb"(?m)^[ \t]*(solid|facet|vertex|endfacet|endsolid)\b", data)
    count = {word: words.count(word) for word in (b"solid", b"facet", b"vertex", b"endfacet", b"endsolid")}
    facets = count[b"facet"]
    if count[b"endfacet"] != facets or count[b"vertex"] != 3 * facets or count[b"endsolid"] != count[b"solid"]:
        found = f"{facets} facets with {count[b'vertex']} vertices, {count[b'endfacet']} of them ended"
        solids = f"{count[b'endsolid']} of {count[b'solid']} solids"
        raise ValueError(f"an STL file of {found}, and {solids}: the file is truncated")
    return facets


_NUMBER = rb"[ \t]+[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|(?i:nan|inf(?:inity)?))(?![^ \t\r\n#])"
_OBJ_NO_VERTEX = re.compile(rb"(?m)^[ \t]*v(?=[ \t])(?!" + 3 * _NUMBER + rb")[^\r\n]*")


def _obj(data: bytes) -> int:
    text = data.replace(b"\\\r\n", b"   ").replace(b"\\\n", b"  ")  # what stands where stays the same

    def line_of(match: re.Match[bytes]) -> str:
        before = data.count(b"\n", 0, match.start())
        return f"line {before + 1}"

    vertices = [match.start() for match in re.finditer(rb"(?m)^[ \t]*v[ \t]", text)]
    if wrong := _OBJ_NO_VERTEX.search(text):
        raise ValueError(f"{line_of(wrong)}: {wrong[0].decode('ascii', 'replace').strip()!r}: expected three numbers")
    triangles = 0
    for number, match in enumerate(re.finditer(rb"(?m)^[ \t]*f[ \t]+([^\r\n#]*)", text)):
        corners = [corner.split(b"/", 1)[0] for corner in match[1].split()]
        named = f"{line_of(match)}: face {number}: {match[1].decode('ascii', 'replace').strip()!r}"
        try:
            rows = [int(corner) for corner in corners]
        except ValueError as error:
            raise ValueError(f"{named}: expected vertex indices") from error
        if len(rows) < 3:
            raise ValueError(f"{named}: expected three corners or more")
        if 0 in rows:
            raise ValueError(f"{named}: vertices of an OBJ file are numbered from 1, or backwards from -1")
        if max(map(abs, rows)) > len(vertices):
            raise ValueError(f"{named}: there are {len(vertices)} vertices")
        if -min(rows) > bisect.bisect(vertices, match.start()):
            raise ValueError(f"{named}: it counts backwards beyond the first vertex")
        triangles += len(rows) - 2
    return triangles


def _off(data: bytes) -> int:
    parts = re.split(rb"OFF", re.sub(rb"#[^\n]*", b"", data), maxsplit=1)
    before = data.count(b"\n") - parts[-1].count(b"\n") + 1
    numbered = [_Line(k, line.split()) for k, line in enumerate(parts[-1].splitlines(), before) if line.strip()]
    lines = [line.words for line in numbered]
    try:
        vertex_count, face_count = (int(word) for word in lines[0][:2])
    except (IndexError, ValueError) as error:
        raise ValueError("an OFF file without the numbers of vertices and faces") from error
    vertices = lines[1 : 1 + vertex_count]
    _require_rows("an OFF file", "vertices", vertex_count, sum(len(row) >= 3 for row in vertices))
    sizes = []
    for line in numbered[1 + vertex_count : 1 + vertex_count + face_count]:
        row = _integers(line.words[:1], line)
        if len(line.words) <= row[0]:
            continue
        sizes.append(row[0])
        corners = _integers(line.words[1 : 1 + row[0]], line)
        if corners and not 0 <= min(corners) <= max(corners) < vertex_count:
            raise ValueError(f"line {line.number}: face {corners}: there are {vertex_count} vertices")
    _require_rows("an OFF file", "faces", face_count, len(sizes))
    if len(lines) > 1 + vertex_count + face_count:
        raise ValueError("an OFF file that holds more rows than it declares")
    return sum(max(0, size - 2) for size in sizes)


def _integers(words: Sequence[bytes], line: _Line) -> list[int]:
    try:
        return [int(word) for word in words]
    except ValueError as error:
        said = b" ".join(line.words).decode("latin-1")
        raise ValueError(f"line {line.number}: face {said!r}: expected vertex indices") from error


@dataclass
class _Property:
    """A property of the rows of a PLY element: a number, or a list with its length."""

    name: str
    values: np.dtype
    length: np.dtype | None


# Names that files give to the corners of their faces.
_CORNERS = ("vertex_indices", "vertex_index")
#: Columns of an element: numbers (n,), lists of equal length (n, k), or lists of any lengths.
PlyColumns = dict[str, np.ndarray | list[list[int]]]


def ply_elements(data: bytes) -> Iterator[tuple[str, PlyColumns, bool]]:
    """Name and columns of the elements of a PLY file, and whether it is a text; lists of three are an array (n, 3).

    Raises:
        ValueError: it holds less or more than it declares.
    """
    header, end, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not end:
        return
    body = body[body.find(b"\n") + 1 :]
    kind, elements = "", []
    for line in header.decode("latin-1").splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            kind = words[1]
        elif words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), list[_Property]()))
        elif words[:1] == ["property"] and elements:
            order = ">" if "big" in kind else "<"
            types = [np.dtype(order + _PLY_TYPES[name]) for name in words[1 + (words[1] == "list") : -1]]
            elements[-1][2].append(_Property(words[-1], types[-1], types[0] if len(types) == 2 else None))
    is_text = kind == "ascii"
    numbered = enumerate(body.splitlines(), header.count(b"\n") + 2)
    lines = (_Line(number, line.split()) for number, line in numbered if line.strip()) if is_text else iter(())
    begin, vertices = 0, sum(count for name, count, _ in elements if name == "vertex")
    for name, count, properties in elements:
        rows: list[_Line] = []
        if is_text:
            rows = list(itertools.islice(lines, count))
            columns, found = _text_rows(rows, properties)
        else:
            columns, found, begin = _binary_rows(body, begin, count, properties)
        _require_rows("a PLY file", f"element {name}", count, found)
        for corners in _CORNERS:
            if corners in columns:
                columns[corners] = _corners(columns[corners], rows, vertices)
        yield name, columns, is_text
    if next(lines, None) is not None:
        raise ValueError("a PLY file that holds more rows than it declares")


def _corners(rows: np.ndarray | list[list[int]], lines: Sequence[_Line], vertices: int) -> np.ndarray | list[list[int]]:
    """Corners of faces as integers: files may have them as floats.

    Raises:
        ValueError: naming the face of a number that is no vertex.
    """
    if isinstance(rows, np.ndarray):
        with np.errstate(invalid="ignore"):  # infinite numbers
            if bool(((rows >= 0) & (rows < vertices) & (rows % 1 == 0)).all()):
                return rows.astype(np.int64)
        rows = rows.tolist()
    for face, row in enumerate(rows):
        at = f"face {face} (line {lines[face].number})" if lines else f"face {face}"
        if any(corner != corner or corner % 1 for corner in row):
            raise ValueError(f"{at}: {[float(corner) for corner in row]}: expected vertex indices")
        if any(not 0 <= corner < vertices for corner in row):
            raise ValueError(f"{at}: {[int(corner) for corner in row]}: there are {vertices} vertices")
    return [[int(corner) for corner in row] for row in rows]


def _ply(data: bytes) -> int:
    triangles = 0
    for _, columns, _ in ply_elements(data):
        corners = next((columns[name] for name in _CORNERS if name in columns), None)
        if isinstance(corners, np.ndarray) and corners.ndim == 2:
            triangles += len(corners)
        elif corners is not None:
            triangles += sum(max(0, len(each) - 2) for each in corners)
    return triangles


def _text_rows(rows: Sequence[_Line], properties: Sequence[_Property]) -> tuple[PlyColumns, int]:
    """The columns, and the number of whole rows."""
    values: list[list[Any]] = [[] for _ in properties]
    whole = 0
    for line in rows:
        row = line.words
        at, here = 0, []
        for each in properties:
            size = 1
            if each.length is not None and at < len(row):
                if not row[at].isdigit():
                    word = row[at].decode("latin-1")
                    raise ValueError(f"line {line.number}: a PLY file with {word!r} as the length of a list")
                size, at = int(row[at]), at + 1
            here.append(row[at : at + size])
            at += size
        if at > len(row):
            break
        whole += 1
        for column, given in zip(values, here, strict=True):
            column.append(given)
    columns: PlyColumns = {}
    for each, column in zip(properties, values, strict=True):
        try:
            if each.length is None:
                columns[each.name] = np.array([given[0] for given in column], dtype=each.values.kind + "8")
            else:
                columns[each.name] = _lists([[int(w) if w.isdigit() else float(w) for w in given] for given in column])
        except ValueError as error:
            raise ValueError(f"{_first_wrong(column, rows)}: {error}") from error
    return columns, whole


def _first_wrong(column: Sequence[Sequence[bytes]], rows: Sequence[_Line]) -> str:
    """The line of the first row whose words are not all numbers."""
    for given, line in zip(column, rows, strict=False):
        try:
            [float(word) for word in given]
        except ValueError:
            return f"line {line.number}"
    return "a PLY file"


def _lists(rows: list[list[Any]]) -> np.ndarray | list[list[int]]:
    return np.array(rows).reshape(-1, 3) if all(len(row) == 3 for row in rows) else rows


def _binary_rows(body: bytes, begin: int, count: int, properties: Sequence[_Property]) -> tuple[PlyColumns, int, int]:
    """The columns, the number of whole rows, and where they end."""
    sizes, at = [], begin
    for each in properties:  # of the first row
        size = 1 if each.length is None else _list_size(body, at, each.length)
        sizes.append(size)
        at += (0 if each.length is None else each.length.itemsize) + size * each.values.itemsize
    fields: list[Any] = []
    for k, (each, size) in enumerate(zip(properties, sizes, strict=True)):
        fields += [] if each.length is None else [(f"length{k}", each.length)]
        fields.append((f"values{k}", each.values, () if each.length is None else (size,)))
    row = np.dtype(fields)
    if count and properties and len(body) - begin >= count * row.itemsize:
        rows = np.frombuffer(body, row, count, begin)
        is_list = [each.length is not None for each in properties]
        if all((rows[f"length{k}"] == sizes[k]).all() for k, one in enumerate(is_list) if one):
            columns: PlyColumns = {}
            for k, each in enumerate(properties):
                column = rows[f"values{k}"]
                columns[each.name] = column.tolist() if is_list[k] and sizes[k] != 3 else column
            return columns, count, begin + count * row.itemsize
    values: list[list[Any]] = [[] for _ in properties]
    whole = 0
    for _ in range(count if properties else 0):
        at, here = begin, []
        for each in properties:
            size = 1
            if each.length is not None:
                size = _list_size(body, at, each.length)
                at += each.length.itemsize
            if at + size * each.values.itemsize > len(body):
                at = len(body) + 1
                break
            here.append(np.frombuffer(body, each.values, size, at).tolist())
            at += size * each.values.itemsize
        if at > len(body):
            break
        begin, whole = at, whole + 1
        for kept, given in zip(values, here, strict=True):
            kept.append(given)
    found: PlyColumns = {}
    for each, kept in zip(properties, values, strict=True):
        found[each.name] = np.array([given[0] for given in kept]) if each.length is None else _lists(kept)
    return found, whole if properties else count, begin


def _list_size(body: bytes, at: int, kind: np.dtype) -> int:
    return int(np.frombuffer(body, kind, 1, at)[0]) if at + kind.itemsize <= len(body) else 0


def _dae(data: bytes) -> int:
    root = collada_root(data)
    space = root.tag.removesuffix("COLLADA")

    def named(tag: str) -> dict[str, Element]:
        """The elements of a kind by their name, as others refer to them."""
        return {"#" + element.get("id", ""): element for element in root.iter(space + tag)}

    def triangles_of(url: str) -> int:
        if url not in geometries:
            raise ValueError(f"a Collada file without the geometry {url!r} of its scene")
        return _collada_triangles(geometries[url], space)

    geometries, skins, scenes = named("geometry"), named("controller"), named("visual_scene")
    shown = {url for each in root.iter(space + "instance_visual_scene") if (url := each.get("url")) in scenes}
    triangles = 0
    for scene in (scenes[url] for url in shown or scenes):
        triangles += sum(triangles_of(each.get("url", "")) for each in scene.iter(space + "instance_geometry"))
        for each in scene.iter(space + "instance_controller"):
            if (url := each.get("url", "")) in skins:
                triangles += sum(triangles_of(skin.get("source", "")) for skin in skins[url].iter(space + "skin"))
    return triangles


def _collada_triangles(geometry: Element, space: str) -> int:
    triangles = sum(int(each.get("count", 0)) for each in geometry.iter(space + "triangles"))
    for polygons in geometry.iter(space + "polylist"):
        triangles += sum(int(size) - 2 for size in (polygons.findtext(space + "vcount") or "").split())
    for kind in ("polygons", "tristrips", "trifans"):
        for group in geometry.iter(space + kind):
            stride = 1 + max((int(each.get("offset", 0)) for each in group.iter(space + "input")), default=0)
            triangles += sum(len((each.text or "").split()) // stride - 2 for each in group.iter(space + "p"))
    return triangles


def _gltf(data: bytes) -> int:
    """Of strips, from which readers leave out triangles without area, nothing is counted."""
    if data.startswith(b"glTF"):
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    try:
        content: dict[str, Any] = json.loads(data)
        meshes, nodes, accessors = (content.get(key, []) for key in ("meshes", "nodes", "accessors"))
        scenes = content.get("scenes", [])
        waiting = list(scenes[content.get("scene", 0)].get("nodes", []) if scenes else range(len(nodes)))
        triangles, seen = 0, set[int]()
        while waiting:
            node = nodes[number := waiting.pop()]
            if number in seen:
                continue
            seen.add(number)
            waiting += node.get("children", [])
            for primitive in meshes[node["mesh"]]["primitives"] if "mesh" in node else ():
                rows = accessors[primitive.get("indices", primitive["attributes"]["POSITION"])]["count"]
                triangles += {4: rows // 3, 6: rows - 2}.get(primitive.get("mode", 4), 0)
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise ValueError(f"a glTF file with broken references or text: {type(error).__name__}: {error}") from error
    return triangles


def _require_rows(kind: str, what: str, declared: int, found: int) -> None:
    if found < declared:
        raise ValueError(f"{kind} that declares {declared} rows of {what}, but holds {found} whole ones")


_COUNTERS: dict[str, Callable[[bytes], int | None]] = {
    ".stl": _stl,
    ".obj": _obj,
    ".off": _off,
    ".ply": _ply,
    ".dae": _dae,
    ".glb": _gltf,
    ".gltf": _gltf,
}
