"""Writing of checkpoint files; see `pgccd.checkpoint`."""

import hashlib
import json
import math
import os
import re
import secrets
import shutil
import tempfile
import time
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor
from torch.nn.functional import pad

from pgccd import arguments, ops
from pgccd.checkpoint.regular import open_regular, read_regular
from pgccd.runtime.hashing import row_hash

FOLDER = "checkpoints"
POINTER = "newest.json"
FORMAT = 3
INDEX = "index.json"
SHARED = "shared.safetensors"
#: Pattern of the names of checkpoint folders, which begin with a number of steps below `MOST_STEPS`.
MOST_STEPS = 10**12
NAME = re.compile(r"step-\d{9,12}-[0-9a-f]{8}")
#: Dtypes supported by safetensors, by their names in an index.
DTYPES = {
    arguments.dtype_name(dtype): dtype
    for dtype in (
        *(torch.bool, torch.uint8, torch.int8, torch.uint16, torch.int16, torch.uint32, torch.int32, torch.uint64),
        *(torch.int64, torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.complex64),
        *(torch.float8_e4m3fn, torch.float8_e5m2),
    )
}

Columns = Mapping[str, Tensor]

# Suffix of the pointer of a checkpoint that is not yet the newest.
_UNFINISHED_POINTER = ".pointer"
# Number of rows hashed at a time.
_BLOCK = 1 << 20
# Largest sizes of the files in JSON: an index has some 400 bytes for each writing rank, and takes up to 30 times its
# size as Python's values.
_MOST_POINTER, _MOST_INDEX = 1 << 16, 1 << 25
# Seconds until files of one machine are visible on another: network file systems cache folders.
_SEEN_WITHIN = 20.0
_MOST_TEXT = 240
#: Number of checkpoints that are kept by default.
KEEP = 2


class CheckpointError(ValueError):
    """A checkpoint cannot be read or written; the message, one line, names the file."""

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


def one_line(text: str) -> str:
    """A text that may quote a file, as one line of at most 240 characters, without its middle if it is longer."""
    printable = "".join(each if each.isprintable() else " " for each in text)
    return printable if len(printable) <= _MOST_TEXT else f"{printable[:150]} ... {printable[-_MOST_TEXT + 155 :]}"


@contextmanager
def file_errors(path: Path, done: str) -> Iterator[None]:
    """Turns errors of files and their formats into a CheckpointError: the path cannot be `done`."""
    try:
        yield
    except (OSError, SafetensorError, UnicodeError) as error:
        raise CheckpointError(f"{path} cannot be {done}: {getattr(error, 'strerror', None) or error}") from error


@dataclass(frozen=True)
class Content:
    """The content of a checkpoint, except its tables."""

    kind: str  #: of the writer; readers expect their own kind
    steps_made: int
    header: Mapping[str, Any]  #: everything else, as JSON
    shared: Columns = field(default_factory=dict)  #: tensors that are equal on all ranks


@dataclass(frozen=True)
class Rows:
    """A table's entry in the index, for one file."""

    count: int
    hash: int  #: `rows_hash`


@dataclass(frozen=True)
class FileEntry:
    """A file's entry in the index."""

    name: str
    bytes: int
    sha256: str
    tables: Mapping[str, Rows] = field(default_factory=dict)


def file_entry(content: Any) -> FileEntry:
    """A file's entry from JSON.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: it is none.
    """
    tables = {name: Rows(**rows) for name, rows in content["tables"].items()}
    for rows in tables.values():
        whole_number(rows.count), whole_number(rows.hash)
    return FileEntry(**(content | {"bytes": whole_number(content["bytes"]), "tables": tables}))


def whole_number(value: Any) -> int:
    """The value, if it is an int >= 0."""
    if type(value) is not int or value < 0:
        raise ValueError("expected numbers >= 0")
    return value


def checked_keep(keep: Any) -> int:
    """A number of checkpoints to keep, as an argument `keep`."""
    return arguments.integer(keep, "keep", 1, "a number of checkpoints >= 1")


def rank_file(rank: int) -> str:
    """The name of a rank's file."""
    return f"rank-{rank:05d}.safetensors"


def rows_hash(columns: Columns, rank: int, begin: int) -> int:
    """Hash over rows and their positions in the checkpoint.

    Args:
        columns: (N, ...) on the CPU, of any dtype.
        rank: the rank whose file holds them.
        begin: index of the first row in its table.

    Returns:
        An integer in [0, 2^64). Hashes of parts of a table add up modulo 2^64.
    """
    ordered = [columns[name].contiguous() for name in sorted(columns)]
    count, total = len(ordered[0]), 0
    for first in range(0, count, _BLOCK):
        rows = torch.arange(first, min(count, first + _BLOCK))
        packed = ops.pack_rows(ordered, rows)
        words = pad(packed, (0, -packed.shape[1] % 8)).view(torch.int64)
        total += row_hash([torch.full_like(rows, rank), rows + begin, words])
    return total % 2**64


def require_writable(root: Path) -> None:
    """Creates the folder `checkpoints` if needed, and for a moment a file in it, so that a run that cannot write
    checkpoints fails before its first step.

    Raises:
        CheckpointError: no file can be created there.
    """
    with file_errors(root, "written to"):
        root.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=root):
            pass


def make_folder(root: Path, kind: str, steps_made: int) -> str:
    """Creates the folder of a checkpoint, with a unique name.

    Args:
        root: the folder `checkpoints`.
        kind, steps_made: as in `Content`.

    Returns:
        The folder's name.

    Raises:
        CheckpointError: it cannot be created, or `root` holds a checkpoint of another kind.
    """
    if (root / POINTER).exists():
        read_pointer(root, kind)
    name = f"step-{steps_made:09d}-{secrets.token_hex(4)}"
    with file_errors(root / name, "made"):
        (root / name).mkdir(parents=True)
    return name


def write_tables(folder: Path, rank: int, tables: Mapping[str, Columns]) -> FileEntry:
    """Writes one rank's tables, with columns on the CPU, and syncs the file to disk.

    Raises:
        CheckpointError: they cannot be written.
    """
    tensors = {f"{table}/{name}": column for table, columns in tables.items() for name, column in columns.items()}
    written = _write_tensors(folder / rank_file(rank), tensors)
    rows = {
        table: Rows(len(next(iter(columns.values()))), rows_hash(columns, rank, 0)) for table, columns in tables.items()
    }
    return FileEntry(written.name, written.bytes, written.sha256, rows)


def layout_of(tables: Mapping[str, Columns]) -> dict[str, dict[str, list[Any]]]:
    """The dtype and row shape of each column, by table and name, as stored in the index."""
    return {
        table: {name: [arguments.dtype_name(column.dtype), list(column.shape[1:])] for name, column in columns.items()}
        for table, columns in tables.items()
    }


def publish(
    root: Path, name: str, content: Content, layout: Mapping[str, Any], files: Sequence[FileEntry], keep: int = KEEP
) -> Path:
    """Completes a checkpoint whose tables have been written, once all their files are seen; makes it the newest one,
    and removes all but the newest ones.

    Args:
        root: the folder `checkpoints`.
        name: of the checkpoint's folder in it.
        content: everything but the tables.
        layout: of the tables: see `layout_of`.
        files: of all ranks.
        keep: number of checkpoints to keep, this one included.

    Returns:
        Its folder.

    Raises:
        CheckpointError: it cannot be written; the previous one is kept.
    """
    folder = root / name
    _require_seen(folder, files)
    index: dict[str, Any] = {"format": FORMAT, "kind": content.kind, "steps_made": content.steps_made}
    index |= {"header": content.header, "layout": layout, "files": [asdict(entry) for entry in files]}
    if content.shared:
        index["shared"] = asdict(_write_tensors(folder / SHARED, content.shared))
    with file_errors(folder, "written"):
        raw = json.dumps(index, indent=1).encode()
        former = _former(root, keep - 1)
        pointer: dict[str, Any] = {"format": FORMAT, "kind": content.kind, "folder": name, "former": former}
        pointer["index_sha256"] = hashlib.sha256(raw).hexdigest()
        unfinished = root / f"{name}{_UNFINISHED_POINTER}"
        _write_bytes(unfinished, json.dumps(pointer).encode())  # before the index: see `orphans`
        _write_bytes(folder / INDEX, raw)
        _write_bytes(folder / POINTER, json.dumps(pointer | {"former": []}).encode())
        _sync(folder)
        _sync(root)  # syncs the entry of the new folder
        os.replace(unfinished, root / POINTER)
        _sync(root)
    try:
        _remove_others(root, {name, *former})
    except OSError as error:  # the new checkpoint is complete
        warnings.warn(f"{root}: previous checkpoints cannot be removed: {error.strerror or error}", stacklevel=2)
    return folder


def discard(root: Path, name: str) -> None:
    """Removes the files of an incomplete checkpoint, unless `newest.json` names it or cannot be read."""
    try:
        pointer = json.loads(read_regular(root / POINTER, _MOST_POINTER))
        named = {pointer["folder"], *_names(pointer.get("former"))}
    except FileNotFoundError:
        named = set()
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return
    if name not in named:
        shutil.rmtree(root / name, ignore_errors=True)
        with suppress(OSError):
            (root / f"{name}{_UNFINISHED_POINTER}").unlink()


def orphans(root: Path) -> list[str]:
    """Names of complete checkpoints in a folder that has lost `newest.json`. Checkpoints whose writing was interrupted
    before they became the newest have a pointer of their own, and are left out.
    """
    if not root.is_dir():
        return []
    names = {entry.name for entry in root.iterdir()}
    return [
        name
        for name in sorted(names)
        if NAME.fullmatch(name) and f"{name}{_UNFINISHED_POINTER}" not in names and (root / name / INDEX).exists()
    ]


def remove_all(root: Path) -> None:
    """Removes all checkpoints, but no other files."""
    if root.is_dir():
        (root / POINTER).unlink(missing_ok=True)  # first: what it names is complete as long as it exists
        _remove_others(root, set())
        with suppress(OSError):  # it is a link, or holds other files
            root.rmdir()


def replace_text(path: Path, text: str) -> None:
    """Writes a file under another name, then gives it this one. Follows no symbolic links."""
    unfinished = path.with_name(f"{path.name}.unfinished")
    unfinished.unlink(missing_ok=True)
    with open(unfinished, "x") as file:
        file.write(text)
    os.replace(unfinished, path)


def read_pointer(root: Path, kind: str) -> tuple[str, str]:
    """The name of the newest checkpoint, and the hash of its index.

    Raises:
        CheckpointError: it cannot be read, or the checkpoint is of another kind.
    """
    path = root / POINTER
    content = read_json(path, read_bytes(path, _MOST_POINTER))
    require_format(path, content, kind)
    name, digest = content.get("folder"), content.get("index_sha256")
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise CheckpointError(f"{path}: folder: expected the name of a checkpoint, got {name!r}")
    return name, str(digest)


def read_bytes(path: Path, most_bytes: int = _MOST_INDEX) -> bytes:
    """The content of a file; raises CheckpointError if it cannot be read, is no regular file, or is too large."""
    with file_errors(path, "read"):
        return read_regular(path, most_bytes)


def read_json(path: Path, raw: bytes) -> dict[str, Any]:
    """The JSON object in a file; raises CheckpointError if there is none. Strict, so that no two readers can differ: in
    UTF-8, without repeated keys, NaN and infinite numbers.
    """
    try:
        content = json.loads(
            raw.decode(), object_pairs_hook=_without_repetition, parse_float=_finite, parse_constant=_finite
        )
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{path} cannot be read as JSON: {error}") from error
    if not isinstance(content, dict):
        raise CheckpointError(f"{path}: expected an object, got {type(content).__name__}")
    return content


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"the key {max(names, key=names.count)!r} is repeated")
    return content


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"expected finite numbers, got {text}")
    return value


def require_format(path: Path, content: Mapping[str, Any], kind: str) -> None:
    """Raises CheckpointError unless a file has the format of this version and the given kind."""
    if content.get("format") != FORMAT:
        raise CheckpointError(f"{path}: its format is {content.get('format')!r}, this version reads {FORMAT}")
    if content.get("kind") != kind:
        raise CheckpointError(f"{path}: expected the checkpoint of a {kind}, it is of kind {content.get('kind')!r}")


def file_hash(path: Path) -> str:
    """SHA-256 of a file."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _write_tensors(path: Path, tensors: Columns) -> FileEntry:
    """Writes a file and syncs it to disk."""
    with file_errors(path, "written"):
        for name, tensor in tensors.items():
            if tensor.dtype not in DTYPES.values():
                raise CheckpointError(f"{path} cannot be written: {name!r} is of {tensor.dtype}")
        save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, path)
        _sync(path)
        return FileEntry(path.name, path.stat().st_size, file_hash(path))


def _write_bytes(path: Path, content: bytes) -> None:
    with open(path, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync(path: Path) -> None:
    """Syncs a file, or the entries of a folder, to disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _former(root: Path, count: int) -> list[str]:
    """Names of the newest checkpoints so far, the newest first; none if there are none, or cannot be told."""
    try:
        pointer = json.loads(read_regular(root / POINTER, _MOST_POINTER))
        names = _names([pointer["folder"], *_names(pointer.get("former"))])
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return []
    return [name for name in names if (root / name / INDEX).exists()][:count]


def _names(value: Any) -> list[str]:
    """The names of checkpoints in a list of a file."""
    return [name for name in value or [] if isinstance(name, str) and NAME.fullmatch(name)]


def _require_seen(folder: Path, files: Sequence[FileEntry]) -> None:
    """Raises CheckpointError unless this machine sees the files of all ranks: another one may write to a folder of its
    own.
    """
    deadline = time.monotonic() + _SEEN_WITHIN
    for rank, entry in enumerate(files):
        path = folder / rank_file(rank)
        while True:
            with suppress(OSError):
                if entry.name == path.name and path.stat().st_size == entry.bytes:
                    break
            if time.monotonic() > deadline:
                raise CheckpointError(f"{path}, which rank {rank} has written, is not seen by rank 0")
            time.sleep(0.05)
            with suppress(OSError):
                os.listdir(folder)  # makes some network file systems refresh


def _remove_others(root: Path, kept: Collection[str]) -> None:
    """Removes earlier and incomplete checkpoints."""
    for other in list(root.iterdir()):
        if other.name not in kept and NAME.fullmatch(other.name.removesuffix(_UNFINISHED_POINTER)):
            if other.is_dir() and not other.is_symlink():
                shutil.rmtree(other, ignore_errors=True)
            else:
                other.unlink(missing_ok=True)
