"""Says in a few rows what a recording holds."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from bcppl.contact.touch import Touch
from bcppl.geometry.guess import Guess
from bcppl.geometry.parts import Part
from bcppl.robot.motion import ProbeWindow
from bcppl.sensors.measurements import Push, Recording, View

Array = npt.NDArray[np.float64]


def describe(recording: Recording) -> list[tuple[str, str]]:
    """Rows (what, value) about a recording, in the order in which people ask; it may have problems."""
    rows = [("part", _part(recording.part))]
    if recording.peg is not None:
        rows.append(("peg", _part(recording.peg)))
    rows += [("prior", _guess(recording.guess)), ("measurements", _count(recording))]
    actions = [m.action for m in recording.measurements]
    cameras = {a.camera.name: a.camera for a in actions if isinstance(a, View)}
    for name, camera in cameras.items():
        seen = f"{camera.width}×{camera.height} pixels, {camera.near:g} to {camera.far:g} m"
        known = "background known" if name in recording.background else "background unknown"
        rows.append((f"camera {name}", f"{seen}, {known}"))
    probes = {a.probe.name: a.probe for a in actions if isinstance(a, ProbeWindow)}
    for name, probe in probes.items():
        rows.append((f"probe {name}", f"{_span(probe.stamps):.2f} s, stamps at {_rates([probe.stamps])}"))
    touches = [m.observation for m in recording.measurements if isinstance(m.observation, Touch)]
    if touches:
        total = sum(_span(touch.times) for touch in touches)
        rate = _rates([touch.times for touch in touches])
        rows.append(("touching", f"{total:.1f} s, wrench at {rate}"))
    pushes = [a for a in actions if isinstance(a, Push)]
    if pushes:
        rows.append(("finger path", f"at {_rates([push.times for push in pushes])}"))
    rows.append(("truth", "known" if recording.truth is not None else "unknown"))
    rows.append(("model", recording.model))
    rows.append(("source", recording.source or "not stated"))
    return rows


def _part(part: Part) -> str:
    if part.vertices.ndim != 2 or len(part.vertices) == 0 or len(part.faces) == 0:
        return f"{part.name}, empty mesh"
    size = " × ".join(f"{1e3 * side:.1f}" for side in part.extent)
    closed = "closed" if part.mesh.is_watertight else "open"
    pieces = f", convex pieces: {len(part.pieces)}" if part.pieces else ""
    return f"{part.name}, {size} mm, {len(part.faces)} triangles, {closed}{pieces}"


def _guess(guess: Guess) -> str:
    widths = " × ".join(f"{1e3 * width:g}" for width in np.ravel(guess.translation))
    if guess.angle is not None:
        return f"±{widths} mm, any rotation within {math.degrees(guess.angle):.3g}°"
    return f"±{widths} mm, tilt up to {math.degrees(guess.tilt):.3g}°, yaw ±{math.degrees(guess.yaw):.3g}°"


def _count(recording: Recording) -> str:
    kinds = [m.kind for m in recording.measurements]
    names = {
        "view": ("view", "views"),
        "window": ("probe window", "probe windows"),
        "push": ("push", "pushes"),
    }
    found = [f"{kinds.count(k)} {names[k][kinds.count(k) > 1]}" for k in names if k in kinds]
    return ", ".join(found) or "none"


def _span(times: Array) -> float:
    return float(times[-1] - times[0]) if times.size else 0.0


def _rates(series: list[Array]) -> str:
    steps = np.concatenate([np.diff(times) for times in series])
    middle = float(np.median(steps)) if steps.size else 0.0
    return f"{1 / middle:.0f} Hz" if middle > 0 else "an unknown rate"
