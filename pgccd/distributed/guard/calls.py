"""Public calls that all ranks make in the same order: each is reported to the hub, which compares them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

from pgccd.distributed.guard.guard import Guard

P = ParamSpec("P")
R = TypeVar("R")


def collective(method: Callable[P, R], name: str = "") -> Callable[P, R]:
    """Decorates a public call that all ranks make together.

    Args:
        method: of a `Comm`, or of an object with one as `comm`; or a function whose first argument, or argument `comm`,
            is one.
        name: for messages. Default: its qualified name.
    """
    name = name or method.__qualname__

    @functools.wraps(method)
    def call(*args: P.args, **named: P.kwargs) -> R:
        guard = _guard_of(args, named)
        if guard is None or not guard.begin_call(name):
            return method(*args, **named)
        try:
            return method(*args, **named)
        except Exception as error:
            guard.fail_call(error)
            raise
        finally:
            guard.end_call()

    return call


def _guard_of(args: tuple[Any, ...], named: dict[str, Any]) -> Guard | None:
    """That of the method's object, or of the `Comm` among the arguments; the first one may be the class."""
    for of in (*args[:2], named.get("comm")):
        guard = getattr(of, "guard", None) or getattr(getattr(of, "comm", None), "guard", None)
        if isinstance(guard, Guard):
            return guard
    return None
