"""`help()` of every public function and class names each argument, with the shape of tensors and the errors."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import pytest

import pgccd
from pgccd import about, baselines, broad, distributed, files, narrow, robots, sim, simulators, traverse, viz

PACKAGES = (
    pgccd,
    about,
    baselines,
    broad,
    distributed,
    files,
    narrow,
    robots,
    sim,
    simulators,
    traverse,
    viz,
)
# What users call with values of their own: their errors are documented.
WITH_ERRORS = (pgccd, broad, files, narrow, robots, simulators, traverse)
SHAPE = re.compile(r"\((?:\.\.\., |)[A-Za-z0-9_+\-−×* ]+,[^)]*\)|same shape|every column")


def public(packages: Iterable[Any]) -> Iterator[tuple[str, Any]]:
    """Functions and classes with their methods, each once."""
    found: dict[Any, str] = {}
    for package in packages:
        for name in package.__all__:
            value = getattr(package, name)
            if inspect.isclass(value) or inspect.isfunction(value):
                found.setdefault(value, f"{package.__name__}.{name}")
    for value, name in found.items():
        yield name, value
        if inspect.isclass(value):
            yield from ((f"{name}.{method}", function) for method, function in methods(value))


def methods(owner: type) -> Iterator[tuple[str, Callable[..., Any]]]:
    for name, value in vars(owner).items():
        function = value.__func__ if isinstance(value, (classmethod, staticmethod)) else value
        if not name.startswith("_") and inspect.isfunction(function):
            yield name, getattr(owner, name)


def arguments_of(function: Any) -> list[inspect.Parameter]:
    """Those that a caller gives. Objects that the library makes are not constructed by users."""
    text = function.__doc__ or ""
    is_made = re.search(r"[Mm]ade\s+by|Raised|Attributes:", text) and "Args:" not in text
    if inspect.isclass(function) and is_made:
        return []
    try:
        parameters = inspect.signature(function).parameters.values()
    except ValueError:
        return []
    variadic = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    named = [each for each in parameters if each.kind not in variadic]
    return [each for each in named if each.name != "self" and not each.name.startswith("_")]


@pytest.mark.parametrize(("name", "function"), [pytest.param(*each, id=each[0]) for each in public(PACKAGES)])
def test_arguments_are_in_the_help(name: str, function: Any) -> None:
    text = inspect.getdoc(function) or ""
    assert text, f"{name} has no docstring"
    given = arguments_of(function)
    assert [each.name for each in given if not re.search(rf"\b{each.name}\b", text)] == []
    tensors = [each.name for each in given if re.fullmatch(r"(torch\.)?Tensor( \| None)?", str(each.annotation))]
    assert not tensors or SHAPE.search(text), f"{name}: no shape of {', '.join(tensors)}"


@pytest.mark.parametrize(("name", "function"), [pytest.param(*each, id=each[0]) for each in public(WITH_ERRORS)])
def test_errors_are_in_the_help(name: str, function: Any) -> None:
    if arguments_of(function):
        text = inspect.getdoc(function) or ""
        assert "Raises:" in text or "othing is checked" in text, f"{name} does not say which errors it raises"
