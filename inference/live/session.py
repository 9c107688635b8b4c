"""What may be asked of a live belief from outside: requests and answers as plain maps.

    {"ask": "begin", "plan": {...}}    a probe begins: a plan as `bcppl.recordings.action_file` has it, or
                                       where there is none "name", "begin" (s), "seconds" and "rate"
    {"ask": "samples", "wrench": (K, 7), "pose": (L, 8)}    rows of a stamp and what was measured then
    {"ask": "end"}                     the probe is over
    {"ask": "view", "camera": {...}, "depth": (H, W)}       a depth image, m
    {"ask": "belief"}                  {"mean": (7,), "covariance": (6, 6), "effective", "behind", ...},
                                       and sentences on what was "left_out" last
    {"ask": "next_probe"}              {"plan": {...}, "gain": nats}
    {"ask": "insertion"}               {"search": {...}, "push": {...}}; of several holes the one around
                                       a point "inside" (x, y), m in the part's frame

An answer has "error", one sentence, where something is wrong; of samples, all rows that are right are kept,
and what is complete with them is assimilated. An error of the program itself is logged with its traceback.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bcppl import poses
from bcppl.arguments import number_within
from bcppl.arrays import Array
from bcppl.errors import InferenceError, InputError, reason_of
from bcppl.geometry.holes import hole_of
from bcppl.inference.live.filter import Filter
from bcppl.inference.live.sampler import Sampler
from bcppl.robot.motion import Probe
from bcppl.robot.plan import LONGEST, QUICKEST, probe_of
from bcppl.sensors import DepthImage, Measurement, checks
from bcppl.sensors.candidates import planner_of
from bcppl.sensors.layout import Layout
from bcppl.sensors.protocol import Plannable, sensor_named

MOST_STAMPS = 100_000  # of a probe
WAITS = 60.0  # s for a ranking or a plan
LATEST = 2.0**32  # s: beyond it a float cannot tell stamps a microsecond apart
LISTED = 10  # measurements that were left out
LOG = logging.getLogger(__name__)

Answer = dict[str, Any]
# Of each request that holds more than what it asks for.
FIELDS = {
    "begin": {"plan", "name", "begin", "seconds", "rate"},
    "samples": {"wrench", "pose"},
    "view": {"camera", "depth"},
    "insertion": {"inside"},
}


class Session:
    """Answers requests about one live belief, from any thread."""

    def __init__(self, live: Filter) -> None:
        self.live = live
        self._sampler: Sampler | None = None
        live.settle()  # the recording that it begins with is assimilated in its own thread
        probes = (getattr(m.action, "probe", None) for m in live.recording.measurements)
        self._names = {probe.name for probe in probes if probe is not None}
        self._lock = threading.Lock()  # of the sampler: who ranks or plans holds up nobody's samples
        self._asked: Mapping[str, Callable[[Mapping[str, Any]], Answer]] = {
            "begin": self._begin,
            "samples": self._samples,
            "end": self._end,
            "view": self._view,
            "belief": self._belief,
            "next_probe": self._next_probe,
            "insertion": self._insertion,
        }

    def answer(self, request: Mapping[str, Any]) -> Answer:
        """The answer to a request; of one that is wrong, a sentence under "error"."""
        asked = request.get("ask")
        try:
            if not isinstance(asked, str) or asked not in self._asked:
                raise InputError(f"{str(asked)[:40]!r} is asked for; ask for {', '.join(self._asked)}.")
            fields = FIELDS.get(asked, set())
            if unknown := sorted(map(str, set(request) - fields - {"ask"})):
                known = f"its fields are {', '.join(sorted(fields))}" if fields else "it has none"
                raise InputError(f"{asked!r} has no field {unknown[0][:40]!r}; {known}.")
            return self._asked[asked](request)
        except (InputError, InferenceError) as error:
            return {"error": str(error)}
        except TimeoutError:
            return {
                "error": f"{asked} takes longer than {WAITS:g} s; ask again when fewer measurements wait."
            }
        except Exception as error:  # a client has an answer to each request, whatever happens here
            LOG.exception("%s has failed", asked)
            return {"error": f"{asked} has failed in the server ({reason_of(error)}); see its log."}

    def _begin(self, request: Mapping[str, Any]) -> Answer:
        if "plan" in request:
            plan = _read(_layout("window").candidate, request["plan"], "the plan")
            _refuse_many(float(plan.times[-1] - plan.times[0]), plan.rate)
            probe = probe_of(plan)
        else:
            probe = _unknown(request)
        for problem in checks.times(f"the probe {probe.name[:40]!r}", probe.stamps):
            raise InputError(problem)
        with self._lock:
            if self._sampler is not None:
                under_way = self._sampler.probe.name[:40]
                raise InputError(f"the probe {under_way!r} is not over; ask for 'end' before another begins.")
            if probe.name in self._names:
                raise InputError(f"there was a probe called {probe.name[:40]!r}; give each its own name.")
            self._sampler = Sampler(probe)
            self._names.add(probe.name)
        return {"stamps": len(probe.stamps)}

    def _samples(self, request: Mapping[str, Any]) -> Answer:
        rows = {name: _rows(request, name, width) for name, width in (("wrench", 7), ("pose", 8))}
        if not request.keys() & rows.keys():
            raise InputError("samples has no rows; send those of the wrench, of the pose or both.")
        count = 0
        refused: list[InputError] = []
        with self._lock:
            sampler = self._begun()
            for name, add in (("wrench", sampler.wrench), ("pose", sampler.pose)):
                for row in rows[name]:
                    if sampler.fault is not None and refused:
                        break  # no window comes after it, and each row would have the same answer
                    try:
                        _refuse_row(name, row)
                        count += self._observe(add(float(row[0]), row[1:]))
                    except InputError as error:  # the rows after it are right, and are not sent again
                        refused.append(error)
        if refused:
            raise refused[0]
        return {"windows": count, "behind": self.live.behind}

    def _end(self, _: Mapping[str, Any]) -> Answer:
        with self._lock:
            sampler, self._sampler = self._begun(), None
            count = self._observe(sampler.finish())
        irregular = {name: vars(c) for name, c in sampler.counts.items()}
        return {"windows": count, "irregular": irregular, "missing": sampler.missing}

    def _view(self, request: Mapping[str, Any]) -> Answer:
        view = _read(_layout("view").candidate, request.get("camera"), "the camera")
        depth = request.get("depth")
        if not isinstance(depth, np.ndarray) or depth.ndim != 2:
            raise InputError("a view has no depth of shape (H, W); send it as an array.")
        self._observe([Measurement(view, DepthImage(depth))])
        return {"behind": self.live.behind}

    def _belief(self, _: Mapping[str, Any]) -> Answer:
        step = self.live.step
        belief = step.belief
        return {
            "mean": belief.mean.numpy(),
            "covariance": belief.covariance.numpy(),
            "effective": belief.effective_sample_size,
            "measurements": step.taken,
            "behind": self.live.behind,
            "left_out": [each.fault for each in self.live.updates if each.fault][-LISTED:],
        }

    def _next_probe(self, _: Mapping[str, Any]) -> Answer:
        best = self.live.next_probe(timeout=WAITS).best
        plan = self.live.named_apart(best.candidate, self._names)
        return {"plan": planner_of(plan).candidate.tree(plan), "gain": best.information_gain}

    def _insertion(self, request: Mapping[str, Any]) -> Answer:
        hole = None
        if "inside" in request:
            recording, inside = self.live.recording, _point(request["inside"])
            hole = hole_of(recording.part, inside, recording.peg)
        plan = self.live.insertion(hole=hole, timeout=WAITS)
        layout = _layout("window").candidate
        return {
            "search": layout.tree(plan.search),
            "push": layout.tree(plan.push),
            "world_from_hole": plan.world_from_hole,
            "depth": plan.depth,
            "chamfer": plan.chamfer,
        }

    def _begun(self) -> Sampler:
        if self._sampler is None:
            raise InputError("no probe has begun; ask for 'begin' first.")
        return self._sampler

    def _observe(self, windows: list[Measurement]) -> int:
        for each in windows:
            self.live.observe(each.action, each.observation)
        return len(windows)


def _point(inside: Any) -> tuple[float, float]:
    """The point of a request (x, y), m."""
    numbers = isinstance(inside, (list, tuple, np.ndarray)) and len(inside) == 2
    if not numbers or not all(isinstance(x, (int, float)) and abs(x) < np.inf for x in inside):
        raise InputError(f"inside is {str(inside)[:40]}; give two numbers in metres, x and y.")
    return float(inside[0]), float(inside[1])


def _layout(kind: str) -> Plannable:
    sensor = sensor_named(kind)
    assert isinstance(sensor, Plannable)
    return sensor


def _read(layout: Layout[Any], tree: Any, what: str) -> Any:
    """The object of a request's map.

    Raises:
        InputError: it is none; one sentence that begins with `what`.
    """
    if not isinstance(tree, dict):
        raise InputError(f"{what} is missing; send it as a map.")
    try:
        return layout.parsed(tree)
    except InputError as error:
        raise InputError(f"{what}: {error}") from None
    except KeyError as error:
        raise InputError(f"{what} lacks {error.args[0]!r}; add it.") from error
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{what} cannot be read ({error}); send numbers in SI units.") from error


def _unknown(request: Mapping[str, Any]) -> Probe:
    """A probe of which only the time is known: its command is taken to stand still."""
    name, given = request.get("name"), request.get("begin")
    begin = number_within("a probe begins at {} s", given, least=-LATEST, most=LATEST)
    rate = number_within("a probe has {} stamps a second", request.get("rate"), least=1.0, most=QUICKEST)
    seconds = number_within("a probe lasts {} s", request.get("seconds"), least=1.0 / rate, most=LONGEST)
    if not isinstance(name, str) or not name:
        raise InputError("a probe begins without a name; give it one.")
    _refuse_many(seconds, rate)
    stamps = begin + np.arange(max(1, round(seconds * rate))) / rate
    still = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (2, 1))
    return Probe(name, np.array([begin, begin + seconds]), still, np.zeros(6), np.zeros(6), stamps)


def _refuse_many(seconds: float, rate: float) -> None:
    if seconds * rate > MOST_STAMPS:
        raise InputError(f"the probe has {seconds * rate:.0f} stamps; give {MOST_STAMPS} at most.")


def _rows(request: Mapping[str, Any], name: str, width: int) -> Array:
    given = request.get(name, [])
    try:
        rows = np.asarray(given, dtype=np.float64) if len(given) else np.empty((0, width))
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name} is no list of rows of {width} numbers, the first the stamp.") from error
    if rows.ndim != 2 or rows.shape[1] != width:
        raise InputError(f"{name} has shape {rows.shape}; send (K, {width}), the first column the stamps.")
    return rows


def _refuse_row(name: str, row: Array) -> None:
    if not np.isfinite(row).all():
        raise InputError(f"{name} has a row with a number that is not finite; leave it out.")
    if name == "pose":
        poses.as_pose(row[1:], "a sample's pose")
