"""The one thread in which a live filter runs all that it is asked for, in order."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from typing import TypeVar

from bcppl.errors import InputError

CLOSED = "the live filter is closed; begin another with its recording."

T = TypeVar("T")


class Worker:
    """A thread that runs what it is given, in order."""

    def __init__(self) -> None:
        self._ident: int | None = None
        self._pool = ThreadPoolExecutor(1, "bcppl live", self._begin)

    @property
    def inside(self) -> bool:
        """Whether the caller runs in this thread."""
        return threading.get_ident() == self._ident

    def submit(self, what: Callable[[], T]) -> Future[T]:
        """What will be there once the thread has come to it.

        Raises:
            InputError: the filter is closed.
        """
        try:
            return self._pool.submit(what)
        except RuntimeError as error:
            raise InputError(CLOSED) from error

    def run(self, what: Callable[[], T], timeout: float | None) -> T:
        """The result of what is run in the thread; what has not begun after `timeout` seconds never is.

        Raises:
            TimeoutError: it takes longer.
            InputError: the filter is closed, before or meanwhile.
        """
        asked = self.submit(what)
        try:
            return asked.result(timeout)
        except CancelledError as error:
            raise InputError(CLOSED) from error
        finally:
            asked.cancel()

    def close(self) -> None:
        """End the thread after what it runs now; what waits is cancelled."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _begin(self) -> None:
        self._ident = threading.get_ident()
