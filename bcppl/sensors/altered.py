"""Recordings as they would be if something about their probes were otherwise than it was written down.

    on_time = with_wrench_earlier(recording, 0.2)  # if the wrench was read 0.2 s late

Inference on such a recording is inference under that hypothesis. Measurements other than of probes stay.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from bcppl import poses
from bcppl.arrays import Array
from bcppl.contact.touch import Touch
from bcppl.errors import InputError
from bcppl.geometry.parts import Part, Piece
from bcppl.robot.motion import ProbeWindow
from bcppl.sensors.measurements import Measurement, Recording


def with_wrench_earlier(recording: Recording, seconds: float) -> Recording:
    """Each wrench by so many seconds earlier, later if negative, at the nearest stamp; its ends repeat."""

    def earlier(touch: Touch) -> Touch:
        middles = 0.5 * (touch.times[1:] + touch.times[:-1])
        return replace(touch, wrench=touch.wrench[np.searchsorted(middles, touch.times + seconds)])

    return _probed(recording, earlier)


def with_wrench_reversed(recording: Recording) -> Recording:
    """Forces and torques with the other sign, as of the peg on its environment."""
    return _probed(recording, lambda touch: replace(touch, wrench=-touch.wrench))


def with_peg_along(recording: Recording, metres: float) -> Recording:
    """The peg farther along its own z axis than measured; its wrench stays as it was measured."""

    def along(touch: Touch) -> Touch:
        measured = torch.from_numpy(touch.world_from_peg)
        tip = torch.tensor([0.0, 0.0, metres], dtype=torch.float64)
        place = poses.transform(measured, tip[None])[:, 0]
        return replace(touch, world_from_peg=torch.cat([place, measured[:, 3:]], dim=1).numpy())

    return _probed(recording, along)


def with_peg_turned(recording: Recording, angle: float) -> Recording:
    """The peg turned about its own z axis from where it was measured, radians; the wrench in its new axes."""
    twist = torch.zeros(6, dtype=torch.float64)
    twist[5] = angle
    turn = poses.retract(poses.identity(), twist)
    axes = poses.rotation_matrix(turn).numpy()

    def turned(touch: Touch) -> Touch:
        pose = poses.compose(torch.from_numpy(touch.world_from_peg), turn).numpy()
        wrench = np.hstack([touch.wrench[:, :3] @ axes, touch.wrench[:, 3:] @ axes])
        return replace(touch, wrench=wrench, world_from_peg=pose)

    return _probed(recording, turned)


def with_peg_thicker(recording: Recording, metres: float) -> Recording:
    """The peg wider across its z axis by so much, thinner if negative: its x and y by one factor.

    Raises:
        InputError: there is no peg, or it would have no width left.
    """
    if recording.peg is None:
        raise InputError("the recording has no peg that could be thicker; add the peg that was held.")
    width = 2.0 * float(np.abs(recording.peg.vertices[:, :2]).max())
    if width + metres <= 0.0:
        raise InputError(f"a peg {1e3 * width:.3g} mm wide cannot be thinner by {-1e3 * metres:.3g} mm.")
    factor = np.array([(width + metres) / width] * 2 + [1.0])
    return replace(recording, peg=_stretched(recording.peg, factor))


def _stretched(part: Part, factor: Array) -> Part:
    """The part stretched along its axes by factors (3,), the first two alike."""
    pieces = []
    for piece in part.pieces:
        by = factor[[0, 2]] if piece.kind == "cylinder" else factor
        pieces.append(Piece(piece.kind, piece.size * by, piece.center * factor))
    return replace(part, vertices=part.vertices * factor, pieces=tuple(pieces))


def _probed(recording: Recording, altered: Callable[[Touch], Touch]) -> Recording:
    """The recording with what each probe's windows observe, taken together, as it would be."""
    measurements = list(recording.measurements)
    by_probe: dict[str, list[int]] = {}
    for k, measurement in enumerate(measurements):
        if isinstance(measurement.action, ProbeWindow):
            by_probe.setdefault(measurement.action.probe.name, []).append(k)
    for numbers in by_probe.values():
        touches = [measurements[k].observation for k in numbers]
        columns = ("times", "wrench", "world_from_peg")
        whole = altered(Touch(*(np.concatenate([getattr(t, c) for t in touches]) for c in columns)))
        ends = np.cumsum([len(touch.times) for touch in touches])[:-1]
        each = zip(*(np.split(getattr(whole, column), ends) for column in columns), strict=True)
        for k, own in zip(numbers, each, strict=True):
            measurements[k] = Measurement(measurements[k].action, Touch(*own))
    return replace(recording, measurements=measurements)
