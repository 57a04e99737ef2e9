"""What a rank runs, for agreement: versions, digests of the package's sources, and code of functions."""

from __future__ import annotations

import contextlib
import dis
import functools
import hashlib
import platform
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

import pgccd
from pgccd.ops import build_information


@functools.cache
def code_facts() -> dict[str, str]:
    """Facts that must always be equal on all ranks, by name. Binaries are not compared, because builds of the same
    sources differ.
    """
    return {
        "pgccd": pgccd.__version__,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "Python": ".".join(platform.python_version_tuple()[:2]),
        "machine": platform.machine(),
        "pgccd's .py files": digest_of_files(Path(pgccd.__file__).parent),
        "C++ sources of pgccd's build": build_information()["sources"],
    }


def digest_of_files(package: Path) -> str:
    """Of the names and contents of all .py files in a folder."""
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(package).as_posix()}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()[:16]


def code_of(function: Callable[..., Any]) -> str:
    """A function's name and a digest of its code, not of its place in a file: equal on ranks that run the same
    function.

    Lambdas, partial functions, methods and objects with `__call__` are covered. The digest includes the numbers and
    functions in their closures, defaults and arguments and among the globals that they read, also within tuples, lists
    and dictionaries; of globals only functions of the same package. Texts, tensors and other objects are not compared,
    since they may differ between ranks, as devices do.
    """
    digest = hashlib.sha256()
    _add(digest, function, set())
    name = getattr(function, "__qualname__", type(function).__qualname__)
    return f"{name} ({digest.hexdigest()[:16]})"


def _add(digest: Any, value: Any, seen: set[int]) -> None:
    if id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, functools.partial):
        digest.update(b"partial")
        for each in (value.func, *value.args, *(value.keywords[name] for name in sorted(value.keywords))):
            _add_used(digest, each, seen)
        return
    value = getattr(value, "__wrapped__", value)
    value = getattr(value, "__func__", value)
    code = getattr(value, "__code__", None)
    if isinstance(code, types.CodeType):
        digest.update(repr(_plain(code)).encode(errors="replace"))
        for cell in getattr(value, "__closure__", None) or ():
            with contextlib.suppress(ValueError):  # empty
                _add_used(digest, cell.cell_contents, seen)
        for each in getattr(value, "__defaults__", None) or ():
            _add_used(digest, each, seen)
        for name, each in sorted((getattr(value, "__kwdefaults__", None) or {}).items()):
            digest.update(f"{name}=".encode(errors="replace"))
            _add_used(digest, each, seen)
        known, package = getattr(value, "__globals__", {}), _package(value)
        for name in sorted(_globals_of(code) & known.keys()):
            each = known[name]
            if not callable(each) or (isinstance(each, types.FunctionType) and _package(each) == package):
                _add_used(digest, each, seen)
        return
    kind = value if isinstance(value, type) else type(value)
    digest.update(f"{kind.__module__}.{kind.__qualname__} {getattr(value, '__qualname__', '')}".encode())
    for name in ("__call__", "forward"):  # forward: of a torch module
        method = getattr(kind, name, None)
        if isinstance(getattr(method, "__code__", None), types.CodeType):
            _add(digest, method, seen)


def _add_used(digest: Any, value: Any, seen: set[int]) -> None:
    """Adds what a function uses, if it can be compared."""
    if _is_number(value) or (isinstance(value, tuple) and all(map(_is_number, value))):
        digest.update(f"{value!r} ".encode())
    elif isinstance(value, (tuple, list, dict)):
        if id(value) in seen:
            return
        seen.add(id(value))
        digest.update(f"{type(value).__name__} {len(value)} ".encode())
        if not isinstance(value, dict):
            for each in value:
                _add_used(digest, each, seen)
            return
        # Keys that are other objects, such as devices, may differ between ranks.
        keys = [key for key in value if isinstance(key, str) or _is_number(key)]
        for key in sorted(keys, key=repr):
            digest.update(f"{key!r}: ".encode(errors="replace"))
            _add_used(digest, value[key], seen)
    elif callable(value):
        _add(digest, value, seen)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | complex)


def _package(function: Any) -> str:
    return str(getattr(function, "__module__", "")).partition(".")[0]


def _globals_of(code: types.CodeType) -> set[str]:
    """The names of globals that code reads, functions within it included."""
    names = {each.argval for each in dis.get_instructions(code) if each.opname in ("LOAD_GLOBAL", "LOAD_NAME")}
    return names.union(*(_globals_of(each) for each in code.co_consts if isinstance(each, types.CodeType)))


def _plain(value: Any) -> Any:
    """Code and constants as values whose `repr` is the same in every process."""
    if isinstance(value, types.CodeType):
        names = value.co_names, value.co_varnames, value.co_freevars, value.co_cellvars
        counts = value.co_argcount, value.co_posonlyargcount, value.co_kwonlyargcount, value.co_flags
        return value.co_code, names, counts, [_plain(each) for each in value.co_consts]
    if isinstance(value, frozenset):
        return sorted(repr(_plain(each)) for each in value)
    if isinstance(value, tuple):
        return tuple(_plain(each) for each in value)
    return value
