"""Describes a recording, and checks it before anything is inferred from it: each problem is one sentence."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from importlib.util import find_spec
from pkgutil import iter_modules
from typing import Any

import numpy as np

from bcppl.errors import InputError
from bcppl.geometry.parts import LARGEST_EXTENT, Guess, Part
from bcppl.sensors import checks
from bcppl.sensors.measurements import Measurement, Recording
from bcppl.sensors.protocol import HasNotes, by_sensor, sensor_for, sensors

PART = "a bcppl.Part (`load_mesh` in bcppl.geometry.parts makes one of a mesh file)"
# What a recording's fields have to be, in types and in words.
TYPES: dict[str, tuple[Any, str]] = {
    "part": (Part, PART),
    "guess": (Guess, "a bcppl.Guess"),
    "measurements": (Sequence, "a list of bcppl.Measurement"),
    "peg": (Part | None, f"{PART}, or None where nothing is held"),
    "background": (Mapping, "images of depth by camera name, {} for none"),
    "model": (str, "the name of a model"),
}


def problems(recording: Recording) -> list[str]:
    """Everything that is wrong with a recording, one sentence each; empty where nothing is."""
    return list(_problems(recording))


def validate(recording: Recording, begun: bool = True) -> None:
    """Refuse a recording that has a problem; one that is not `begun` may hold no measurement.

    Raises:
        InputError: the first of `problems`.
    """
    for problem in _problems(recording, begun):
        raise InputError(problem)


def notes(recording: Recording) -> list[str]:
    """Remarks on a recording that do not stop inference, one sentence each."""
    return [] if list(_types(recording)) else list(_notes(recording))


def _notes(recording: Recording) -> Iterator[str]:
    part = recording.part
    if not (_touched(recording) or list(checks.part(part, closed=False)) or part.is_closed):
        yield (
            f"part {part.name!r} has an open mesh, or faces wound both ways: it can be looked at, as here, "
            "but not touched."
        )
    if recording.truth is not None and not (problems(recording) or recording.guess.allows(recording.truth)):
        away = np.linalg.norm(np.asarray(recording.truth)[:3] - recording.guess.world_from_part[:3])
        yield (
            f"the truth, {1e3 * away:.0f} mm from the guess, is impossible by the guess: no belief will "
            "reach it; widen the guess, or see which of the two is wrong."
        )
    guess = recording.guess
    if guess.angle is None and not (guess.tilt or guess.yaw) and np.any(guess.translation):
        yield "the guess holds the part's rotation fixed: unless that is known, give angle, or tilt and yaw."
    known = _installed_models()
    if recording.model not in known:
        close = get_close_matches(recording.model, known, 1)
        yield (
            f"the recording names the model {recording.model!r}, which is not installed"
            f"{f' ({close[0]!r} is)' if close else ''}: give your own file with --model where it is run."
        )
    for sensor, measurements in by_sensor(recording.measurements):
        if isinstance(sensor, HasNotes):
            yield from sensor.notes([measurement for _, measurement in measurements], recording)


def _installed_models() -> list[str]:
    """The names under which the command line finds models that data names; none of them is imported."""
    found = find_spec("bcppl.models")
    folders = found.submodule_search_locations if found is not None else None
    return [info.name for info in iter_modules(folders) if not info.ispkg]


def _touched(recording: Recording) -> bool:
    return any(sensor.contact for sensor, _ in by_sensor(recording.measurements))


def _problems(recording: Recording, begun: bool = True) -> Iterator[str]:
    if wrong_types := list(_types(recording)):
        yield from wrong_types
        return
    yield from checks.part(recording.part, closed=_touched(recording))
    if recording.peg is not None:
        yield from checks.part(recording.peg, closed=True)
    yield from _guess(recording.guess)
    if recording.truth is not None:
        yield from checks.pose("the truth (world_from_part)", recording.truth)
    if recording.model.endswith(".py") or "/" in recording.model:
        yield (
            f"the recording names the file {recording.model!r} as its model; name an installed model, and "
            "give a file of your own where the recording is run."
        )
    if begun and not recording.measurements:
        kinds = ", ".join(sensor.names[0] for sensor in sensors())
        yield f"the recording holds no measurement; record at least one ({kinds})."
    wrong = list(_strays(recording))
    for sensor, measurements in by_sensor(recording.measurements):
        try:
            wrong += sensor.problems(measurements, recording)
        except (TypeError, ValueError):  # of numbers that are none, which a sensor need not expect
            problem = (
                f"the {sensor.names[1]} cannot be checked, for a field of one is of another type than the "
                "sensor reads; give numbers and arrays of them."
            )
            wrong.append((measurements[0][0], problem))
    for _, problem in sorted(wrong, key=lambda each: each[0]):
        yield problem


def _types(recording: Recording) -> Iterator[str]:
    """What is of another type than the rest of the checks, and everything after them, can read."""
    for name, (type_, wanted) in TYPES.items():
        if not isinstance(value := getattr(recording, name), type_):
            yield f"the recording's {name} is {_kind(value)}; give {wanted}."
    for name, body in (("part", recording.part), ("peg", recording.peg)):
        for field in ("vertices", "faces"):
            if isinstance(body, Part) and not isinstance(array := getattr(body, field), np.ndarray):
                yield f"the {name}'s {field} are {_kind(array)}; give a NumPy array."
    if isinstance(recording.measurements, Sequence):
        for index, each in enumerate(recording.measurements):
            if not isinstance(each, Measurement):
                pair = "give a bcppl.Measurement of an action and its observation"
                yield f"measurement {index} is {_kind(each)}; {pair}."


def _kind(value: object) -> str:
    return "None" if value is None else f"of type {type(value).__name__}"


def _strays(recording: Recording) -> Iterator[tuple[int, str]]:
    """Problems of measurements that no sensor checks."""
    for index, measurement in enumerate(recording.measurements):
        try:
            sensor_for(measurement)
        except InputError as error:
            yield index, f"measurement {index}: {error}"


def _guess(guess: Guess) -> Iterator[str]:
    yield from checks.pose("the guess (world_from_part)", guess.world_from_part)
    widths = np.asarray(guess.translation)
    if widths.shape != (3,) or not np.isfinite(widths).all():
        yield "the guess's translation is not three finite half widths; give them in metres along x, y and z."
    elif (widths < 0).any():
        yield f"the guess has a negative half width ({widths.min():.4g} m); give 0 to hold an axis fixed."
    elif (widths > LARGEST_EXTENT).any():
        yield f"the guess is {widths.max():.4g} m wide, probably in millimetres; scale it by 0.001 to metres."
    for name in ("tilt", "yaw", "angle"):
        limit: Any = getattr(guess, name)
        if limit is None and name == "angle":
            continue
        if not hasattr(limit, "__float__") or np.ndim(limit) != 0:
            yield f"the guess's {name} is {_kind(limit)}; give one number, in radians."
        elif not math.isfinite(limit) or limit < 0:
            yield f"the guess's {name} is {limit:.4g}; give a limit of at least 0, in radians."
        elif limit > math.pi + 1e-9:
            yield f"the guess's {name} is {limit:.4g} rad, probably degrees; give radians below pi."


def describe(recording: Recording) -> list[tuple[str, str]]:
    """Rows (what, value) about a recording, in the order in which people ask; it may have problems."""
    rows = [("part", _described_part(recording.part))]
    if recording.peg is not None:
        rows.append(("peg", _described_part(recording.peg)))
    groups = by_sensor(recording.measurements)
    counts = [f"{len(each)} {sensor.names[len(each) > 1]}" for sensor, each in groups]
    rows += [("prior", _described_guess(recording.guess)), ("measurements", ", ".join(counts) or "none")]
    for sensor, measurements in groups:
        rows += sensor.describe([measurement for _, measurement in measurements], recording)
    rows.append(("truth", "known" if recording.truth is not None else "unknown"))
    rows.append(("model", recording.model))
    source = recording.source.replace(
        "made up by bcppl", "simulated by bcppl"
    )  # as earlier versions wrote it
    rows.append(("source", source or "not stated"))
    return rows


def _described_part(part: Part) -> str:
    rows = part.vertices.shape[1:], part.faces.shape[1:]
    if rows != ((3,), (3,)) or len(part.vertices) == 0 or len(part.faces) == 0:
        return f"{part.name}, empty mesh"
    size = " × ".join(f"{1e3 * side:.1f}" for side in part.extent)
    closed = "closed" if part.is_closed else "open"
    pieces = f", convex pieces: {len(part.pieces)}" if part.pieces else ""
    return f"{part.name}, {size} mm, {len(part.faces)} triangles, {closed}{pieces}"


def _described_guess(guess: Guess) -> str:
    widths = " × ".join(f"{1e3 * width:g}" for width in np.ravel(guess.translation))
    if guess.angle is not None:
        return f"±{widths} mm, any rotation within {math.degrees(guess.angle):.3g}°"
    return f"±{widths} mm, tilt up to {math.degrees(guess.tilt):.3g}°, yaw ±{math.degrees(guess.yaw):.3g}°"
