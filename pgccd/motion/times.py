"""Times at which motions are evaluated."""

import torch
from torch import Tensor

from pgccd import arguments


def fractions_of(fraction: Tensor | float, count: int, device: torch.device) -> Tensor:
    """`fraction` as (count,) float64.

    Raises:
        TypeError, ValueError: it is not real, has the wrong shape, or is outside of [0, 1].
    """
    made = broadcast_times(fraction, count, device, "fraction")
    if made.dim() != 1:
        raise ValueError(f"fraction: expected a number or ({count},), got {tuple(made.shape)}")
    return made


def broadcast_times(
    t: Tensor | float, count: int, device: torch.device, name: str = "t", with_gradient: bool = False
) -> Tensor:
    """`t` as (..., count) float64.

    Args:
        with_gradient: whether `t` may require grad; the result then does.

    Raises:
        TypeError, ValueError: `t` is not real, has the wrong shape, or is outside of [0, 1].
    """
    if isinstance(t, (int, float)) and not isinstance(
        t, bool
    ):  # no copy from the host, which a CUDA graph cannot capture
        if not 0.0 <= t <= 1.0:
            raise ValueError(f"{name}: expected times in [0, 1], got {t}")
        return torch.full((count,), t, dtype=torch.float64, device=device)
    time = arguments.real_numbers(t, name, "times in [0, 1]", with_gradient).to(device)
    # Not torch.broadcast_shapes, which imports sympy: a second of processor time.
    if time.shape[-1:] not in ((), (1,), (count,)):
        expected = f"a number, ({count},), (T, 1) or (T, {count})"
        raise ValueError(f"{name}: expected {expected}, got {tuple(time.shape)}; for T times of all, pass t[:, None]")
    is_inside = (time >= 0.0) & (time <= 1.0)
    if time.device.type != "cpu":
        torch._assert_async(is_inside.all(), f"{name}: expected times in [0, 1]")
    elif not bool(is_inside.all()):
        raise ValueError(f"{name}: expected times in [0, 1], got {time[~is_inside][0].item()}")
    return time.expand(*time.shape[:-1], count)
