"""CUDA events, and waiting for a GPU."""

import contextlib
import threading

import torch


def record_event(timed: bool = False, sleep: bool = False) -> torch.cuda.Event:
    """Records an event on the current stream of the current device.

    Args:
        timed: whether the event is used for timing.
        sleep: whether a thread that waits for it sleeps. Otherwise it spins, which reacts some microseconds sooner.
    """
    event = torch.cuda.Event(enable_timing=timed, blocking=sleep)
    # Given the device's index, torch finds its stream in a quarter of the time. A step records some 40 events.
    event.record(torch.cuda.current_stream(torch.cuda.current_device()))
    return event


def gpu_finishes_within(seconds: float, device: torch.device | int | None = None) -> bool:
    """Waits until a device has finished all work of this process, or reports an error. False: neither, after `seconds`.

    Args:
        seconds: the longest time to wait.
        device: default: the current one.
    """
    device = torch.cuda.current_device() if device is None else device

    def wait() -> None:
        with contextlib.suppress(Exception):  # the next call of CUDA reports it too
            torch.cuda.synchronize(device)

    # In a thread, because CUDA's waiting has no time-out.
    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    thread.join(seconds)
    return not thread.is_alive()
