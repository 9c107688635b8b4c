"""Probes: a held peg is moved compliantly, and its wrench and pose are read window by window."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bcppl import poses
from bcppl.arrays import Array
from bcppl.contact.touch import Touch
from bcppl.geometry.parts import Part
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.robot.plan import Plan, probe_of
from bcppl.sensors import checks, touches
from bcppl.sensors.layout import COUNT, POSE_UNITS, TEXT, WORDS, Layout, number, numbers, shared
from bcppl.sensors.measurements import Measurement, Recording
from bcppl.sensors.protocol import FAINT, Indexed, register

__all__ = ["Plan", "Probe", "ProbeSensor", "ProbeWindow", "Touch"]

SAME_TIME = 1e-6  # s: two clocks that were copied agree to this
STIFFNESS = numbers("N/m N/m N/m N m/rad N m/rad N m/rad")
DAMPING = numbers("N s/m N s/m N s/m N m s/rad N m s/rad N m s/rad")
COLOURS = {"free": "#56B4E9", "guarded": "#D55E00", "held": "#CC79A7", "searching": "#009E73"}

PROBE = Layout(
    Probe,
    {
        "command_times": numbers("s"),
        "command": numbers(POSE_UNITS),
        "stiffness": STIFFNESS,
        "damping": DAMPING,
        "stamps": numbers("s"),
    },
    keys={"command": "command_world_from_peg"},
)


class ProbeSensor:
    """Windows of probes with a held peg, each observed as a touch; planned as plans."""

    kind = "window"
    names = ("probe window", "probe windows")
    contact = True
    action = Layout(ProbeWindow, {"probe": shared("probes", PROBE), "first": COUNT, "last": COUNT})
    observation = touches.TOUCH

    candidate_kind = "plan"
    needs_peg = True
    caption = "the tip's path as commanded, as if nothing were met"
    candidate = Layout(
        Plan,
        {
            "name": TEXT,
            "manners": WORDS,
            "times": numbers("s"),
            "world_from_peg": numbers(POSE_UNITS),
            "force": number("N"),
            "stiffness": STIFFNESS,
            "damping": DAMPING,
            "rate": number("1/s"),
            "sink": number("m"),
        },
        optional={"rate": 1, "sink": 1},
        about=(
            "Poses are x y z qw qx qy qz in the world; world_from_peg is the peg's frame, its tip at its "
            "lowest z. manners[k] is how pose k is left for pose k + 1, from times[k] to times[k + 1]: free "
            "(as commanded), guarded (until a force of `force` is felt; the rest of that motion then stays "
            "undone), held (pressed on, as planned but for that rest) or searching (held, until the peg has "
            "sunk by `sink`). stiffness, damping are of the arm along, then about, the commanded peg's axes; "
            "rate is of the measurements."
        ),
    )

    def problems(self, measurements: Indexed, recording: Recording) -> Iterator[tuple[int, str]]:
        """Problems of probes, of how they are cut into windows, and of peg poses and wrenches."""
        probes: dict[str, Probe] = {}
        ends: dict[str, int] = {}
        for index, measurement in measurements:
            where, window = f"measurement {index}", measurement.action
            name = window.probe.name
            wrong = [] if name in probes else list(_probe(f"{where}: probe {name!r}", window.probe))
            wrong += checks.named_alike(where, "probe", window.probe, probes)
            wrong += _touch(where, measurement.observation)
            wrong += _window(where, window, measurement.observation, ends.get(name, 0))
            ends[name] = max(window.last, ends.get(name, 0))
            if recording.peg is None:
                yield index, f"{where} is a probe window but the recording has no peg; add the held peg."
            yield from ((index, problem) for problem in wrong)

    def notes(self, measurements: Sequence[Measurement], recording: Recording) -> Iterator[str]:
        """A remark where no wrench was measured."""
        yield from touches.notes([m.observation for m in measurements])

    def describe(self, measurements: Sequence[Measurement], recording: Recording) -> list[tuple[str, str]]:
        """Each probe's length and rate, and those of all windows together."""
        probes = {m.action.probe.name: m.action.probe.stamps for m in measurements}
        rows = [
            (f"probe {name}", f"{touches.span(stamps):.2f} s, stamps at {touches.rate([stamps])}")
            for name, stamps in probes.items()
        ]
        return [*rows, ("touching", touches.length([m.observation for m in measurements]))]

    # ---- windows are parts of a probe

    def follows(self, measurement: Measurement, before: Sequence[Measurement]) -> bool:
        """Whether a window begins its probe, or where the newest of its probe ends."""
        window = measurement.action
        same = (m.action for m in reversed(before) if isinstance(m.action, ProbeWindow))
        newest = next((each for each in same if each.probe.name == window.probe.name), None)
        return bool(window.first <= (0 if newest is None else newest.last))

    def joined(self, first: Measurement, second: Measurement) -> Measurement | None:
        """Two windows of a probe as one, by the later one's command; the first if the other adds nothing."""
        one, other = first.action, second.action
        if one.probe.name != other.probe.name:
            return None
        if other.last <= one.last:
            return first
        if other.first != one.last:
            return None
        fields = ("times", "wrench", "world_from_peg")
        both = [[getattr(m.observation, name) for m in (first, second)] for name in fields]
        window = ProbeWindow(other.probe, one.first, other.last)
        return Measurement(window, Touch(*map(np.concatenate, both)))

    def alone(self, measurement: Measurement) -> Measurement:
        """A window as the whole of a probe."""
        window = measurement.action
        probe = replace(window.probe, stamps=window.probe.stamps[window.first : window.last])
        return Measurement(ProbeWindow(probe, 0, window.last - window.first), measurement.observation)

    # ---- candidates: plans

    def action_of(self, candidate: Plan) -> ProbeWindow:
        """A plan as one window, of which nothing is stopped."""
        probe = probe_of(candidate)
        return ProbeWindow(probe, 0, len(probe.stamps))

    def name_of(self, candidate_or_action: Plan | ProbeWindow) -> str:
        """A plan's name, or a window's probe's."""
        if isinstance(candidate_or_action, Plan):
            return candidate_or_action.name
        return candidate_or_action.probe.name

    def renamed(self, candidate: Plan, name: str) -> Plan:
        """The same plan under another name."""
        return replace(candidate, name=name)

    def motion(self, candidate: Plan) -> Plan:
        """The plan itself."""
        return candidate

    def duration(self, candidate: Plan) -> float:
        """Seconds from a plan's first knot to its last."""
        return float(candidate.times[-1] - candidate.times[0])

    def draw(
        self, axes: Any, candidate: Plan, mean: Array, peg: Part | None, *, faint: bool = False
    ) -> Array:
        """Draw the path of the peg's tip (of its frame's origin where there is no peg), in millimetres."""
        tip = np.zeros(3)
        if peg is not None:
            tip = peg.vertices[peg.vertices[:, 2] < peg.vertices[:, 2].min() + 1e-6].mean(axis=0)
        import torch

        knots = torch.from_numpy(candidate.world_from_peg)
        path: Array = 1000.0 * poses.transform(knots, torch.from_numpy(tip)[None])[:, 0].numpy()
        if faint:
            axes.plot(*path.T, **FAINT)
            return path
        for k, manner in enumerate(candidate.manners):
            wide, over = (1.4, 5) if manner == "free" else (2.6, 6)  # the retreat must not hide the touch
            style = {"color": COLOURS[manner], "linewidth": wide, "zorder": over, "label": manner}
            axes.plot(*path[k : k + 2].T, **style)
        return path


def _probe(what: str, probe: Probe) -> Iterator[str]:
    yield from checks.times(f"{what}'s command", probe.command_times)
    yield from checks.poses(f"{what}'s command (world_from_peg)", probe.command, probe.command_times)
    yield from checks.times(f"{what}'s stamps", probe.stamps, checks.FILL)
    yield from checks.readings(f"{what}'s stamps", probe.stamps)
    for name, values in (("stiffness", probe.stiffness), ("damping", probe.damping)):
        if np.shape(values) != (6,) or not np.isfinite(values).all() or (values < 0).any():
            yield f"{what} has a {name} that is not six finite numbers of at least 0; give one for each axis."


def _touch(where: str, touch: Touch) -> Iterator[str]:
    # A window is read at an even rate, at its probe's stamps: without a row it would fit neither.
    yield from touches.problems(where, touch, checks.FILL)
    yield from checks.poses(
        f"{where}'s peg pose (world_from_peg)", touch.world_from_peg, touch.times, checks.FILL
    )


def _window(where: str, window: ProbeWindow, touch: Touch, end: int) -> Iterator[str]:
    first, last, stamps = window.first, window.last, window.probe.stamps
    span = f"{where}: window {first} to {last} of probe {window.probe.name!r}"
    if stamps.ndim != 1:
        return
    if not 0 <= first < last <= len(stamps):
        yield f"{span} does not lie within its {len(stamps)} stamps; give 0 <= first < last <= {len(stamps)}."
        return
    if first < end:
        yield f"{span} begins before an earlier window ended, at {end}; give them in order, without overlap."
    if first > end:
        yield (
            f"{span} leaves out stamps {end} to {first}; keep every window from the probe's start, for the "
            "sensor's zero is that of the first stamps: without them the touches say nothing."
        )
    if touch.times.shape != (last - first,):
        yield f"{span} holds {touch.times.size} wrench times, not {last - first}; read them at the stamps."
    elif (far := np.abs(touch.times - stamps[first:last]) > SAME_TIME).any():
        row = checks.first(far)
        yield (
            f"{span} has wrench time {touch.times[row]:.6f} s at row {row} where the probe's stamp is "
            f"{stamps[first + row]:.6f} s; read wrenches at the probe's stamps."
        )


register(ProbeSensor())
