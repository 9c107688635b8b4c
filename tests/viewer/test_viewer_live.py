"""A page that follows a belief: it moves along while steps are added, and holds nothing up."""

from __future__ import annotations

import dataclasses
import json
import re
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bcppl.inference.live import Filter
from bcppl.models.point_probe import model
from bcppl.viewer import LivePage
from tests.command_line import Ran, short
from tests.few_moves import infer
from tests.viewer.browser import SPACE, Browser, coloured, in_browser
from tests.viewer.test_viewer import PEG, many

Event = tuple[str, dict[str, Any] | None]


def events(url: str, last: int | None = None) -> Iterator[Event]:
    """Events of a page: (id, content), and at the end ("end", None)."""
    request = urllib.request.Request(
        f"{url}events", headers={} if last is None else {"Last-Event-ID": str(last)}
    )
    with urllib.request.urlopen(request, timeout=20.0) as stream:
        of = ""
        for line in stream:
            name, _, value = line.decode().rstrip("\n").partition(": ")
            if name == "id":
                of = value
            elif name == "event":
                yield value, None
            elif name == "data" and value:
                yield of, json.loads(value)


@pytest.fixture
def following() -> Iterator[tuple[LivePage, Callable[[], None]]]:
    """A page of two views and touches that shows the prior, and what adds its next step."""
    recording, history = many(particles=20, touches=4)
    page = LivePage(recording, "followed", ["measurement"])
    left = iter(history)

    def more() -> None:
        label, belief = next(left)
        page.add(label, belief, recording, [label])

    more()
    yield page, more
    page.close()


def test_a_page_gets_each_step_once_and_goes_on_after_the_last_that_it_has(following: Any) -> None:
    page, more = following
    more()
    more()
    stream = events(page.url)
    assert [next(stream)[0] for _ in range(2)] == ["1", "2"]
    more()
    of, entry = next(stream)
    assert (
        of == "3"
        and entry is not None
        and entry["label"] == "step 3"
        and entry["measurement"]["body"] == "peg"
    )
    assert next(events(page.url, last=2))[0] == "3"
    threading.Thread(target=page.close).start()
    assert next(stream) == ("end", None)
    held = re.search(r'id="data">(.*?)</script>', page.page().text)
    assert held is not None and len(json.loads(held[1])["entries"]) == 4


def test_only_who_knows_the_address_reads_and_the_page_reaches_nobody_else(following: Any) -> None:
    page, _ = following
    assert page.url.startswith("http://127.0.0.1:")
    for wrong in (page.url.replace(page.path, "/"), page.url.replace(page.path, "/events"), f"{page.url}x"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(wrong)
    text = urllib.request.urlopen(page.url).read().decode()
    assert "default-src 'none'" in text and "connect-src 'self'" in text
    assert "connect-src" not in page.page().text


def test_pages_that_stall_or_are_closed_hold_nothing_up(following: Any) -> None:
    page, more = following
    port = page._server.server_port
    stalled = []
    for _ in range(5):
        one = socket.create_connection(("127.0.0.1", port))
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
        one.sendall(f"GET {page.path}events HTTP/1.0\r\n\r\n".encode())  # and reads nothing
        stalled.append(one)
    assert page.opened(5.0)
    gone = events(page.url)
    more()
    next(gone)
    gone.close()
    began = time.monotonic()
    for _ in range(4):
        more()
    assert time.monotonic() - began < 0.05
    assert len(list(zip(range(5), events(page.url), strict=False))) == 5
    for one in stalled:
        one.close()


def test_a_filter_shows_what_it_assimilates_from_the_call_on() -> None:
    recording = short(3)
    empty = dataclasses.replace(recording, measurements=[])
    with Filter(model, empty, infer=infer, particles=20, deadline=1e3) as live:
        one, *others = recording.measurements
        live.observe(one.action, one.observation)
        live.settle()
        page = live.view()
        for each in others:
            live.observe(each.action, each.observation)
        mean = live.settle().belief.mean
        held = page._computed(4)
    assert [entry["label"] for entry in held] == ["prior", "push 1", "push 2", "push 3"]
    assert [entry["step"]["particles"] for entry in held] == [0, 20, 20, 20]
    assert [entry["cells"][0] for entry in held] == [entry["label"] for entry in held]
    assert np.abs(held[3]["step"]["mean"] - mean.numpy()).max() < 1e-6
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(page.url)  # it ends with the filter


@in_browser
def test_the_page_moves_along_where_its_slider_is_at_the_end(following: Any, tmp_path: Path) -> None:
    page, more = following
    with Browser(page.url, tmp_path / "profile") as browser:
        browser.state({"live": "live", "step": "0", "particles": "20"})
        for _ in range(2):
            more()
        browser.state({"step": "2", "peg": "false"})
        looked = browser.picture()
        for _ in range(3):
            more()
        touched = browser.state({"step": "5", "label": "step 5", "peg": "true"})
        felt = browser.picture()
        assert touched["gl"] == "true"
        assert coloured(looked, PEG, SPACE) < 200 < coloured(felt, PEG, SPACE)
        browser.evaluated("toStep(1)")
        more()
        browser.state({"step": "1"})
        assert browser.evaluated("[labels.length, element('step').max].join()") in ("6,5", "7,6")
        page.close()
        browser.state({"live": "ended", "step": "1"})
        assert browser.evaluated("[labels.length, element('step').max].join()") == "7,6"
        assert browser.evaluated("document.querySelectorAll('tbody tr').length") == 7
        browser.evaluated("toStep(6)")  # all is there without the server
        browser.state({"step": "6", "peg": "true"})


def test_the_command_line_follows_and_saves_the_page(
    bcppl: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch
) -> None:
    from bcppl.recordings import save

    save(short(2), "short.h5")
    asked: list[str] = []
    seen: list[Event] = []

    def opened(url: str) -> bool:
        asked.append(url)
        reading = threading.Thread(target=lambda: seen.extend(events(url)))
        reading.start()
        return True

    monkeypatch.setattr("webbrowser.open", opened)
    few = [
        "--inference",
        str(Path(__file__).parents[1] / "few_moves.py"),
        "--particles",
        "10",
        "--speed",
        "100",
    ]
    ran = bcppl("live", "short.h5", *few, "--view", "--save", "page.html")
    assert ran.code == 0 and f"follow at {asked[0]}" in ran.out, ran.err
    assert [of for of, _ in seen] == ["1", "2", "end"]
    assert '"label": "push 2"' in Path("page.html").read_text()
    for words, sentence in (
        (["--robot", "panda"], "add --view or --save"),
        (["--save", "no/page.html"], "there is no folder no"),
    ):
        ran = bcppl("live", "short.h5", *words)
        assert ran.code == 2 and sentence in ran.err and ran.err.count("\n") == 1
