"""Times at which motions are evaluated."""

import torch
from torch import Tensor

from pgccd import arguments


def broadcast_times(t: Tensor | float, count: int, device: torch.device) -> Tensor:
    """`t` as (..., count) float64.

    Raises:
        TypeError, ValueError: `t` is not real, has the wrong shape, or is outside of [0, 1].
    """
    time = t if isinstance(t, Tensor) else torch.tensor(t, dtype=torch.float64)
    if time.is_complex() or time.dtype == torch.bool:
        raise TypeError(f"t: expected times, got {time.dtype}")
    arguments.refuse_gradient(time, "t")
    time = time.detach().to(device=device, dtype=torch.float64)
    try:
        shape = torch.broadcast_shapes(time.shape, (count,))
    except RuntimeError:
        shape = torch.Size()
    if shape[-1:] != (count,):
        expected = f"a number, ({count},), (T, 1) or (T, {count})"
        raise ValueError(f"t: expected {expected}, got {tuple(time.shape)}; for T times of all, pass t[:, None]")
    is_inside = ((time >= 0.0) & (time <= 1.0)).all()
    message = "t: expected times in [0, 1]"
    if time.device.type != "cpu":
        torch._assert_async(is_inside, message)
    elif not bool(is_inside):
        raise ValueError(message)
    return time.expand(shape)
