"""Wrenches as a sensor or a controller logs them, in the peg's frame about its origin, on the peg."""

from __future__ import annotations

import numpy as np

from bcppl.arrays import Array
from bcppl.contact.sensing import transform_wrench
from bcppl.recordings.importers.bench.configuration.field_types import factor
from bcppl.recordings.importers.bench.configuration.fields import WrenchFields
from bcppl.recordings.importers.bench.in_order import read_stream
from bcppl.recordings.importers.bench.pose_columns import composed, inverted
from bcppl.recordings.importers.bench.sources import Log
from bcppl.recordings.streams import Stream

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


def read_wrench(fields: WrenchFields, log: Log, report: list[str]) -> Stream:
    """The stream of wrenches (T, 6), N and N m, of the environment on the peg, in the axes of the log.

    Raises:
        InputError: as `read_stream`.
    """
    stream = read_stream("wrench", fields, log, report)
    sign = 1.0 if fields.sign == "on_peg" else -1.0
    units = np.array([factor(fields.force)] * 3 + [factor(fields.torque)] * 3)
    return Stream("wrench", stream.times, sign * units * stream.values)


def wrench_on_peg(
    wrench: Array,
    fields: WrenchFields,
    base_from_frame: Array,
    frame_from_peg: Array,
    frame_from_sensor: Array,
) -> Array:
    """Wrenches (T, 6) in the peg's frame about its origin.

    Args:
        wrench: (T, 6) in the axes and about the point of the log.
        fields: which those are.
        base_from_frame: (T, 7) at the same stamps.
        frame_from_peg: (7,).
        frame_from_sensor: (7,).
    """
    frame_from = {"sensor": frame_from_sensor, "frame": IDENTITY, "peg": frame_from_peg}
    if "base" not in (fields.axes, fields.about):
        axes = frame_from[fields.axes].copy()
        axes[:3] = frame_from[fields.about][:3]
        return transform_wrench(wrench, composed(inverted(frame_from_peg), axes))
    base = np.broadcast_to(IDENTITY, base_from_frame.shape)
    axes, about = (
        base if each == "base" else composed(base_from_frame, frame_from[each])
        for each in (fields.axes, fields.about)
    )
    base_from_wrench = np.concatenate([about[:, :3], axes[:, 3:]], axis=1)
    peg_from_base = inverted(composed(base_from_frame, frame_from_peg))
    return transform_wrench(wrench, composed(peg_from_base, base_from_wrench))
