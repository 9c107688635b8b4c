"""Recordings that are wrong: each problem is one sentence that names the place."""

import dataclasses
import math
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from bcppl.errors import InputError
from bcppl.geometry.parts import Part
from bcppl.recordings import (
    Measurement,
    ProbeWindow,
    Recording,
    View,
    describe,
    notes,
    problems,
    validate,
)
from bcppl.sensors import checks
from tests.made_recordings import assert_one_sentence, block, camera, full


def with_measurement(index: int, **changes: Any) -> Recording:
    """`full()` with fields of one measurement's action, camera, probe or observation replaced."""
    recording = full()
    measurements = list(recording.measurements)
    action, observation = measurements[index].action, measurements[index].observation
    for name, value in changes.items():
        if isinstance(action, View) and hasattr(action.camera, name):
            action = View(dataclasses.replace(action.camera, **{name: value}))
        elif isinstance(action, ProbeWindow) and hasattr(action.probe, name):
            action = dataclasses.replace(action, probe=dataclasses.replace(action.probe, **{name: value}))
        elif hasattr(action, name) and name != "times":
            action = dataclasses.replace(action, **{name: value})
        else:
            observation = dataclasses.replace(observation, **{name: value})
    measurements[index] = Measurement(action, observation)
    return dataclasses.replace(recording, measurements=measurements)


def changed(values: Any, *place: int, to: float) -> Any:
    values = np.array(values)
    values[place] = to
    return values


def at(index: int, name: str) -> Any:
    measurement = full().measurements[index]
    if isinstance(measurement.action, ProbeWindow) and hasattr(measurement.action.probe, name):
        return getattr(measurement.action.probe, name)
    return getattr(measurement.action if hasattr(measurement.action, name) else measurement.observation, name)


def opened(part: Part) -> Part:
    return dataclasses.replace(part, faces=part.faces[:-1])


def scaled(part: Part) -> Part:
    return dataclasses.replace(part, vertices=1e3 * part.vertices)


def push_with_path_times(times: Any) -> Recording:
    recording = full()
    measurements = list(recording.measurements)
    push: Any = measurements[3].action
    measurements[3] = Measurement(dataclasses.replace(push, times=times), measurements[3].observation)
    return dataclasses.replace(recording, measurements=measurements)


replace = dataclasses.replace
WRONG: dict[str, tuple[Recording, str]] = {
    "pegs and paths in millimetres": (
        with_measurement(1, world_from_peg=changed(at(1, "world_from_peg"), 1, 2, to=280.0)),
        "measurement 1's peg pose .* is 280 m from the world's origin at row 1, probably millimetres",
    ),
    "mesh in millimetres": (replace(full(), part=scaled(full().part)), "millimetres"),
    "open mesh": (replace(full(), part=opened(full().part)), "open mesh"),
    "open peg": (replace(full(), peg=opened(block("rod"))), "'rod' has an open mesh"),
    "empty mesh": (replace(full(), part=replace(full().part, faces=np.zeros((0, 3), int))), "empty mesh"),
    "mesh of quads": (replace(full(), part=replace(full().part, faces=np.zeros((2, 4), int))), "triangles"),
    "no measurement": (replace(full(), measurements=[]), "no measurement"),
    "model in a file": (replace(full(), model="mine.py"), "names the file 'mine.py' as its model"),
    "model in a folder": (replace(full(), model="mine/model"), "names the file 'mine/model' as its model"),
    "no peg": (replace(full(), peg=None), "measurement 1 is a probe window but the recording has no peg"),
    "negative width": (
        replace(full(), guess=replace(full().guess, translation=np.array([0.1, -0.1, 0]))),
        "negative half width",
    ),
    "angle in degrees": (replace(full(), guess=replace(full().guess, angle=25.0)), "degrees"),
    "guess not unit": (
        replace(full(), guess=replace(full().guess, world_from_part=np.array([0.0, 0, 0, 1, 1, 0, 0]))),
        "the guess .* quaternion of length 1.414",
    ),
    "truth not finite": (replace(full(), truth=np.array([np.nan, 0, 0, 1, 0, 0, 0])), "the truth .* finite"),
    "camera inside": (
        with_measurement(2, world_from_camera=np.array([0.01, 0.02, 0.0006, 0, 1, 0, 0])),
        "measurement 2: camera 'wrist/right.2' stands .* inside it .* wrong units",
    ),
    "camera in millimetres": (
        with_measurement(2, world_from_camera=np.array([0.0, 0, 600, 0, 1, 0, 0])),
        "measurement 2: camera .* probably millimetres",
    ),
    "focal length in millimetres": (
        with_measurement(2, fx=0.0193, fy=0.0193),
        "measurement 2: camera .* nearly half the world; give them in pixels",
    ),
    "camera in OpenGL's convention": (
        with_measurement(2, world_from_camera=np.array([0.0, 0, 0.6, 1, 0, 0, 0])),
        "measurement 2: camera .* 0.6 m behind it; .* z forward",
    ),
    "camera of nine coefficients": (
        with_measurement(2, distortion=[0.1] * 8),
        "measurement 2: camera .* not Brown's k1 k2 p1 p2",
    ),
    "camera folded": (
        with_measurement(2, distortion=(-3.0, 0.5, 0.0, 0.0)),
        "measurement 2: camera .* folds the image over: .* pixels",
    ),
    "camera with a coefficient that is no number": (
        with_measurement(2, distortion=(0.1, np.nan, 0.0, 0.0)),
        "measurement 2: camera .* finite numbers",
    ),
    "camera on a wrist in another's place": (
        with_measurement(2, wrist_from_camera=np.array([0, 0, 0.1, 0, 3, 0, 0])),
        "measurement 2: camera .* wrist_from_camera has a quaternion of length 3",
    ),
    "camera not unit": (
        with_measurement(2, world_from_camera=np.array([0, 0, 0.6, 0, 2, 0, 0])),
        "measurement 2: camera .* quaternion of length 2",
    ),
    "two cameras, one name": (
        with_measurement(6, world_from_camera=np.array([0, 0, 0.7, 0, 1, 0, 0])),
        "measurement 6: camera 'left' differs",
    ),
    "depth size": (with_measurement(2, depth=np.ones((8, 6))), "measurement 2: .* 6×8, .* 8×6 pixels"),
    "depth missing": (
        with_measurement(2, depth=np.full((6, 8), np.nan)),
        "measurement 2: .* missing in every",
    ),
    "depth zero": (with_measurement(2, depth=np.zeros((6, 8))), "measurement 2: .* missing in every"),
    "depth in millimetres": (
        with_measurement(2, depth=np.full((6, 8), 480.0)),
        "measurement 2: .* millimetres",
    ),
    "depth out of range": (with_measurement(2, depth=np.full((6, 8), 4.5)), "measurement 2: .* range"),
    "depth negative": (with_measurement(2, depth=np.full((6, 8), -0.5)), "measurement 2: .* negative"),
    "wrench times": (
        with_measurement(3, times=changed(at(3, "times"), 20, to=0.0)),
        "measurement 3's wrench .* backwards at row 20",
    ),
    "path times": (
        push_with_path_times(changed(full().measurements[3].action.times, 5, to=0.0)),
        "measurement 3's finger path .* backwards at row 5",
    ),
    "path on another clock": (
        push_with_path_times(full().measurements[3].action.times + 1e9),
        "measurement 3: .* one clock",
    ),
    "path not unit": (
        with_measurement(3, world_from_tip=changed(at(3, "world_from_tip"), 4, 5, to=9.0)),
        "measurement 3's finger path .* quaternion .* row 4",
    ),
    "command times": (
        with_measurement(4, command_times=changed(at(4, "command_times"), 2, to=0.25)),
        "measurement 4: probe 'press''s command .* stand still at row 2",
    ),
    "command not unit": (
        with_measurement(4, command=changed(at(4, "command"), 2, 4, to=3.0)),
        "measurement 4: .* quaternion .* row 2",
    ),
    "stamps": (
        with_measurement(4, stamps=changed(at(4, "stamps"), 15, to=0.1)),
        "measurement 4: .* stamps .* backwards at row 15",
    ),
    "stiffness": (with_measurement(4, stiffness=-np.ones(6)), "measurement 4: .* stiffness"),
    "two probes, one name": (with_measurement(5, damping=np.ones(6)), "measurement 5: probe 'slide' differs"),
    "window beyond stamps": (with_measurement(5, last=25), "measurement 5: .* within its 20 stamps"),
    "window overlaps": (with_measurement(5, first=6), "measurement 5: .* without overlap"),
    "window times": (
        with_measurement(5, times=at(5, "stamps")[7:20] + 0.001),
        "measurement 5: .* wrench time 0.351",
    ),
    "peg not unit": (
        with_measurement(5, world_from_peg=changed(at(5, "world_from_peg"), 3, 3, to=4.0)),
        "measurement 5's peg pose .* row 3",
    ),
    "peg poses short": (with_measurement(5, world_from_peg=np.zeros((2, 7))), "measurement 5's peg pose"),
    "wrench NaN": (
        with_measurement(1, wrench=changed(at(1, "wrench"), 4, 2, to=np.nan)),
        "measurement 1's wrench has a number that is not finite at row 4; fill it by interpolation, or cut",
    ),
    "wrench NaN in a push": (
        with_measurement(3, wrench=changed(at(3, "wrench"), 9, 2, to=np.nan)),
        "measurement 3's wrench has a number that is not finite at row 9; leave that row out",
    ),
    "wrench too large": (
        with_measurement(3, wrench=changed(at(3, "wrench"), 9, 2, to=-2e4)),
        "measurement 3 has a wrench of 2e[+]04 at row 9",
    ),
    "view with a touch": (
        replace(full(), measurements=[Measurement(View(camera("left")), full().measurements[3].observation)]),
        "measurement 0: a View is paired with a Touch",
    ),
    "window left out": (
        replace(full(), measurements=[m for m in full().measurements if getattr(m.action, "last", 0) != 7]),
        "leaves out stamps 0 to 7",
    ),
    "background size": (replace(full(), background={"left": np.ones((3, 3))}), "background of camera 'left'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_each_problem_is_one_sentence_that_names_the_place(case: str) -> None:
    recording, pattern = WRONG[case]
    found = problems(recording)
    matching = [problem for problem in found if re.search(pattern, problem)]
    assert len(matching) == 1, found
    for problem in found:
        assert_one_sentence(problem)
    with pytest.raises(InputError) as failure:
        validate(recording)
    assert str(failure.value) == found[0]
    assert describe(recording)


ODD_SHAPES = [(), (0,), (2,), (1, 7), (2, 3, 4)]


def odd(thing: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """All that a thing could be with one array of another shape, or one number out of all bounds."""
    if dataclasses.is_dataclass(thing):
        for field in dataclasses.fields(thing):
            for where, value in odd(getattr(thing, field.name), f"{name}.{field.name}"):
                yield where, replace(thing, **{field.name: value})  # type: ignore[type-var]
    elif isinstance(thing, np.ndarray):
        ones: list[Any] = [np.ones(shape, thing.dtype) for shape in ODD_SHAPES]
        for value in [*ones, thing[None], thing[:, None] if thing.ndim else thing, thing[:0]]:
            yield f"{name} {value.shape}", value
        for fill in (np.nan, 1e308, 0.0) if thing.dtype.kind == "f" else ():
            yield f"{name} {fill}", np.full_like(thing, fill)
    elif isinstance(thing, int | float):
        for number in (
            (0, -1, 10**9, math.nan, math.inf, 5e-324) if isinstance(thing, float) else (0, -1, 10**9)
        ):
            yield f"{name} {number}", type(thing)(number)
    elif isinstance(thing, list | tuple):
        for k, each in enumerate(thing):
            for where, value in odd(each, f"{name}[{k}]"):
                yield where, type(thing)([*thing[:k], value, *thing[k + 1 :]])


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_whatever_a_file_holds_is_a_list_of_sentences() -> None:
    """Files hold arrays of any shape: what cannot be read by the rest of the checks is named by the first."""
    whole = full()
    hand = replace(camera("hand"), distortion=(0.01, 0.0, 0.0, 0.0), wrist_from_camera=np.eye(7)[3])
    seen = Measurement(View(hand), whole.measurements[0].observation)
    whole = replace(whole, measurements=[*whole.measurements[1:4], seen])
    assert problems(whole) == []
    for where, recording in odd(whole):
        try:
            found = problems(recording)
            assert dict(describe(recording))["model"]
            notes(recording)
        except Exception as error:
            raise AssertionError(f"{where} is not reported: {error!r}") from error
        for problem in found:
            assert_one_sentence(problem)
        shape = re.search(r"(truth|guess\.world_from_part|world_from_camera) (\(.*\))$", where)
        assert not shape or shape[2] == "(7,)" or any(shape[2] in each for each in found), (where, found)


@pytest.mark.parametrize(
    ("name", "value", "pattern"),
    [
        ("translation", 0.02, "translation is not three finite half widths"),
        ("tilt", np.full(2, 0.1), "the guess's tilt is of type ndarray; give one number, in radians"),
        ("tilt", None, "the guess's tilt is None; give one number, in radians"),
        ("yaw", "0.1", "the guess's yaw is of type str; give one number, in radians"),
    ],
)
def test_a_guess_of_other_shapes_is_one_sentence(name: str, value: Any, pattern: str) -> None:
    guess = replace(full().guess, angle=None, **{name: value})
    found = problems(replace(full(), guess=guess))
    assert len(found) == 1 and re.search(pattern, found[0]), found
    assert_one_sentence(found[0])


@pytest.mark.parametrize(
    ("field", "value", "pattern"),
    [
        ("part", block("block").mesh, "part is of type Trimesh; give a bcppl.Part .*load_mesh"),
        ("part", "x.stl", "part is of type str; give a bcppl.Part"),
        ("peg", "x.stl", "peg is of type str; .* None where nothing is held"),
        ("guess", np.eye(7)[3], "guess is of type ndarray; give a bcppl.Guess"),
        ("measurements", None, "measurements is None; give a list"),
        ("measurements", [View(camera("left"))], "measurement 0 is of type View; give a bcppl.Measurement"),
        ("background", None, "background is None; give images"),
        ("model", None, "model is None; give the name"),
        ("truth", "here", "truth .* is of type str; a pose is seven numbers"),
    ],
)
def test_what_is_of_another_type_is_one_sentence(field: str, value: Any, pattern: str) -> None:
    wrong = replace(full(), **{field: value})
    (found,) = problems(wrong)
    assert re.search(pattern, found)
    assert_one_sentence(found)
    with pytest.raises(InputError, match=re.escape(found)):
        validate(wrong)


def test_describe_lists_what_is_there() -> None:
    rows = dict(describe(full()))
    assert "100.0 × 80.0 × 30.0 mm" in rows["part"] and "closed" in rows["part"]
    assert rows["measurements"] == "3 views, 3 probe windows, 1 push"
    assert rows["camera left"] == "8×6 pixels, 0.06 to 4 m, background known"
    assert "20 Hz" in rows["probe slide"] and rows["truth"] == "known"
    old = replace(full(), source="made up by bcppl, seed 3")  # as earlier versions wrote it
    assert dict(describe(old))["source"] == "simulated by bcppl, seed 3"


@pytest.mark.parametrize("turn", [0.25 * np.pi, -0.25 * np.pi])
def test_a_camera_is_inside_a_long_part_as_the_guess_turns_it(turn: float) -> None:
    beam = block("beam")
    beam = replace(beam, vertices=beam.vertices * [20.0, 1.0, 1.0])  # 2 m along x
    guess = np.array([0.3, 0.1, 0.0, np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
    recording = replace(full(), part=beam, guess=replace(full().guess, world_from_part=guess), truth=None)

    def named(direction: float) -> bool:
        place = guess[:3] + 0.7 * np.array([np.cos(direction), np.sin(direction), 0.0])
        measurement = recording.measurements[2]
        view = replace(measurement.action.camera, world_from_camera=np.r_[place, 0.0, 1.0, 0.0, 0.0])
        there = Measurement(replace(measurement.action, camera=view), measurement.observation)
        measurements = [*recording.measurements[:2], there, *recording.measurements[3:]]
        return any("inside it" in each for each in problems(replace(recording, measurements=measurements)))

    assert named(turn) and not named(-turn)


@pytest.mark.parametrize(
    ("scale", "named"),
    [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds"), (1e-4, "scaled twice")],
)
def test_times_in_another_unit_are_named_once_for_each_clock(scale: float, named: str) -> None:
    def in_unit(each: Any) -> Any:
        """The same object with all its times scaled, those of a probe's windows too."""
        times = [f for f in ("times", "command_times", "stamps") if hasattr(each, f)]
        changes = {f: scale * getattr(each, f) for f in times}
        if isinstance(each, ProbeWindow):
            changes["probe"] = in_unit(each.probe)
        return replace(each, **changes)

    measurements = [Measurement(in_unit(m.action), in_unit(m.observation)) for m in full().measurements]
    found = problems(replace(full(), measurements=measurements))
    assert len(found) == 3 and all(named in each for each in found), found  # two probes, a push
    for problem in found:
        assert_one_sentence(problem)


def test_clocks_may_begin_anywhere_and_be_as_fast_or_slow_as_sensors_are() -> None:
    for step in (2e-5, 2e-3, 0.4):
        assert not list(checks.readings("stamps", 1.8e9 * (step > 1e-3) + step * np.arange(50)))


def test_a_camera_may_have_the_part_partly_behind_it() -> None:
    near = with_measurement(2, world_from_camera=np.array([0.0, 0, 0.08, 1, 0, 0, 0]))
    assert not any("behind" in each for each in problems(near))
    wide = replace(near, guess=replace(near.guess, translation=np.array([0.1, 0.1, 0.7])))
    high = with_measurement(2, world_from_camera=np.array([0.0, 0, 0.6, 1, 0, 0, 0]))
    assert not any("behind" in each for each in problems(replace(high, guess=wide.guess)))


def test_a_short_path_in_millimetres_is_named() -> None:
    recording = full()
    push: Any = recording.measurements[3].action
    path = np.array(push.world_from_tip)
    path[:, :3] = 0.0
    path[-1, 0] = 36.0  # mm, within 100 m of the origin
    measurements = list(recording.measurements)
    measurements[3] = Measurement(replace(push, world_from_tip=path), measurements[3].observation)
    (named,) = [p for p in problems(replace(recording, measurements=measurements)) if "millimetres" in p]
    assert "spans 36 m" in named
