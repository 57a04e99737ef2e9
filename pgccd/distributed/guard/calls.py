"""Public calls that all ranks make in the same order: each is told to the hub, which compares them."""

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
        given: tuple[Any, ...] = (named.get("comm"), *args[:2])  # a class method's first argument is the class
        guards = (getattr(getattr(of, "comm", of), "guard", None) for of in given)
        guard = next((guard for guard in guards if isinstance(guard, Guard)), None)
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
