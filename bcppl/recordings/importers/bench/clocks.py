"""How late the wrench's stamps are relative to the pose's."""

from __future__ import annotations

from bcppl.recordings.importers.bench.config import ClockFields, factor
from bcppl.recordings.importers.bench.streams import Stream


def on_one_clock(wrench: Stream, frame: Stream, fields: ClockFields, report: list[str]) -> Stream:
    """The wrench at stamps on the pose's clock."""
    late = factor(fields.unit) * (fields.wrench_late or 0.0)
    return wrench.shifted(-late)
