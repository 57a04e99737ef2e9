"""Errors in threads of Gloo, which would abort the process: a message is longer than expected, because another rank
calls something else. The thread is stopped until the hub has compared the calls, so that all ranks raise its verdict.
"""

from __future__ import annotations

import ctypes
import threading
import time

# Time for a verdict, without which the process is aborted; and for the process to end after it.
_VERDICT_SECONDS, _END_SECONDS = 3.0, 60.0
_HANDLER = ctypes.CFUNCTYPE(None)

#: Set once this process has a final verdict.
has_verdict = threading.Event()
#: Whether a thread is stopped, so that a regular shutdown would wait for it.
is_stopped = threading.Event()
_lock = threading.Lock()
_former: list[ctypes._FuncPointer] = []


def catch_errors_of_threads() -> None:
    """Stops a thread whose C++ exception nothing catches, instead of ending the process at once."""
    with _lock:
        if _former:
            return
        try:
            set_handler = ctypes.CDLL("libstdc++.so.6")["_ZSt13set_terminatePFvvE"]
        except (OSError, AttributeError):  # another C++ library: such errors end the process
            return
        set_handler.restype = ctypes.c_void_p
        _former.append(_HANDLER(set_handler(_stop)))


@_HANDLER
def _stop() -> None:
    if threading.current_thread() is not threading.main_thread():
        is_stopped.set()
        if has_verdict.wait(_VERDICT_SECONDS):
            time.sleep(_END_SECONDS)
    _former[0]()
