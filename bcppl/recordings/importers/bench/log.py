"""A bench's log, step by step: streams, clocks, common stamps, wrenches on the peg, probes, views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.recordings.importers import Imported
from bcppl.recordings.importers.bench.bodies import read_guess, read_part, read_peg
from bcppl.recordings.importers.bench.clocks import on_one_clock
from bcppl.recordings.importers.bench.configuration.field_types import PoseFields
from bcppl.recordings.importers.bench.configuration.fields import (
    BenchFields,
    GravityFields,
    WrenchFields,
)
from bcppl.recordings.importers.bench.configuration.reading import read_configuration
from bcppl.recordings.importers.bench.contacts import STEP
from bcppl.recordings.importers.bench.cutting import Command, Rows, probes
from bcppl.recordings.importers.bench.gravity import without_weight
from bcppl.recordings.importers.bench.pose_columns import (
    composed,
    inverted,
    read_joints,
    read_poses,
    stated_pose,
)
from bcppl.recordings.importers.bench.sources import Files, Log
from bcppl.recordings.importers.bench.views import placed, read_views
from bcppl.recordings.importers.bench.wrenches import IDENTITY, read_wrench, wrench_on_peg
from bcppl.recordings.streams import Stream, common_stamps, is_known, poses_at, values_at
from bcppl.sensors import Measurement, Recording

_LEAST_SHARED = 1.0  # s that wrench and pose share, or their clocks cannot be compared
_ROWS = 20_000  # of which frames are changed at once
_LONGEST_HOLE = 600.0  # s without a row: stamps every half millisecond of longer ones take gigabytes
_FREE = 0.1  # s in free air with which a log begins


def imported(path: Path, open_log: Callable[[BenchFields], Log] | None = None) -> Imported:
    """The recording of the log that a configuration describes, and a report.

    Args:
        path: of the configuration.
        open_log: what the fields' streams and images are read from; by default files in its folder.

    Raises:
        InputError: the configuration or a file that it names is missing or wrong, or the streams do not fit.
    """
    fields, folder, report = read_configuration(path), path.parent, list[str]()
    part = read_part(fields.part, folder, report)
    peg = None if fields.peg is None else read_peg(fields.peg, folder, report)
    log = Files(folder) if open_log is None else open_log(fields)
    frame = _poses(fields, log, report)
    touches: list[Measurement] = []
    if fields.wrench is not None and frame is not None:
        touches = _touches(fields, fields.wrench, log, frame, report)
    views: list[Measurement] = []
    background: dict[str, Array] = {}
    for name, camera in fields.cameras.items():
        seen, empty = read_views(name, camera, log, frame, report)
        views += seen
        background |= empty
    recording = Recording(
        part=part,
        guess=read_guess(fields.guess),
        measurements=[*views, *touches],
        peg=peg,
        background=background,
        truth=None if fields.truth is None else stated_pose("truth", fields.truth),
        model=fields.model,
        source=fields.source or f"bench log, {path.name}",
    )
    return Imported(recording, tuple(report))


def _poses(fields: BenchFields, log: Log, report: list[str]) -> Stream | None:
    """`world_from_frame` (T, 7), on the clock of its log; None where nothing was on the robot."""
    world_from_base = stated_pose("world_from_base", fields.world_from_base)
    if fields.joints is not None:
        return placed(read_joints(fields.joints, log, report), world_from_base)
    if fields.pose is None:
        return None
    return placed(read_poses("pose", fields.pose, log, report), world_from_base)


def _touches(
    fields: BenchFields, felt_by: WrenchFields, log: Log, frame: Stream, report: list[str]
) -> list[Measurement]:
    """The windows of the log's probes; their stamps count from the first pose."""
    mounting = _Mounting.of(fields, felt_by)
    start = float(frame.times[0])
    frame = frame.shifted(-start)
    wrench = read_wrench(felt_by, log, report).shifted(-start)
    for stream in (frame, wrench):
        _refuse_holes(stream)
    wrench = on_one_clock(wrench, *_motion(wrench, frame, mounting), fields.clock, report)
    stamps = common_stamps(frame, wrench, fields.cut.rate)
    if len(stamps) < 2:
        raise InputError(
            f"the wrench lasts from {wrench.times[0]:.1f} to {wrench.times[-1]:.1f} s of the pose's "
            f"log, which lasts {frame.times[-1]:.1f} s: their clocks differ; state clock.wrench_late."
        )
    known = is_known(frame, stamps, fields.cut.gap) & is_known(wrench, stamps, fields.cut.gap)
    felt, world_from_peg, words = mounting.felt(wrench, frame, stamps)
    step = float(stamps[1] - stamps[0])
    both = f"{float(stamps[-1] - stamps[0]):.4g} s, of {frame.times[-1]:.4g} s of poses"
    report += [words, f"common stamps: {len(stamps)} at {1.0 / step:.4g} Hz over {both}"]
    command = _command(fields, log, start, mounting.frame_from_peg, report)
    return probes(Rows(stamps, felt, world_from_peg, known), fields.cut, fields.arm, command, report)


def _refuse_holes(stream: Stream) -> None:
    """Refuse a stream whose clock was set forward, or that paused for long."""
    steps = np.diff(stream.times)
    longest = int(steps.argmax())
    if steps[longest] > _LONGEST_HOLE:
        raise InputError(
            f"{stream.name} has no row for {steps[longest]:.6g} s, after {longest + 1} rows; cut the log "
            "there, where its clock was set or the arm paused."
        )


@dataclass(frozen=True, eq=False)
class _Mounting:
    """Where peg and sensor are on the robot's frame, and the base in the world."""

    gravity: GravityFields
    wrench: WrenchFields
    world_from_base: Array
    frame_from_peg: Array
    frame_from_sensor: Array

    @classmethod
    def of(cls, fields: BenchFields, wrench: WrenchFields) -> _Mounting:
        return cls(
            fields.gravity,
            wrench,
            stated_pose("world_from_base", fields.world_from_base),
            _stated("frame_from_peg", fields.frame_from_peg),
            _stated("frame_from_sensor", fields.frame_from_sensor),
        )

    def felt(self, wrench: Stream, frame: Stream, stamps: Array) -> tuple[Array, Array, str]:
        """The wrench on the peg (T, 6) without weight, the peg's pose (T, 7), and words about the weight."""
        world_from_frame = poses_at(frame, stamps)
        on_peg = values_at(wrench, stamps)
        world_from_peg = np.empty_like(world_from_frame)
        sides = self.frame_from_peg, self.frame_from_sensor
        base_from_world = inverted(self.world_from_base)
        for first in range(0, len(stamps), _ROWS):  # all at once, ten minutes at 1 kHz took 400 MB
            rows = slice(first, first + _ROWS)
            base_from_frame = composed(base_from_world, world_from_frame[rows])
            on_peg[rows] = wrench_on_peg(on_peg[rows], self.wrench, base_from_frame, *sides)
            world_from_peg[rows] = composed(world_from_frame[rows], self.frame_from_peg)
        peg_from_sensor = composed(inverted(self.frame_from_peg), self.frame_from_sensor)
        felt, words = without_weight(on_peg, world_from_peg, stamps, self.gravity, peg_from_sensor)
        return felt, world_from_peg, words


def _motion(wrench: Stream, frame: Stream, mounting: _Mounting) -> tuple[Stream | None, Stream]:
    """The force on the peg in the world's axes, and the peg's position, each on its own clock.

    The wrench is turned by the pose at the same stamps as if the clocks agreed: in their difference an arm
    does not turn by as much as matters to when its force begins.
    """
    position = Stream(
        "position", frame.times, composed(frame.values, mounting.frame_from_peg[None])[:, :3].copy()
    )
    begin, end = max(wrench.times[0], frame.times[0]), min(wrench.times[-1], frame.times[-1])
    stamps = np.arange(begin, end, STEP)
    if len(stamps) * STEP < _LEAST_SHARED:
        return None, position
    felt, world_from_peg, _ = mounting.felt(wrench, frame, stamps)
    free = felt[: round(_FREE / STEP), :3].mean(axis=0)
    turned = Rotation.from_quat(world_from_peg[:, [4, 5, 6, 3]]).apply(felt[:, :3] - free)
    return Stream("force", stamps, turned), position


def _command(
    fields: BenchFields, log: Log, start: float, frame_from_peg: Array, report: list[str]
) -> Command | None:
    if fields.command is None:
        report.append("command: none logged; the measured poses stand for it")
        return None
    stream = read_poses("command", fields.command, log, report)
    world_from_base = stated_pose("world_from_base", fields.world_from_base)
    return Command(stream.times - start, composed(composed(world_from_base, stream.values), frame_from_peg))


def _stated(name: str, fields: PoseFields | None) -> Array:
    return np.array(IDENTITY) if fields is None else stated_pose(name, fields)
