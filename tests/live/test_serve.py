"""A live belief on a socket: no client holds up another, and nothing that is sent is more than data."""

from __future__ import annotations

import asyncio
import socket
import struct
import threading
import tracemalloc
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from bcppl.errors import InferenceError, InputError
from bcppl.inference import guided_smc
from bcppl.inference.live import Filter, server, wire
from bcppl.inference.live.client import Client
from bcppl.inference.live.server import Server
from bcppl.inference.live.session import Session
from bcppl.models import load_recording, peg_in_hole
from bcppl.models.look_and_touch import model
from bcppl.robot.plan import InsertionPlan, Plan
from bcppl.sensors import ProbeWindow, Recording


class Echo:
    """A session that answers at once."""

    def answer(self, request: Mapping[str, Any]) -> dict[str, Any]:
        return {"asked": request["ask"]}


@contextmanager
def serving(session: Any) -> Iterator[Server]:
    """A server in a thread of its own."""
    served, ready, stopped = Server(session, token="secret"), threading.Event(), asyncio.Event()
    loops: list[asyncio.AbstractEventLoop] = []

    async def run() -> None:
        async with await served.listen():
            loops.append(asyncio.get_running_loop())
            ready.set()
            await stopped.wait()

    thread = threading.Thread(target=lambda: asyncio.run(run()))
    thread.start()
    assert ready.wait(10.0)
    try:
        yield served
    finally:
        loops[0].call_soon_threadsafe(stopped.set)
        thread.join(20.0)
        assert not thread.is_alive()


def test_a_client_that_has_waited_too_long_asks_no_more() -> None:
    released = threading.Event()

    class Slow(Echo):
        def answer(self, request: Mapping[str, Any]) -> dict[str, Any]:
            released.wait(10.0)
            return super().answer(request)

    with serving(Slow()) as served, Client(*served.address, "secret") as client:
        client._socket.settimeout(0.05)
        with pytest.raises(InputError, match="does not answer"):
            client.ask("one")
        released.set()
        with pytest.raises(InputError, match="the connection is closed"):
            client.ask("two")


def test_an_empty_token_is_refused() -> None:
    with pytest.raises(InputError, match="the token is empty"):
        Server(Session.__new__(Session), token="")


def answer_of(raw: socket.socket) -> dict[str, Any]:
    raw.settimeout(5.0)
    data = b""
    while more := raw.recv(4096):
        data += more
    return wire.unpacked(data[4:]) if data else {}


def test_clients_that_stall_or_send_garbage_or_know_no_token_hold_up_nobody(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(server, "STALLED", 0.5)
    with serving(Echo()) as served:
        stalled = socket.create_connection(served.address)
        stalled.sendall(b"\x00\x00")  # half of a length
        garbage, stranger = socket.create_connection(served.address), socket.create_connection(served.address)
        garbage.sendall(struct.pack(">I", 5) + b"\xc1\xc1\xc1\xc1\xc1")
        stranger.sendall(wire.packed({"token": "guessed"}) + wire.packed({"ask": "belief"}))
        huge = socket.create_connection(served.address)
        huge.sendall(struct.pack(">I", 2**20))  # before its token is known
        with Client(*served.address, "secret") as client:
            for number in range(20):
                assert client.ask(str(number)) == {"asked": str(number)}
            assert "no MessagePack" in answer_of(garbage)["error"]
            assert "token is wrong" in answer_of(stranger)["error"]
            assert "bytes is announced" in answer_of(huge)["error"]
            assert answer_of(stalled) == {}  # closed
            assert client.ask("still") == {"asked": "still"}
        with pytest.raises(InputError, match="token is wrong"):
            Client(*served.address, "guessed")
        for raw in (stalled, garbage, stranger, huge):
            raw.close()


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=200))
def test_bytes_are_a_message_or_refused_in_a_sentence(body: bytes) -> None:
    try:
        assert isinstance(wire.unpacked(body), dict)
    except InputError as error:
        assert str(error).endswith(".")


def test_arrays_come_back_and_lists_within_lists_do_not_exhaust_the_stack() -> None:
    array = np.arange(6.0).reshape(2, 3)
    body = wire.packed({"depth": array})
    assert np.array_equal(wire.unpacked(body[4:])["depth"], array)
    with pytest.raises(InputError, match="no MessagePack"):
        wire.unpacked(b"\x81\xa1a" + b"\x91" * 100_000 + b"\x00")
    with pytest.raises(InputError, match="nested"):
        wire.unpacked(b"\x81\xa1a" + b"\x91" * 10 + b"\x00")
    with pytest.raises(InputError, match="more than 4096 maps and lists"):
        wire.unpacked(msgpack.packb({"a": [{}] * 100_000}))
    with pytest.raises(InputError, match="does not fit its bytes"):
        wire.unpacked(msgpack.packb({"a": {"shape": [2**20, 2**20], "float64": b""}}))


# ---- a session about a real belief


@pytest.fixture(scope="module")
def touched() -> Recording:
    recording = load_recording("peg_probe")
    windows = [m for m in recording.measurements if isinstance(m.action, ProbeWindow)][:3]
    return replace(recording, measurements=windows)


@pytest.fixture
def session(touched: Recording) -> Iterator[Session]:
    with Filter(model, replace(touched, measurements=[]), particles=20, deadline=1e3) as live:
        yield Session(live)


def test_samples_that_are_sent_give_the_belief_of_their_windows(session: Session, touched: Recording) -> None:
    with Filter(model, replace(touched, measurements=[]), particles=20, deadline=1e3) as straight:
        for each in touched.measurements:
            straight.observe(each.action, each.observation)
        expected = straight.settle().belief
    stamps, wrench, pose = (
        np.concatenate([getattr(m.observation, name) for m in touched.measurements])
        for name in ("times", "wrench", "world_from_peg")
    )
    rate = 1.0 / float(np.median(np.diff(stamps)))
    begun = {"name": "probe", "begin": float(stamps[0]), "seconds": len(stamps) / rate, "rate": rate}
    with serving(session) as served, Client(*served.address, "secret") as client:
        assert client.ask("begin", **begun) == {"stamps": len(stamps)}
        for part in np.array_split(np.arange(len(stamps)), 7):
            client.ask(
                "samples",
                wrench=np.column_stack([stamps, wrench])[part],
                pose=np.column_stack([stamps, pose])[part],
            )
        assert client.ask("end")["irregular"]["wrench"]["late"] == 0
        session.live.settle()
        got = client.ask("belief")
        with pytest.raises(InputError, match="there was a probe called 'probe'"):
            client.ask("begin", **begun)
    # Other windows are other steps: the same rows and evidence, other random numbers.
    deviation = expected.covariance[:3, :3].diagonal().sqrt().numpy()
    assert (np.abs(got["mean"][:3] - expected.mean[:3].numpy()) < 3.0 * deviation).all()
    assert got["behind"] == 0 and got["covariance"].shape == (6, 6) and got["left_out"] == []


@pytest.mark.filterwarnings("ignore:no particle explains it")
def test_a_client_learns_what_was_left_out(touched: Recording) -> None:
    def inexplicable(*given: Any, start: Any = None, **settings: Any) -> Iterator[Any]:
        if start is not None:
            raise InferenceError("no particle explains it")
        yield from guided_smc.infer(*given, **settings)

    first = touched.measurements[0]
    empty = replace(touched, measurements=[])
    with Filter(model, empty, particles=20, infer=inexplicable) as live, serving(Session(live)) as served:
        live.observe(first.action, first.observation)
        live.settle()
        with Client(*served.address, "secret") as client:
            answer = client.ask("belief")
    assert answer["left_out"] == ["no particle explains it"] and answer["measurements"] == 0


@pytest.mark.parametrize(
    ("request_", "sentence"),
    [
        ({}, "'None' is asked for; ask for begin"),
        ({"ask": "samples", "wrench": [[0.0] * 7]}, "no probe has begun"),
        ({"ask": "begin", "plan": {"name": "p"}}, "the plan lacks"),
        ({"ask": "begin", "name": "p", "begin": 0.0, "rate": 1e9, "seconds": 1.0}, "stamps a second"),
        ({"ask": "begin", "name": "p", "begin": 0.0, "rate": 1e4, "seconds": 500.0}, "5000000 stamps"),
        ({"ask": "view", "camera": {}, "depth": [1.0]}, "the camera lacks 'name'"),
        ({"ask": "samples", "wrench": np.zeros((7, 130))}, "wrench has shape (7, 130); send (K, 7)"),
        ({"ask": "begin", "name": "p", "begin": 1.7e18, "rate": 1e2, "seconds": 1.0}, "begins at 1.7e+18 s"),
    ],
)
def test_what_is_wrong_is_answered_in_a_sentence(
    session: Session, request_: dict[str, Any], sentence: str
) -> None:
    assert sentence in session.answer(request_)["error"]


def test_a_probe_that_is_not_over_keeps_its_samples_and_its_name(session: Session) -> None:
    probe = {"ask": "begin", "name": "first", "begin": 0.0, "rate": 100.0, "seconds": 1.0}
    assert session.answer(probe) == {"stamps": 100}
    for name in ("first", "second"):
        assert "'first' is not over; ask for 'end'" in session.answer({**probe, "name": name})["error"]
    wrong = {"ask": "samples", "wrench": [[0.0] * 7, [np.nan] * 7], "pose": [[0.0] * 8]}
    assert "pose" in session.answer({**wrong, "wrench": [[0.0] * 7]})["error"]
    assert "not finite" in session.answer({**wrong, "pose": []})["error"]
    streams = session._sampler and session._sampler._streams
    assert streams and streams["wrench"].times == [0.0] and not streams["pose"].times  # rows that are right
    ended = session.answer({"ask": "end"})
    assert ended["windows"] == 0 and ended["missing"] == 100
    assert "there was a probe called 'first'" in session.answer(probe)["error"]


def test_a_window_that_is_refused_drops_no_row_after_it(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> None:
        raise InputError("no.")

    monkeypatch.setattr(session.live, "observe", refused)
    session.answer({"ask": "begin", "name": "first", "begin": 0.0, "rate": 100.0, "seconds": 1.0})
    stamps = np.arange(-0.1, 1.2, 0.01)
    pose = np.tile([0.5, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0], (len(stamps), 1))
    wrench = np.column_stack([stamps, np.zeros((len(stamps), 6))])
    request = {"ask": "samples", "wrench": wrench, "pose": np.column_stack([stamps, pose])}
    assert session.answer(request) == {"error": "no."}
    assert session._sampler is not None and session._sampler._streams["pose"].times[-1] == stamps[-1]


def test_an_error_of_the_program_is_an_answer_and_is_logged(
    session: Session, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(_: object) -> Any:
        raise KeyError("of\nthe program")

    monkeypatch.setitem(session._asked, "belief", broken)
    error = session.answer({"ask": "belief"})["error"]
    assert error.startswith("belief has failed in the server") and "\n" not in error
    assert "in broken" in caplog.text


json_like = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.binary(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=8,
)
words = st.sampled_from(["begin", "samples", "end", "view"])
names = st.sampled_from(["plan", "name", "begin", "seconds", "rate", "wrench", "pose", "camera", "depth"])


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(words, st.dictionaries(names, json_like, max_size=5))
def test_no_request_is_more_than_an_answer(session: Session, asked: str, fields: dict[str, Any]) -> None:
    assert isinstance(session.answer({**fields, "ask": asked}), dict)


def test_a_session_knows_the_probes_of_the_recording_that_it_begins_with() -> None:
    recording = load_recording("peg_probe")
    window = next(m for m in recording.measurements if isinstance(m.action, ProbeWindow))
    with Filter(model, replace(recording, measurements=[window]), particles=20) as live:
        answer = Session(live).answer(
            {"ask": "begin", "name": window.action.probe.name, "begin": 0.0, "rate": 100.0, "seconds": 1.0}
        )
    assert "there was a probe called" in answer["error"]


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        (
            {"ask": "samples", "wrenches": [[0.0] * 7]},
            "'samples' has no field 'wrenches'; its",
        ),
        ({"ask": "belief", "of": "part"}, "'belief' has no field 'of'; it has none"),
        ({"ask": "samples"}, "samples has no rows"),
    ],
)
def test_a_field_that_is_unknown_is_not_passed_over(
    session: Session, asked: dict[str, Any], sentence: str
) -> None:
    assert sentence in session.answer(asked)["error"]


def test_an_insertion_is_into_the_hole_that_is_asked_for(session: Session) -> None:
    def read(fields: Mapping[str, Any]) -> Plan:
        return Plan(**{**fields, "manners": tuple(fields["manners"])})

    planned = session.answer({"ask": "insertion", "inside": [0.001, 0.0]})
    same = session.answer({"ask": "insertion"})
    np.testing.assert_array_equal(planned["push"]["world_from_peg"], same["push"]["world_from_peg"])
    # What a client carries the push out with, from where the search has ended.
    search, push = (read(same[name]) for name in ("search", "push"))
    whole = InsertionPlan(search, push, same["world_from_hole"], same["depth"], same["chamfer"])
    np.testing.assert_allclose(
        whole.push_from(push.world_from_peg[0]).world_from_peg, push.world_from_peg, atol=1e-9
    )
    assert "no hole around" in session.answer({"ask": "insertion", "inside": [0.028, 0.0]})["error"]
    assert "give two numbers in metres" in session.answer({"ask": "insertion", "inside": "middle"})["error"]


def test_a_probe_of_too_many_stamps_is_refused_before_they_are_made(session: Session) -> None:
    tracemalloc.start()
    probe = {"ask": "begin", "name": "p", "begin": 0.0, "rate": 1e5, "seconds": 600.0}
    assert "60000000 stamps" in session.answer(probe)["error"]
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


def test_after_a_gap_rows_are_not_looked_at_any_more(session: Session) -> None:
    session.answer({"ask": "begin", "name": "first", "begin": 0.0, "rate": 100.0, "seconds": 4.0})
    stamps = np.arange(-0.1, 4.2, 0.01)
    pose = np.column_stack([stamps, np.tile([0.5, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0], (len(stamps), 1))])
    wrench = np.column_stack([stamps, np.zeros((len(stamps), 6))])[(stamps < 0.995) | (stamps > 1.1)]
    for part in (slice(0, 200), slice(200, None)):
        request = {"ask": "samples", "wrench": wrench[part], "pose": pose[part]}
        assert "the wrench stream has no message from 0.99" in session.answer(request)["error"]
    kept = session._sampler and len(session._sampler._streams["pose"].times)
    assert kept and kept < 200
    ended = session.answer({"ask": "end"})
    assert ended["windows"] == 0 and ended["missing"] > 200


def test_a_probe_without_a_command_is_refused_where_that_is_simulated(touched: Recording) -> None:
    first = touched.measurements[0]
    unknown = replace(first.action.probe, stiffness=np.zeros(6))
    recording = replace(touched, measurements=[replace(first, action=replace(first.action, probe=unknown))])
    with pytest.raises(InputError, match="has no stiffness"):
        next(islice(guided_smc.infer(peg_in_hole.model, recording, particles=20), 1, None))


def test_the_largest_image_is_a_message_and_one_of_float32_stays_so() -> None:
    image = np.zeros((2048, 2048))
    wire.length_of(wire.packed({"ask": "view", "depth": image})[: wire.LENGTH.size])
    half = wire.packed({"depth": image.astype(np.float32)})
    assert len(half) < 0.51 * image.nbytes
    assert wire.unpacked(half[wire.LENGTH.size :])["depth"].shape == (2048, 2048)
