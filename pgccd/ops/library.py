"""The compiled operators, and the decorators that wrap them; no other module uses torch.ops."""

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from pgccd._requirements import operators_do_not_load

try:
    import pgccd._C as _C  # importing it registers the operators
except ImportError as error:
    raise operators_do_not_load(error) from error

operators = torch.ops.pgccd

#: Moving bodies: the operators' arguments `mesh_set`, `bodies` and `linear_path`, the last None if the bodies deform.
Bodies = tuple[list[Tensor], list[Tensor], bool | None]
P = ParamSpec("P")
R = TypeVar("R")


def operator(fake: Callable[P, R]) -> Callable[P, R]:
    """Turns a function into a wrapper of the compiled operator of its name (without a leading underscore). The
    function's own body becomes the operator's fake kernel: it returns outputs with shapes and dtypes, but without data,
    for `torch.compile` and `torch.export`.
    """
    name = fake.__name__.lstrip("_")
    torch.library.register_fake(f"pgccd::{name}", fake)

    @wraps(fake)
    def call(*arguments: P.args, **named: P.kwargs) -> Any:
        return getattr(operators, name).default(*arguments, **named)  # the only overload: none is looked for

    return call


def operator_of_bodies(fake: Callable[P, R]) -> Callable[P, R]:
    """As `operator`, for a pair of operators NAME_rigid and NAME_deforming, which do the same for the two kinds of
    bodies. The first argument of the function is `Bodies`.
    """
    rigid, deforming = (f"{fake.__name__}_{kind}" for kind in ("rigid", "deforming"))
    make: Callable[..., Any] = fake
    torch.library.register_fake(f"pgccd::{rigid}", lambda *three, **named: make(three[:3], *three[3:], **named))
    torch.library.register_fake(f"pgccd::{deforming}", lambda *two, **named: make((*two[:2], None), *two[2:], **named))

    @wraps(fake)
    def call(*arguments: P.args, **named: P.kwargs) -> Any:
        given: Any = arguments
        (mesh_set, tensors, linear_path), *rest = given
        if linear_path is None:
            return getattr(operators, deforming).default(mesh_set, tensors, *rest, **named)
        return getattr(operators, rigid).default(mesh_set, tensors, linear_path, *rest, **named)

    return call


def on_contiguous(wrapper: Callable[P, R]) -> Callable[P, R]:
    """Makes the positional arguments of an operator, tensors and lists of tensors, contiguous."""

    @wraps(wrapper)
    def call(*arguments: P.args, **named: P.kwargs) -> Any:
        given: Any = list(arguments)
        for place, each in enumerate(given):
            given[place] = each.contiguous() if isinstance(each, Tensor) else list(map(Tensor.contiguous, each))
        return wrapper(*given, **named)

    return call


def int64(like: Tensor, *shape: int | torch.SymInt) -> Tensor:
    """An int64 tensor without data, for fake kernels."""
    return like.new_empty(shape, dtype=torch.int64)


def float64(like: Tensor, *shape: int | torch.SymInt) -> Tensor:
    """A float64 tensor without data, for fake kernels."""
    return like.new_empty(shape, dtype=torch.float64)


def unknown_count() -> torch.SymInt:
    """A number of rows that depends on data, for fake kernels."""
    return torch.library.get_ctx().new_dynamic_size(min=0)


def build_information() -> dict[str, str]:
    """Of this build: version, commit, digest of the C++ sources, compiler, CUDA and CUDA architectures."""
    return _C.build_information()


def set_device_share(share: int) -> int:
    """Lets operators called by this thread take 1 / share of a GPU's blocks, 1 <= share <= 1024, where kernels of
    another stream run at the same time and have more to do. Results do not depend on it. Returns the former share.
    """
    former: int = _C.set_device_share(share)
    return former


def take_scratch_peak() -> int:
    """Peak scratch memory in bytes of one GPU operator on this thread since the last call."""
    return _C.take_scratch_peak()
