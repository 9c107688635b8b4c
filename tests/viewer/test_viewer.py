"""The page of a run: what it shows in a browser without a network, what it weighs, and what it refuses."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from bcppl import view
from bcppl.beliefs import Belief
from bcppl.cli.run_folder import belief_name
from bcppl.geometry.camera import Camera
from bcppl.models import load_recording
from bcppl.recordings import Recording, save
from bcppl.recordings.beliefs import save_belief
from bcppl.rendering.rasterisation import renderer_for
from bcppl.sensors import Probe, ProbeWindow
from bcppl.viewer import Page
from bcppl.viewer.of_measurements import rectified
from tests.command_line import Ran, short
from tests.viewer.browser import SPACE, coloured, in_browser, opened

LARGEST = 5_000_000


def belief(recording: Recording, count: int, spread: float, seed: int) -> Belief:
    """Particles about the truth."""
    draw = np.random.default_rng(seed)
    poses = np.tile(np.asarray(recording.truth), (count, 1))
    poses[:, :3] += spread * draw.normal(size=(count, 3))
    return Belief(torch.as_tensor(poses), torch.as_tensor(draw.normal(size=count)))


def many(particles: int, touches: int = 18) -> tuple[Recording, list[tuple[str, Belief]]]:
    """Two views and many touches, each a probe of its own: the shipped ones again and again."""
    whole = load_recording("peg_probe")
    views, windows = list(whole.measurements[:2]), list(whole.measurements[2:])
    repeated = []
    for k in range(touches):
        window = windows[k % len(windows)]
        stamps = window.observation.times
        probe: Probe = dataclasses.replace(window.action.probe, name=f"touch {k}", stamps=stamps)
        repeated.append(dataclasses.replace(window, action=ProbeWindow(probe, 0, len(stamps))))
    recording = dataclasses.replace(whole, measurements=views + repeated)
    steps = range(len(recording.measurements) + 1)
    history = [(f"step {k}", belief(recording, particles, 0.02 / (1 + k), k)) for k in steps]
    return recording, history


PEG = (0xC4, 0xA6, 0x4E)  # in the light


@in_browser
def test_a_page_shows_particles_part_depth_and_touch_in_step_and_asks_no_host(tmp_path: Path) -> None:
    recording, history = many(particles=1000)
    page = view(recording, history, title="many")
    file = tmp_path / "many.html"
    page.save(file)
    assert file.stat().st_size < LARGEST
    assert "default-src 'none'" in page.text and not re.search(
        r"https?://", page.text.replace(recording.source, "")
    )
    looked, first = opened(file, "#step=2&particle=17")
    touched, second = opened(file, "#step=15")
    for state in (looked, touched):
        assert state["gl"] == "true" and state["particles"] == "1000" and int(state["triangles"]) > 10
        assert int(state["depth"]) > 100 and "milliseconds" in state
    assert [looked[of] for of in ("step", "label", "chosen", "peg")] == ["2", "step 2", "17", "false"]
    assert [touched[of] for of in ("step", "label", "chosen", "peg")] == ["15", "step 15", "mean", "true"]
    assert coloured(first, PEG, SPACE) < 200 < coloured(second, PEG, SPACE)
    assert np.abs(np.asarray(first).astype(int) - np.asarray(second)).max() > 100


# What a person would do, done by a script of the test in a copy of the page that allows it.
HANDS = """<script>
const given = document.documentElement.dataset, slider = document.getElementById("step");
slider.value = 4; slider.dispatchEvent(new Event("input")); given.slid = given.step;
const at = scene.project(placed(Array.from(row(steps[4].poses, 7)), [0, 0, arrow]));
const box = scene.canvas.getBoundingClientRect();
const where = { clientX: box.left + at[0], clientY: box.top + at[1], pointerId: 1, bubbles: true };
scene.canvas.setPointerCapture = () => 0;
for (const name of ["pointerdown", "pointerup"]) scene.canvas.dispatchEvent(new PointerEvent(name, where));
given.clicked = given.chosen; given.words = document.getElementById("chosen").textContent;
const depth = rendered(part, held.measurements[0].camera, Array.from(row(steps[4].poses, 7)));
given.rendered = Array.from(depth).join(" ");
</script></body>"""


@in_browser
def test_a_slider_a_click_and_the_rendering_in_the_page_do_what_they_should(tmp_path: Path) -> None:
    recording, history = many(particles=12, touches=4)
    page = view(recording, history)
    allowed = re.sub(r"script-src '[^']*'", "script-src 'unsafe-inline'", page.text)
    file = tmp_path / "hands.html"
    file.write_text(allowed.replace("</body>", HANDS))
    state, _ = opened(file)
    assert state["slid"] == "4"
    assert state["clicked"] == "7", state["words"]
    assert "from the mean" in state["words"] and "gap" in state["words"]
    camera = recording.measurements[0].action.camera
    expected = renderer_for(recording.part).images(camera, history[4][1].world_from_part[7:8])[0].ravel()
    found = np.array([float(word) for word in state["rendered"].split(" ")])
    both = np.isfinite(found) & np.isfinite(expected)
    assert both.sum() > 100 and (np.isfinite(found) == np.isfinite(expected)).mean() > 0.999
    assert np.abs(found - expected)[both].max() < 1e-4


def test_text_of_a_file_stays_text() -> None:
    recording = load_recording("peg_probe")
    evil = "</script><script>alert(1)</script><!-- \x1b[31m %%DATA%%"
    part = dataclasses.replace(recording.part, name=evil)
    named = dataclasses.replace(recording, part=part, source=evil, measurements=recording.measurements[:1])
    page = view(named, title=evil, notes=[evil], facts={evil: evil})
    assert page.text.count("<script") == 2 and "<!--" not in page.text and "\x1b" not in page.text
    held = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.text)
    assert held is not None
    assert json.loads(held[1])["source"] == evil.replace("\x1b", "\\x1b")


def test_a_notebook_shows_the_page_in_a_frame_of_its_own() -> None:
    recording, history = many(particles=3, touches=1)
    shown = view(recording, history)._repr_html_()
    assert shown.startswith("<iframe ") and shown.count("<") == 2
    assert Page("<p class='a'>\"&", 1)._repr_html_().count('"') == 4  # of the frame's own attributes


def test_a_distorted_image_is_shown_as_if_the_lens_were_straight() -> None:
    pose = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    camera = Camera("bent", 80, 60, 60.0, 60.0, 39.5, 29.5, pose, distortion=(0.1, 0.0, 0.0, 0.0))
    rays = camera.rays().reshape(60, 80, 3)
    straight = rectified(camera, 1.0 + 0.1 * rays[..., 0])  # a plane that leans to the right
    u = (np.arange(80) - 39.5) / 60.0
    known = np.isfinite(straight)
    assert known.mean() > 0.9
    assert np.abs(straight - (1.0 + 0.1 * np.tile(u, (60, 1))))[known].max() < 0.1 / 60.0


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a small run, made by hand: a run of pushes."""
    folder = tmp_path_factory.mktemp("run")
    recording = short(2)
    save(recording, folder / "short.h5")
    rows = [{"measurement": name, "ESS": "5.0"} for name in ("prior", "push 1", "push 2")]
    for k, row in enumerate(rows):
        particles = belief(recording, 5, 0.01, k)
        options = {"log_evidence": 0.0, "random_state": torch.zeros(1, dtype=torch.uint8)}
        save_belief(particles, folder / belief_name(k), label=row["measurement"], **options)
    record = {"recording": str(folder / "short.h5"), "model": "point_probe", "inference": "tempered_smc"}
    record |= {"particles": 5, "seed": 0, "settings": {}, "rows": rows, "checked": {}, "complete": True}
    (folder / "run.json").write_text(json.dumps(record))
    return folder


def changed(folder: Path, to: Path, **entries: object) -> Path:
    """A copy of a run with other entries in run.json; None takes one away."""
    shutil.copytree(folder, to)
    record = json.loads((to / "run.json").read_text()) | entries
    (to / "run.json").write_text(json.dumps({k: v for k, v in record.items() if v is not None}))
    return to


def test_a_run_and_a_recording_are_viewed(bcppl: Callable[..., Ran], finished: Path, tmp_path: Path) -> None:
    ran = bcppl("view", finished, "--save", "page.html")
    assert ran.code == 0 and "3 steps" in ran.out, ran.err
    assert "push 2" in (tmp_path / "page.html").read_text()
    alone = bcppl("view", finished / "short.h5", "--save", "alone.html")
    assert alone.code == 0 and "3 steps" in alone.out, alone.err
    stopped = changed(finished, tmp_path / "stopped", complete=False)
    assert bcppl("view", stopped, "--save", "stopped.html").code == 0
    assert "has not been completed" in (tmp_path / "stopped.html").read_text()


def test_what_cannot_be_viewed_is_refused_in_one_sentence(
    bcppl: Callable[..., Ran], finished: Path, tmp_path: Path
) -> None:
    (tmp_path / "empty").mkdir()
    gone = changed(finished, tmp_path / "gone")
    (gone / belief_name(1)).unlink()
    older = changed(finished, tmp_path / "older", checked=None)
    nothing = changed(finished, tmp_path / "nothing", rows=[])
    moved = changed(finished, tmp_path / "moved", recording="elsewhere.h5")
    for words, sentence in (
        (("nowhere",), "there is no recording 'nowhere'"),
        (("empty",), "it has no run.json"),
        ((gone,), "has no belief_001.h5"),
        ((older,), "has no checked as `bcppl run` writes it"),
        ((nothing,), "has no step to show"),
        ((moved,), "give it with --of"),
        (("peg_probe", "--of", "peg_probe"), "is no folder of a run"),
        ((finished, "--save", "no/where.html"), "there is no folder no"),
    ):
        ran = bcppl("view", *words)
        assert ran.code == 2 and sentence in ran.err, ran.err
        assert ran.err.count("\n") == 1
    assert bcppl("view", moved, "--of", finished / "short.h5", "--save", "page.html").code == 0
