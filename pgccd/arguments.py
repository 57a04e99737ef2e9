"""Argument checks: each raises a TypeError or ValueError whose message starts with the argument's name."""

from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad


def number(value: Any, name: str, expected: str = "a number") -> float:
    """The value as a float. Accepts a Python or NumPy number or a tensor with one element, but not a bool."""
    if isinstance(value, Tensor) and value.dim() == 0 and not value.dtype.is_complex and value.dtype != torch.bool:
        refuse_transforms(value, name)
        refuse_gradient(value, name)
        refuse_meta(value, name)
        value = value.item()
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, float, np.floating, np.integer)):
        raise TypeError(f"{name}: expected {expected}, got {describe(value)}")
    try:
        return float(value)
    except OverflowError as error:
        raise ValueError(f"{name}: expected {expected}, got an integer beyond the largest float64") from error


# Squares of larger lengths overflow.
LONGEST = 1e150
#: The values of a length, in words.
LENGTH = f"a finite length >= 0, at most {LONGEST:g}"


def length(value: Any, name: str) -> float:
    """The value as a float, if it is a length in [0, 1e150]."""
    result = value if type(value) is float else number(value, name, LENGTH)
    if not 0.0 <= result <= LONGEST:
        raise ValueError(f"{name}: expected {LENGTH}, got {result}")
    return result


# The largest integer that operators and columns of int64 hold.
_LARGEST_INTEGER = 2**63 - 1


def integer(value: Any, name: str, lowest: int, expected: str) -> int:
    """The value as an int, if it is an integer (no bool), not less than `lowest` and below 2^63."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"{name}: expected {expected}, got {describe(value)}")
    if value < lowest:
        raise ValueError(f"{name}: expected {expected}, got {describe(value)}")
    if value > _LARGEST_INTEGER:
        raise ValueError(f"{name}: expected {expected}, below 2^63, got {describe(value)}")
    return int(value)


def flag(value: Any, name: str, expected: str = "True or False") -> bool:
    """The value as a bool. Accepts only bool."""
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{name}: expected {expected}, got {describe(value)}")
    return bool(value)


def choice(value: Any, name: str, choices: Iterable[str]) -> None:
    """Raises unless the value is one of `choices`."""
    if not isinstance(value, str) or value not in choices:
        error = ValueError if isinstance(value, str) else TypeError
        raise error(f"{name}: expected one of {list(choices)}, got {describe(value)}")


def instance(value: Any, name: str, *kinds: type) -> None:
    """Raises TypeError unless the value is of one of these classes of `pgccd`."""
    if not isinstance(value, kinds):
        *others, last = (kind.__name__ for kind in kinds)
        expected = " or ".join([", ".join(others), last] if others else [last])
        raise TypeError(f"{name}: expected a pgccd.{expected}, got {describe(value)}")


def dtype_name(dtype: torch.dtype) -> str:
    """The name of a dtype, such as "float64"."""
    return str(dtype).removeprefix("torch.")


def describe(value: Any) -> str:
    """A short description of a value for an error message."""
    if isinstance(value, Tensor):
        return f"a {dtype_name(value.dtype)} tensor of shape {tuple(value.shape)}"
    if isinstance(value, (int, np.integer)) and not -(2**64) <= int(value) <= 2**64:
        return f"an integer of {int(value).bit_length()} bits"
    if value is None or isinstance(value, (bool, int, float, complex, np.integer)):
        return str(value)
    if isinstance(value, str):
        return repr(value if len(value) <= 40 else value[:37] + "...")
    return type(value).__name__


def device(value: Any, name: str = "device") -> torch.device:
    """The value as a `torch.device` that is there."""
    if not isinstance(value, (str, torch.device)):
        raise TypeError(f'{name}: expected a torch.device or its name, such as "cuda", got {describe(value)}')
    try:
        chosen = torch.device(value)
    except RuntimeError as error:
        raise ValueError(f'{name}: expected a torch.device or its name, such as "cuda", got {value!r}') from error
    if chosen.type == "cuda":
        count = torch.cuda.device_count()
        if (chosen.index or 0) >= count:
            raise ValueError(f"{name}: {chosen} is not available: torch sees {count} CUDA devices")
    return chosen


def path(value: Any, name: str) -> Path:
    """The value as a file system path."""
    if not isinstance(value, (str, PathLike)) or not str(value):
        raise TypeError(f"{name}: expected a path, got {describe(value)}")
    return Path(value)


def body_names(names: Any, count: int) -> list[str]:
    """The values as names of so many bodies."""
    if isinstance(names, str) or not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise TypeError(f"names: expected a list of strings, one per body, got {describe(names)}")
    if len(names) != count:
        raise ValueError(f"names: expected {count} strings, one per body, got {len(names)}")
    for body, name in enumerate(names):
        try:
            name.encode()
        except UnicodeEncodeError as error:
            raise ValueError(f"names: body {body}: expected text, got {name!r}: {error.reason}") from error
    return list(names)


def rows(value: Any, name: str, count: int) -> Any:
    """An index of some of `count` rows: a mask, row numbers or a slice, but not a single number.

    Raises:
        IndexError: a number is out of range (values on a CPU; a GPU asserts).
    """
    if isinstance(value, slice):
        if isinstance(value.step, int) and value.step < 1:
            raise ValueError(f"{name}: expected a slice with a step >= 1, got {value.step}")
        return value
    expected = "a mask, row numbers or a slice"
    value = as_tensor(value, name)
    if not isinstance(value, (Tensor, np.ndarray, list)):
        raise TypeError(f"{name}: expected {expected}, got {describe(value)}")
    try:
        picked = torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"{name}: expected {expected}, got {describe(value)}: {error}") from error
    if picked.numel() == 0 and not isinstance(value, Tensor):
        picked = picked.long()
    if picked.dtype.is_floating_point or picked.dtype.is_complex or picked.layout != torch.strided:
        raise TypeError(f"{name}: expected {expected}, got {describe(picked)}")
    is_mask = picked.dtype == torch.bool
    if picked.dim() != 1 or (is_mask and len(picked) != count):
        shape = f"({count},)" if is_mask else "(K,)"
        raise ValueError(f"{name}: expected shape {shape}, got {tuple(picked.shape)}")
    if is_mask or picked.device.type == "meta":
        return picked
    picked = picked.long()
    if picked.device.type == "cpu" and bool(((picked < -count) | (picked >= count)).any()):
        raise IndexError(f"{name}: expected numbers of {count} rows, got {int(picked.min())} to {int(picked.max())}")
    return picked


def real_numbers(values: Any, name: str, expected: str, with_gradient: bool = False) -> Tensor:
    """Numbers (float32, float64 or integers: one, a list, an array or a tensor) as a float64 tensor on their device. A
    Python float keeps all its digits. Memory of float64 is shared.

    Args:
        with_gradient: whether values may require grad; the result then does.
    """
    values = as_tensor(values, name)
    try:
        given = torch.as_tensor(values)
        # Lists of floats have the default dtype, which may be float16; their digits are read below.
        dtype = given.dtype if hasattr(values, "dtype") or not given.is_floating_point() else torch.float64
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise TypeError(f"{name}: expected {expected}, got {describe(values)}") from error
    if dtype.is_complex or dtype == torch.bool or (dtype.is_floating_point and dtype.itemsize < 4):
        raise TypeError(f"{name}: expected {expected}, got {dtype_name(dtype)}")
    numbers = torch.as_tensor(values, dtype=torch.float64)  # without the dtype, lists of floats would be float32
    if numbers.layout != torch.strided:
        raise TypeError(f"{name}: expected a dense tensor, got {numbers.layout}")
    refuse_meta(numbers, name)
    refuse_transforms(numbers, name)
    if with_gradient and is_differentiated(numbers):
        return numbers
    refuse_gradient(numbers, name)
    return numbers.detach()


def refuse_meta(values: Tensor, name: str) -> None:
    """Raises for a tensor without values."""
    if values.is_meta:
        raise TypeError(f"{name}: expected values, got a tensor on the device meta")


def refuse_transforms(values: Tensor, name: str) -> None:
    """Raises for a tensor in a transform of `torch.func`, or with a tangent of forward differentiation, because
    operators would drop the samples or the tangent.
    """
    if torch.compiler.is_compiling():
        return
    if torch._C._functorch.is_functorch_wrapped_tensor(values):
        if torch._C._functorch.is_batchedtensor(values):
            raise TypeError(
                f"{name}: torch.vmap is not supported: pass all samples in one call (bodies as one scene, each sample "
                "in a `world` of its own; queries as rows)"
            )
        raise TypeError(
            f"{name}: transforms of torch.func are not supported: use torch.autograd.grad or Tensor.backward"
        )
    if forward_ad._current_level >= 0 and forward_ad.unpack_dual(values).tangent is not None:
        raise TypeError(f"{name}: has a tangent, but forward differentiation is not supported: use backward")


def is_differentiated(values: Any) -> bool:
    """Whether the values require grad while gradients are enabled."""
    return isinstance(values, Tensor) and values.requires_grad and torch.is_grad_enabled()


def refuse_gradient(values: Tensor, name: str) -> None:
    """Raises if the values require grad while gradients are enabled."""
    if values.requires_grad and torch.is_grad_enabled():
        raise ValueError(
            f"{name}: requires grad, but no gradient is computed here: pass {name}.detach(), or call this under "
            "torch.no_grad()"
        )


def as_tensor(values: Any, name: str) -> Any:
    """An array of another library (CuPy, JAX, Warp, ...) as a tensor that shares its memory, by DLPack or by
    `__cuda_array_interface__`; other values, also arrays of NumPy, as they are.

    Raises:
        TypeError: torch cannot share the array.
        ValueError: it takes part in the differentiation of another library.
    """
    if isinstance(values, (Tensor, np.ndarray)) or torch.compiler.is_compiling():
        return values
    has_dlpack = hasattr(type(values), "__dlpack__")
    if not has_dlpack and not hasattr(type(values), "__cuda_array_interface__"):
        return values
    if getattr(values, "requires_grad", False) is True:  # of Warp
        raise ValueError(f"{name}: requires grad in another library: convert it to a tensor of torch, or detach it")
    try:
        return torch.from_dlpack(values) if has_dlpack else torch.as_tensor(values)
    except (TypeError, ValueError, RuntimeError, BufferError) as error:
        raise TypeError(f"{name}: torch cannot share this {type(values).__name__}: {error}") from error


def _of_numpy(values: np.ndarray, name: str) -> Tensor:
    """A tensor that shares the memory of the array, if that may be written."""
    try:
        return torch.from_numpy(values if values.flags.writeable else values.copy())
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name}: expected float32 or float64, got an array of {values.dtype}: {error}") from error


def is_float32(values: object) -> bool:
    """Whether the values are a tensor or an array of float32."""
    return str(getattr(values, "dtype", "")).endswith("float32")


def real_tensor(values: Any, name: str) -> Tensor:
    """The values, a dense float32 or float64 tensor, or an array as such a tensor, without a copy (see `as_tensor`)."""
    if not isinstance(values, Tensor):
        values = _of_numpy(values, name) if isinstance(values, np.ndarray) else as_tensor(values, name)
    if not isinstance(values, Tensor):
        hint = ": pass torch.tensor(values, dtype=torch.float64)" if isinstance(values, (list, tuple)) else ""
        raise TypeError(f"{name}: expected a float32 or float64 tensor, got {describe(values)}{hint}")
    refuse_transforms(values, name)
    if values.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"{name}: expected float32 or float64, got {values.dtype}")
    if values.layout != torch.strided:
        raise TypeError(f"{name}: expected a dense tensor, got {values.layout}")
    return values


def shape(values: Tensor, name: str, expected: Sequence[int | str], device: torch.device | None = None) -> None:
    """Raises ValueError unless the tensor has this shape, in which a letter stands for any number, on this device."""
    alike = len(expected) == values.dim()
    if not alike or any(isinstance(n, int) and n != size for n, size in zip(expected, values.shape, strict=True)):
        lengths = ", ".join(map(str, expected)) + "," * (len(expected) == 1)
        raise ValueError(f"{name}: expected shape ({lengths}), got {tuple(values.shape)}")
    if device is not None and values.device != device:
        raise ValueError(f"{name}: expected device {device}, got {values.device}")


def real_rows(
    values: Any, name: str, count: int | None, width: int, device: torch.device | None, with_gradient: bool = False
) -> Tensor:
    """The values as contiguous float64 rows (count, width) on the device. None: any number of rows, or any device.

    Args:
        with_gradient: whether they may require grad; the result then does.
    """
    values = real_tensor(values, name)
    fits = values.dim() == 2 and values.shape[1] == width and (count is None or values.shape[0] == count)
    if not fits or (device is not None and values.device != device):  # compared here, since `shape` takes longer
        shape(values, name, ("N" if count is None else count, width), device)
    if values.dtype == torch.float64 and not values.requires_grad and values.is_contiguous():
        return values  # the common case; converting anyway takes a tenth of a `detect` call for two bodies
    if with_gradient and is_differentiated(values):
        return values.to(torch.float64).contiguous()
    refuse_gradient(values, name)
    return values.detach().to(torch.float64).contiguous()


def entries(state: Any, names: Iterable[str], argument: str = "state") -> None:
    """Raises unless the state is a dictionary with exactly these names."""
    names = list(names)
    if not isinstance(state, dict):
        raise TypeError(f"{argument}: expected a dictionary from state_dict, got {describe(state)}")
    for name in names:
        if name not in state:
            raise ValueError(f"{argument}: has no entry {name!r}")
    for name in state:
        if name not in names:
            raise ValueError(f"{argument}: expected entries {names}, got {name!r}")


def check_corners(points: np.ndarray, faces: np.ndarray) -> None:
    """Raises ValueError unless vertices (V, 3) are finite and faces (F, 3) are valid vertex indices."""
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        first = int(np.argmin(finite))
        raise ValueError(f"vertices: vertex {first} is not finite: {points[first].tolist()}")
    out_of_range = ((faces < 0) | (faces >= len(points))).any(axis=1)
    if out_of_range.any():
        first = int(np.argmax(out_of_range))
        raise ValueError(f"faces: face {first} is {faces[first].tolist()}, but there are {len(points)} vertices")
