"""The rows of a log's streams in order of their stamps, and what was wrong with the stamps."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import get_args

import numpy as np

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.recordings.importers.bench.configuration.field_types import Time, factor
from bcppl.recordings.importers.bench.configuration.fields import StreamFields
from bcppl.recordings.importers.bench.sources import Log
from bcppl.recordings.streams import Stream
from bcppl.sensors import checks

USUAL = 0.005  # s between stamps
LOST = 1.5  # median intervals: a longer one has lost rows
MOST_BACKWARDS = 0.01  # of the rows: more are no few messages that came late


def read_stream(name: str, fields: StreamFields, log: Log, report: list[str]) -> Stream:
    """The rows of a stream in order; rows without a number, repeated and backward stamps are left out.

    Raises:
        InputError: the file cannot be read, fewer than ten rows remain, the clock runs backwards at more than
            a percent of them, or the stamps are in another unit.
    """
    table, notes = log.rows(name, fields)
    stream, left_out = _in_order(name, table[:, 0], table[:, 1:])
    for problem in checks.readings(f"{name}'s stamps", stream.times):
        if fields.topic:
            raise InputError(f"{problem.rstrip('.')} (see the header stamps of {fields.topic}).")
        unit = fields.time.unit
        step = stream.step / factor(unit)
        likely = min(get_args(Time), key=lambda each: abs(math.log(step * factor(each) / USUAL)))
        other = f"; probably they are in {likely}: state {name}.time.unit" if likely != unit else ""
        raise InputError(
            f"{name}'s stamps are {step:.4g} {unit} apart ({stream.step:.4g} s), as of no sensor{other}."
        )
    left_out = [*notes, *left_out]
    report.append(f"{_described(stream)}{''.join(f'; {each}' for each in left_out)}")
    return stream


def _in_order(name: str, times: Array, values: Array) -> tuple[Stream, list[str]]:
    left_out = []
    finite = np.isfinite(times) & np.isfinite(values).all(axis=1)
    if not finite.all():
        left_out.append(f"{_rows(int((~finite).sum()))} with a number that is not finite left out")
        times, values = times[finite], values[finite]
    if len(times):
        latest = np.maximum.accumulate(times)
        # A stamp repeats if it is the latest before it, and runs backwards if it is earlier than that.
        repeated = np.append(False, times[1:] == latest[:-1])
        backwards = np.append(False, times[1:] < latest[:-1])
        if backwards.mean() > MOST_BACKWARDS:
            row = checks.first(backwards)
            raise InputError(
                f"{name}'s stamps run backwards at {_rows(int(backwards.sum()))}, first from "
                f"{latest[row - 1]:.6f} to {times[row]:.6f} s; cut the log where its clock was set."
            )
        if repeated.any():
            left_out.append(
                f"{_rows(int(repeated.sum()))} with a repeated stamp left out{_other(values, repeated)}"
            )
        if backwards.any():
            left_out.append(f"{_rows(int(backwards.sum()))} with a stamp before an earlier one left out")
        times, values = times[~(repeated | backwards)], values[~(repeated | backwards)]
    if len(times) < 10:
        raise InputError(f"{name} has {len(times)} usable rows; give a log of ten or more.")
    return Stream(name, times, values), left_out


def _other(values: Array, repeated: Array) -> str:
    """Words on repeated rows that contradict those before them."""
    other = int((values[1:] != values[:-1]).any(axis=1)[repeated[1:]].sum())
    return f" ({other} of other values: its clock is coarse, or it has two sources)" if other else ""


def _described(stream: Stream) -> str:
    span = stream.times[-1] - stream.times[0]
    words = f"{stream.name}: {len(stream.times)} rows at {stream.rate:.4g} Hz over {span:.2f} s"
    return "".join([words, *_gaps(stream)])


def _gaps(stream: Stream) -> Iterator[str]:
    steps = np.diff(stream.times)
    gaps = steps > LOST * stream.step
    if gaps.any():
        lost = int(np.round(steps[gaps] / stream.step - 1.0).sum())
        longest = int(steps.argmax())
        at = stream.times[longest] - stream.times[0]
        yield (
            f"; {_rows(lost)} lost in {int(gaps.sum())} gaps, the longest {1000.0 * steps[longest]:.0f} ms "
            f"at {at:.2f} s"
        )
    held = float((np.diff(stream.values, axis=0) == 0.0).all(axis=1).mean())
    if held > 0.3:
        yield f"; {100.0 * held:.0f} % of the rows repeat the one before: it is slower, or stands still"


def _rows(count: int) -> str:
    return f"{count} row{'' if count == 1 else 's'}"
