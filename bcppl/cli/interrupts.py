"""Ends that are asked for from outside: SIGTERM and SIGHUP are taken for Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def ended_like_an_interrupt() -> Iterator[None]:
    """Within it a process that a service manager or a closed terminal ends is interrupted."""
    if threading.current_thread() is not threading.main_thread():  # no other may set handlers
        yield
        return
    names = [name for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]

    def interrupt(*_: Any) -> None:
        signal.raise_signal(signal.SIGINT)

    before = {number: signal.signal(number, interrupt) for number in (getattr(signal, n) for n in names)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
