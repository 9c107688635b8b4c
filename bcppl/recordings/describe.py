"""Describes a recording in a few rows."""

from __future__ import annotations

import math

import numpy as np

from bcppl.geometry.parts import Guess, Part
from bcppl.sensors.measurements import Recording
from bcppl.sensors.protocol import by_sensor


def describe(recording: Recording) -> list[tuple[str, str]]:
    """Rows (what, value) about a recording, in the order in which people ask; it may have problems."""
    rows = [("part", _part(recording.part))]
    if recording.peg is not None:
        rows.append(("peg", _part(recording.peg)))
    groups = by_sensor(recording.measurements)
    counts = [f"{len(each)} {sensor.names[len(each) > 1]}" for sensor, each in groups]
    rows += [("prior", _guess(recording.guess)), ("measurements", ", ".join(counts) or "none")]
    for sensor, measurements in groups:
        rows += sensor.describe([measurement for _, measurement in measurements], recording)
    rows.append(("truth", "known" if recording.truth is not None else "unknown"))
    rows.append(("model", recording.model))
    rows.append(("source", recording.source or "not stated"))
    return rows


def _part(part: Part) -> str:
    if part.vertices.ndim != 2 or len(part.vertices) == 0 or len(part.faces) == 0:
        return f"{part.name}, empty mesh"
    size = " × ".join(f"{1e3 * side:.1f}" for side in part.extent)
    closed = "closed" if part.is_closed else "open"
    pieces = f", convex pieces: {len(part.pieces)}" if part.pieces else ""
    return f"{part.name}, {size} mm, {len(part.faces)} triangles, {closed}{pieces}"


def _guess(guess: Guess) -> str:
    widths = " × ".join(f"{1e3 * width:g}" for width in np.ravel(guess.translation))
    if guess.angle is not None:
        return f"±{widths} mm, any rotation within {math.degrees(guess.angle):.3g}°"
    return f"±{widths} mm, tilt up to {math.degrees(guess.tilt):.3g}°, yaw ±{math.degrees(guess.yaw):.3g}°"
