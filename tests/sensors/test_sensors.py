"""Kinds of measurement: one that is registered here alone can be saved, checked, planned and drawn."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from torch.distributions import Normal

from bcppl.errors import InputError
from bcppl.figures import action_in_3d
from bcppl.geometry.camera import looking_at
from bcppl.geometry.extrusion import block
from bcppl.geometry.parts import Guess
from bcppl.inference.design.rules import by_linearised_gain
from bcppl.inference.filters import guided_smc, tempered_smc
from bcppl.inference.planning.candidate_layout import plan_candidates
from bcppl.models import look_and_touch
from bcppl.models.peg_in_hole import model
from bcppl.poses import as_pose, identity, local, retract, rotation_matrix
from bcppl.recordings import DepthImage, Measurement, Push, Recording, View, describe, load, problems, save
from bcppl.recordings.action_file import load_actions, save_actions
from bcppl.recordings.fingerprint import fingerprint
from bcppl.robot.plan import Plan
from bcppl.sensors import protocol, sensor_named, sensor_of, sensors
from bcppl.sensors.candidates import action_of, duration_of, name_of, with_candidates
from bcppl.sensors.protocol import (
    AroundPart,
    Drawable,
    HasBlank,
    HasLikelihood,
    Moving,
    Placed,
    Plannable,
)
from bcppl.traces import generate
from tests.made_recordings import assert_identical, assert_one_sentence, camera, full

ABOVE = np.array([0.0, 0.0, 0.3, 0.0, 1.0, 0.0, 0.0])
LASER = EntryPoint("laser", "bcppl.sensors.laser", protocol.GROUP)


pytestmark = pytest.mark.usefixtures("own_registry")


@pytest.fixture
def laser(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The kind `laser`, as an installed package offers it: nothing of bcppl imports it."""
    monkeypatch.setattr(protocol, "entry_points", lambda group: [LASER] if group == LASER.group else [])
    package, kept = sys.modules["bcppl.sensors"], sys.modules.pop(LASER.value, None)
    yield importlib.import_module(LASER.value)
    del sys.modules[LASER.value], package.laser  # type: ignore[attr-defined]
    if kept is not None:
        sys.modules[LASER.value] = package.laser = kept  # type: ignore[attr-defined]


def shone(module: Any, *metres: float, **changes: Any) -> Recording:
    """`full()` with distances along one beam after its own measurements."""
    beam = module.Beam("wrist", 0.05, 0.5, ABOVE)
    distances = [Measurement(replace(beam, **changes), module.Distance(each)) for each in metres]
    recording = full()
    return replace(recording, measurements=[*recording.measurements, *distances])


def test_a_recording_of_a_new_kind_comes_back(laser: Any, tmp_path: Path) -> None:
    recording = shone(laser, 0.2, 0.3)
    assert [m.kind for m in recording.measurements[-2:]] == ["laser", "laser"]
    save(recording, tmp_path / "a.h5")
    loaded = load(tmp_path / "a.h5")
    assert_identical(recording, loaded)
    with h5py.File(tmp_path / "a.h5") as file:
        far = file["measurements/000007/action/far"]
        assert far[()] == 0.5 and far.attrs["units"] == "m" and file.attrs["schema_version"] == 1


def test_an_installed_package_is_searched_for_a_kind_that_is_not_known(
    laser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save(shone(laser, 0.2), tmp_path / "a.h5")
    del protocol._registered["laser"], protocol._by_type[laser.Beam], sys.modules["bcppl.sensors.laser"]
    assert load(tmp_path / "a.h5").measurements[-1].kind == "laser"


def test_a_kind_that_nobody_offers_is_named(
    laser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = shone(laser, 0.2)
    save(recording, tmp_path / "a.h5")
    del protocol._registered["laser"], protocol._by_type[laser.Beam]
    monkeypatch.setattr(protocol, "entry_points", lambda group: [])
    with pytest.raises(
        InputError, match=r"a\.h5.* unknown kind 'laser'; known are view, window, push"
    ) as caught:
        load(tmp_path / "a.h5")
    assert_one_sentence(str(caught.value).replace(str(tmp_path), ""))
    with pytest.raises(InputError, match="Beam is no known kind of action"):
        save(recording, tmp_path / "b.h5")
    (problem,) = problems(recording)
    assert problem.startswith("measurement 7: Beam is no known kind of action")
    assert_one_sentence(problem)
    assert dict(describe(recording))["measurements"] == "3 views, 3 probe windows, 1 push"


def test_a_package_that_cannot_be_loaded_is_named_and_does_no_harm(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = EntryPoint("sniffer", "no_such_package.sniffer", protocol.GROUP)
    monkeypatch.setattr(protocol, "entry_points", lambda group: [broken])
    # Kinds that other tests made known stay known.
    monkeypatch.setattr(protocol, "_registered", dict(protocol._registered))
    protocol._registered.pop("laser", None)
    with pytest.warns(UserWarning, match="'sniffer' .*no_such_package"):
        assert [sensor.kind for sensor in sensors()] == ["view", "window", "push"]


def test_problems_of_a_new_kind_stand_where_its_measurements_do(laser: Any) -> None:
    assert problems(shone(laser, 0.2)) == []
    recording = shone(laser, 0.2, 0.9, 0.1)
    dark = replace(full().measurements[0].observation, depth=np.full((6, 8), np.nan))
    measurements = [*recording.measurements, Measurement(View(camera("left")), dark)]
    other = Measurement(laser.Beam("wrist", 0.05, 0.5, 2.0 * ABOVE), laser.Distance(0.2))
    wrong = problems(replace(recording, measurements=[*measurements, other]))
    starts = [
        "measurement 8: a distance of 0.9 m",
        "measurement 10: the depth",
        "measurement 11: laser 'wrist': its world_from_laser",
    ]
    for problem, start in zip(wrong, starts, strict=True):
        assert problem.startswith(start)
        assert_one_sentence(problem)
    touch = full().measurements[1].observation
    mixed = replace(recording, measurements=[Measurement(recording.measurements[-1].action, touch)])
    assert problems(mixed) == [
        "measurement 0: a Beam is paired with a Touch; a laser distance pairs a Beam with a Distance."
    ]


@pytest.mark.parametrize("metres", ["0.2", None, np.array([0.2, 0.3])])
def test_a_field_of_another_type_is_one_problem(laser: Any, metres: Any) -> None:
    (found,) = problems(shone(laser, metres))
    assert_one_sentence(found)
    assert "the laser distances cannot be checked" in found


@pytest.mark.parametrize("far", [np.inf, np.nan, 0.0, -1.0, 0.05])
def test_a_laser_without_a_range_is_a_problem(laser: Any, far: float) -> None:
    """Its outliers are spread over the range, so a likelihood without one is no density."""
    (found,) = problems(shone(laser, 0.2, far=far))
    assert found.startswith("measurement 7: laser 'wrist' reaches from 0.05 to ") and "below far" in found
    assert_one_sentence(found)
    assert len(problems(shone(laser, 0.2, near=-0.1))) == 1


def test_a_new_kind_is_described_and_counted(laser: Any) -> None:
    rows = dict(describe(shone(laser, 0.2, 0.3)))
    assert rows["measurements"] == "3 views, 3 probe windows, 1 push, 2 laser distances"
    assert rows["laser wrist"] == "0.05 to 0.5 m"


def test_fingerprints_see_a_new_kind(laser: Any, tmp_path: Path) -> None:
    recordings = [
        shone(laser, 0.2),
        shone(laser, 0.21),
        shone(laser, 0.2, world_from_laser=ABOVE + np.eye(7)[0]),
        shone(laser, 0.2, far=0.6),
        shone(laser, 0.2, name="other"),
    ]
    assert len({fingerprint(each, 8) for each in recordings}) == len(recordings)
    assert len({fingerprint(each, 7) for each in recordings}) == 1
    save(recordings[0], tmp_path / "a.h5")
    assert fingerprint(load(tmp_path / "a.h5"), 8) == fingerprint(recordings[0], 8)


@pytest.mark.parametrize("suffix", [".h5", ".json"])
def test_candidates_of_a_new_kind_come_back_from_files(laser: Any, suffix: str, tmp_path: Path) -> None:
    aim = laser.Beam("spot", 0.05, 0.5, ABOVE)
    save_actions([aim, View(camera("left"))], tmp_path / f"next{suffix}")
    back = load_actions(tmp_path / f"next{suffix}")
    assert_identical(back[0], aim)
    assert isinstance(back[1], View)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [({"near": 0.6}, "below far"), ({"world_from_laser": 2.0 * ABOVE}, "its world_from_laser")],
)
def test_a_beam_that_is_none_is_refused_where_it_is_read(
    laser: Any, wrong: Any, named: str, tmp_path: Path
) -> None:
    save_actions([replace(laser.Beam("spot", 0.05, 0.5, ABOVE), **wrong)], tmp_path / "next.json")
    with pytest.raises(InputError, match=f"action 0 of .*laser 'spot'.*{named}") as caught:
        load_actions(tmp_path / "next.json")
    assert_one_sentence(str(caught.value).replace(str(tmp_path), ""))


def test_a_candidate_of_a_new_kind_is_drawn(laser: Any) -> None:
    aim = laser.Beam("spot", 0.1, 0.4, ABOVE)
    belief = "next", full().truth[None], np.zeros(1)  # type: ignore[index]
    figure = action_in_3d(full().part, belief, aim, None, [aim, aim])
    (axes,) = figure.axes
    beams = [line for line in axes.get_lines() if line.get_label() == "beam"]
    np.testing.assert_allclose(np.transpose(beams[0].get_data_3d()), [[0, 0, 200], [0, 0, -100]], atol=1e-9)
    assert axes.get_zlim()[0] <= -100.0 and "the beam as far as" in axes.get_title()
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["beam", "particles (z axes)", "other candidates"]


def test_a_model_explains_a_new_kind_by_its_own_likelihood(laser: Any) -> None:
    whole = shone(laser, 0.2846, 0.3)
    guess = replace(whole.guess, world_from_part=identity().numpy(), translation=np.full(3, 0.02))
    recording = replace(whole, guess=guess, measurements=whole.measurements[-2:], peg=None)
    scene = model.prepare(recording)
    poses = identity(3)
    poses[:, 2] = torch.tensor([0.0, 0.001, -0.0005])  # of a block whose top is 15 mm above its middle
    actions = [m.action for m in recording.measurements]
    observed = model.observe(scene, recording.measurements)
    _, weight = generate(model.program, (scene, actions), observed, 3, choices={"hole": poses})
    distance = torch.tensor([0.285, 0.284, 0.2855], dtype=torch.float64)
    density = [Normal(distance, laser.NOISE).log_prob(torch.tensor(each)).exp() for each in (0.2846, 0.3)]
    expected = sum(((1 - laser.OUTLIER) * each + laser.OUTLIER / 0.5).log() for each in density)
    torch.testing.assert_close(weight - weight[0], expected - expected[0], rtol=1e-3, atol=1e-3)


def test_capabilities_are_asked_for_by_protocol(laser: Any) -> None:
    capabilities = (AroundPart, Drawable, HasBlank, HasLikelihood, Moving, Placed, Plannable)
    found = {each.kind: [p.__name__ for p in capabilities if isinstance(each, p)] for each in sensors()}
    assert found == {
        "view": ["AroundPart", "Drawable", "HasBlank", "Placed", "Plannable"],
        "window": ["Drawable", "Moving", "Plannable"],
        "push": [],
        "laser": ["AroundPart", "Drawable", "HasBlank", "HasLikelihood", "Placed", "Plannable"],
    }


def test_candidates_of_every_kind_have_an_action_a_name_and_a_duration(laser: Any) -> None:
    plan = Plan(
        "down", np.array([1.0, 3.5]), np.stack([ABOVE, ABOVE]), ("free",), 4.0, np.ones(6), np.ones(6)
    )
    view, aim = View(replace(camera("left"), device="")), laser.Beam("spot", 0.05, 0.5, ABOVE)
    assert [name_of(each) for each in (plan, view, aim)] == ["down", "left", "spot"]
    assert [name_of(action_of(each)) for each in (plan, view, aim)] == ["down", "left", "spot"]
    assert [duration_of(each) for each in (plan, view, aim)] == [2.5, 0.0, 0.0]
    window = action_of(plan)
    assert (window.first, window.last) == (0, 250) and sensor_of(window) is sensor_of(plan)
    depth: Any = sensor_of(view)
    again = depth.renamed(view, "left again")
    assert again.camera.name == "left again" and again.camera.instrument == "left"
    assert depth.blank(view).depth.shape == (6, 8) and np.isnan(depth.blank(view).depth).all()
    push = full().measurements[3].action
    assert isinstance(push, Push) and sensor_of(push) is sensor_named("push")
    with pytest.raises(InputError, match="a push cannot be planned"):
        action_of(push)


def block_and_beams(laser: Any) -> tuple[Recording, torch.Tensor]:
    """A block whose pose is known to a few millimetres, and distances along seven beams onto its faces."""
    part, truth = block((0.06, 0.05, 0.02)), identity()
    truth[:3] = torch.tensor([0.0012, -0.0008, 0.0005])
    guess = Guess(identity().numpy(), np.full(3, 0.003), tilt=0.03, yaw=0.03)
    places = [(x, y, 0.0) for x in (-0.02, 0.02) for y in (-0.02, 0.02)]
    onto = [
        looking_at(np.array([x, y, 0.2]), np.array([x, y, z]), np.array([1.0, 0.0, 0.0]))
        for x, y, z in places
    ]
    onto += [looking_at(np.array([0.2, y, -0.01]), np.array([0.0, y, -0.01])) for y in (-0.01, 0.01)]
    onto.append(looking_at(np.array([0.0, 0.2, -0.01]), np.array([0.0, 0.0, -0.01])))
    beams = [laser.Beam(f"beam {k}", 0.05, 0.5, pose) for k, pose in enumerate(onto)]
    torch.manual_seed(0)
    metres = [float(laser.BeamDistance(part, truth[None], beam).sample()) for beam in beams]
    measurements = [Measurement(b, laser.Distance(m)) for b, m in zip(beams, metres, strict=True)]
    return Recording(part, guess, measurements, truth=truth.numpy(), model="look_and_touch"), truth


@pytest.mark.long
@pytest.mark.parametrize(
    "infer",
    [guided_smc.infer, partial(tempered_smc.infer, sweeps=4, share=0.6)],
    ids=["guided", "tempered"],
)
def test_a_new_kind_is_inferred_by_guided_and_by_tempered_smc(laser: Any, infer: Any) -> None:
    recording, truth = block_and_beams(laser)
    *_, last = infer(look_and_touch.model, recording, particles=40, seed=1)
    off = local(last.belief.mean, truth)
    assert float(off[:3].norm()) < 0.0006 and float(off[3:].norm()) < 0.03
    assert float(last.belief.spread[:3].max()) < 0.0006


def test_the_quadratic_approximation_of_a_new_kind_agrees_with_differences(laser: Any) -> None:
    recording, truth = block_and_beams(laser)
    for beam in (m.action for m in recording.measurements):
        value = torch.tensor(float(laser.BeamDistance(recording.part, truth[None], beam).cast()[0]) + 1e-5)
        site = laser.BeamDistance(recording.part, truth[None], beam)
        _, gradient = site.cast()
        steps = 1e-6 * torch.eye(6, dtype=torch.float64)
        ahead, behind = (
            laser.BeamDistance(recording.part, retract(truth, sign * steps), beam).cast()[0]
            for sign in (1.0, -1.0)
        )
        torch.testing.assert_close((ahead - behind) / 2e-6, gradient[0], rtol=1e-4, atol=1e-6)
        quadratic = site.quadratic(value)
        assert bool((torch.linalg.eigvalsh(quadratic.information) > -1e-3).all())


@pytest.mark.long
def test_a_new_kind_is_ranked_and_laid_out_beside_others(laser: Any) -> None:
    recording, _ = block_and_beams(laser)
    *_, last = guided_smc.infer(look_and_touch.model, recording, particles=40, seed=1)
    found = plan_candidates(last.belief, recording.part, None, {"laser": 5, "view": 1}, seed=3)
    scene = look_and_touch.prepare(with_candidates(recording, found))
    ranking = by_linearised_gain("part", outer_samples=8, seed=0)(last.population, found, scene)
    assert len(ranking) == 6 and all(each.information_gain > 0.0 for each in ranking)
    # Before the first of its kind is measured.
    seen = replace(recording, measurements=[m for m in recording.measurements if m.kind == "view"])
    *_, last = guided_smc.infer(look_and_touch.model, seen, particles=20, seed=1)
    scene = look_and_touch.prepare(with_candidates(seen, found))
    assert len(by_linearised_gain("part", outer_samples=4, seed=0)(last.population, found, scene)) == 6


def test_a_part_that_turns_about_a_frame_far_away_stays_in_the_region_of_its_image() -> None:
    """A bar whose middle is 60 mm from its frame, its yaw open: turned, it is on the other side."""
    bar = block((0.04, 0.02, 0.01)).moved(np.array([0.06, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    eye = looking_at(np.array([0.0, 0.0, 0.5]), np.zeros(3), (0.0, 1.0, 0.0))
    above = replace(camera("above"), width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)
    above = replace(above, world_from_camera=eye)
    view = Measurement(View(above), DepthImage(np.full((120, 160), 0.5)))
    guess = Guess(identity(1)[0].numpy(), np.full(3, 0.002), yaw=np.pi)
    scene = look_and_touch.model.prepare(Recording(bar, guess, [view]))
    left, top, width, height = scene.likelihoods["view"].looks["above"].region
    turned = bar.vertices * [-1.0, -1.0, 1.0]
    pixel = above.project((turned - eye[:3]) @ rotation_matrix(as_pose(eye)).numpy())
    assert (pixel >= np.array([left, top]) - 0.5).all()
    assert (pixel <= np.array([left + width, top + height]) - 0.5).all()


def test_a_beam_does_not_meet_what_is_beyond_its_range(laser: Any) -> None:
    down = looking_at(np.array([0.0, 0.0, 0.8]), np.zeros(3), (0.0, 1.0, 0.0))
    for far, expected in ((1.0, 0.8), (0.5, 0.5)):
        beam = laser.Beam("down", 0.05, far, down)
        distance, gradient = laser.BeamDistance(block((0.1, 0.1, 0.05)), identity(2), beam).cast()
        assert distance.tolist() == pytest.approx([expected] * 2)
        assert bool((gradient != 0.0).any()) == (far > 0.8)


def test_views_that_may_come_next_are_of_the_same_instrument() -> None:
    sensor: Any = sensor_named("view")
    (near,) = sensor.around(
        np.array([0.0, 0, 0, 1, 0, 0, 0]), block((0.1, 0.1, 0.05)), View(camera("c")), 1, 0
    )
    assert near.camera.instrument == "c" != near.camera.name


@pytest.mark.parametrize(
    ("background", "words"),
    [
        (
            np.full((6, 8), 700.0),
            "background of camera 'left': the median depth is 700, probably millimetres",
        ),
        (np.full((6, 8), -1.0), "48 depths are negative"),
        ([[0.5] * 8] * 6, "background of camera 'left' is of type list"),
    ],
)
def test_a_background_is_checked_as_an_image_is(background: Any, words: str) -> None:
    assert any(words in problem for problem in problems(replace(full(), background={"left": background})))


def test_a_width_that_is_no_whole_number_is_refused() -> None:
    recording = full()
    view = next(m for m in recording.measurements if isinstance(m.action, View))
    odd = replace(view, action=View(replace(view.action.camera, name="odd", width=8.0)))
    assert any(
        "give whole numbers" in problem for problem in problems(replace(recording, measurements=[odd]))
    )
