"""A page that follows a belief: served on the loopback address, it shows each step once that is there.

    page = LivePage(recording)
    page.add("prior", belief, recording)
    print(page.url)

`bcppl.live.Filter.view` does this. A page gets its steps as server-sent events, by its own connection, and
what a step shows is computed in the thread of the first page that asks: `add` keeps references and returns.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, NamedTuple

from bcppl.beliefs import Belief
from bcppl.robot.arm_with_peg import ArmWithPeg
from bcppl.sensors import Recording
from bcppl.viewer.held import Steps
from bcppl.viewer.page import HEIGHT, Page, as_json, page_of

HOST = "127.0.0.1"
STALLED = 10.0  # s after which a page that does not read is left; it may ask again
QUIET = 5.0  # s without a step, after which it is looked whether a page is still there


class Given(NamedTuple):
    """What `add` was given."""

    label: str
    belief: Belief | None
    recording: Recording
    cells: Sequence[object]


class LivePage:
    """A page that follows a belief, until it is closed.

    Args:
        recording: with part, peg and truth where known.
        title: of the page.
        columns: of the table.
        arm: that holds the peg.

    Attributes:
        url: where it is; a part of it is drawn at random, and not known to other programs.

    Warns:
        RuntimeWarning: the arm's meshes cannot be read, and segments are drawn in their place.
    """

    def __init__(
        self,
        recording: Recording,
        title: str = "",
        columns: Sequence[str] = (),
        arm: ArmWithPeg | None = None,
    ) -> None:
        self._title, self._columns = title or recording.part.name, columns
        self._steps = Steps(recording, arm)
        self._given: list[Given] = []
        self._entries: list[dict[str, Any]] = []
        self._computing = threading.Lock()
        self._changed = threading.Condition()
        self._ended, self._open, self._were_open = False, 0, 0
        self.path = f"/{secrets.token_urlsafe(8)}/"
        self._server = _Server(self)
        self.url = f"http://{HOST}:{self._server.server_port}{self.path}"
        threading.Thread(target=self._server.serve_forever, name="bcppl page", daemon=True).start()

    def add(
        self, label: str, belief: Belief | None, recording: Recording, cells: Sequence[object] = ()
    ) -> None:
        """Add a step, the prior first; it returns at once.

        Args:
            label: of the step.
            belief: None where it is not known.
            recording: with the step's measurement as its last, or more.
            cells: of the table's row.
        """
        with self._changed:
            self._given.append(Given(label, belief, recording, cells))
            self._changed.notify_all()

    def page(self) -> Page:
        """The page with all steps so far, which needs no server."""
        with self._changed:
            count = len(self._given)
        return self._page(count)

    def opened(self, seconds: float) -> bool:
        """Whether a page is, or was, open; waits for one so many seconds."""
        with self._changed:
            return self._changed.wait_for(lambda: self._were_open > 0, seconds)

    def close(self, seconds: float = 5.0) -> None:
        """End: pages that are open get what is left, within so many seconds, and stay as they are."""
        with self._changed:
            if self._ended:
                return
            self._ended = True
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._open == 0, seconds)
        self._server.shutdown()
        self._server.server_close()

    def _repr_html_(self) -> str:
        """The page in a frame, for a notebook on this machine."""
        return f'<iframe style="width:100%;height:{HEIGHT}px;border:0" src="{self.url}"></iframe>'

    # ---- in the threads of pages

    def entry(self, k: int) -> str:
        """Step k as JSON, computed after those before it."""
        return as_json(self._computed(k + 1)[k])

    def html(self) -> str:
        """The page with its first step, which asks for the others."""
        return self._page(1, live=True).text

    def next(self, k: int) -> str | None:
        """Step k once it is there; "" if it is not yet after some seconds, None if it will never be."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._given) > k or self._ended, QUIET)
            if len(self._given) <= k:
                return None if self._ended else ""
        return self.entry(k)

    def count(self, pages: int) -> None:
        """Count a page that begins, 1, or ends, -1, to listen."""
        with self._changed:
            self._open += pages
            self._were_open += max(0, pages)
            self._changed.notify_all()

    def _page(self, count: int, live: bool = False) -> Page:
        entries = self._computed(count)
        with self._computing:
            head = self._steps.head(columns=self._columns)
        return page_of({**head, "live": live, "entries": entries}, self._title, "'self'" if live else "")

    def _computed(self, count: int) -> list[dict[str, Any]]:
        with self._computing:
            while len(self._entries) < count:
                number = len(self._entries)
                label, belief, recording, cells = self._given[number]
                self._entries.append(self._steps.entry(recording, number, label, belief, cells))
            return self._entries[:count]


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, page: LivePage) -> None:
        self.page = page
        super().__init__((HOST, 0), _Handler)


class _Handler(BaseHTTPRequestHandler):
    timeout = STALLED
    server: _Server

    def do_GET(self) -> None:
        page = self.server.page
        try:
            if self.path == page.path:
                self._begin("text/html; charset=utf-8")
                self.wfile.write(page.html().encode())
            elif self.path == f"{page.path}events":
                self._begin("text/event-stream")
                page.count(1)
                try:
                    self._follow(page)
                finally:
                    page.count(-1)
            else:
                self.send_error(404)
        except OSError:
            pass  # it was closed, or has stalled

    def _begin(self, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.end_headers()

    def _follow(self, page: LivePage) -> None:
        """Send steps as they come, after the one that the page has already."""
        last = self.headers.get("Last-Event-ID", "")
        k = int(last) + 1 if last.isdecimal() and len(last) < 9 else 1
        while (text := page.next(k)) is not None:
            self.wfile.write(f"id: {k}\ndata: {text}\n\n".encode() if text else b":\n\n")
            k += bool(text)
        self.wfile.write(b"event: end\ndata:\n\n")

    def log_message(self, *_: object) -> None:
        """Nothing: who reads is no news."""
