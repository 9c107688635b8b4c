"""Whether gross mistakes are named: what a recording states wrongly, beside what a run warns of.

A scene of the accuracy bench is seen and touched by a probe that rocks (`ROCKED`). Then its recording is made
to state something wrong, is run by the default inference, and both what the run warns of and the hypotheses
that explain its touches (`bcppl.inference.criticism.explanations`) are noted. A mistake is named if a warning
has its words, or one of the first two hypotheses. Each mistake is made by code of its own, not by the one
of the hypothesis. Beside it stands how much more probable touches are without the mistake: no test of them
names a mistake that explains them no better than what is stated does, as where a peg that touches every face
from one side alone may as well be thinner as off in the hand. With `--file` results are written as they are
done, and a later call adds the missing ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from foreign.faults import mapped, part_mirrored, part_moved, truth_outside
from honesty import symmetric
from report import Row, finish, options, show
from scenes import PARTICLES, default_run
from scipy.spatial.transform import Rotation

from bcppl.cli.predictive_checks import PredictiveChecks
from bcppl.errors import InputError
from bcppl.geometry.turns import turns_freely
from bcppl.inference.criticism import explanations
from bcppl.inference.criticism.hypotheses import VERY_STRONG
from bcppl.inference.criticism.rival_hypotheses import approximated, log_evidence
from bcppl.inference.planning.metrology import three_two_one
from bcppl.inference.planning.metrology_parameters import ROCKED
from bcppl.models.look_and_touch import model
from bcppl.models.worlds.bench.scene import bench_scene
from bcppl.sensors.likelihoods.bench_profiles import PROFILES
from bcppl.sensors.measurements import Recording
from bcppl.sensors.probe import ProbeWindow, Touch
from bcppl.sweeps import in_order, keep, kept, key_of, one_line
from bcppl.traces import Model

GOOD = "none"
NAMED, WARNED, SILENT = 0.9, 0.98, 0.03  # shares of the scenes: of mistakes, of mistakes, of good scenes
Columns = tuple[np.ndarray, np.ndarray]  # wrenches (T, 6) and poses (T, 7)


class Mistake(NamedTuple):
    """How a good recording is made a wrong one, and words of which one names it."""

    made: Callable[[Recording], Recording]
    words: tuple[str, ...]


def touches_changed(recording: Recording, changed: Callable[[np.ndarray, np.ndarray], Columns]) -> Recording:
    """The recording with the wrenches and poses of its one probe, over all windows, changed."""
    windows = [m for m in recording.measurements if isinstance(m.action, ProbeWindow)]
    wrench, pose = changed(
        np.concatenate([m.observation.wrench for m in windows]),
        np.concatenate([m.observation.world_from_peg for m in windows]),
    )
    done, measurements = 0, [m for m in recording.measurements if not isinstance(m.action, ProbeWindow)]
    for m in windows:
        own = slice(done, done + len(m.observation.times))
        measurements.append(replace(m, observation=Touch(m.observation.times, wrench[own], pose[own])))
        done = own.stop
    return replace(recording, measurements=measurements)


def forces_reversed(recording: Recording) -> Recording:
    """The driver gives what the peg exerts."""
    return touches_changed(recording, lambda wrench, pose: (-wrench, pose))


def at_flange(recording: Recording, along: float = -0.12) -> Recording:
    """The robot gives the pose of a frame that is farther along the peg's axis, as if it were the peg's."""

    def moved(wrench: np.ndarray, pose: np.ndarray) -> Columns:
        axis = Rotation.from_quat(pose[:, 3:], scalar_first=True).as_matrix()[:, :, 2]
        return wrench, np.hstack([pose[:, :3] + along * axis, pose[:, 3:]])

    return touches_changed(recording, moved)


def peg_turned(recording: Recording, degrees: float = 18.0) -> Recording:
    """The measured pose, and the frame in which the wrench is read, lack a turn of the peg about its axis."""
    if recording.peg is None or turns_freely(recording.peg):
        raise InputError("the peg is round, and looks the same however it is turned; take another one.")
    turn = Rotation.from_euler("z", degrees, degrees=True)

    def turned(wrench: np.ndarray, pose: np.ndarray) -> Columns:
        hand = Rotation.from_quat(pose[:, 3:], scalar_first=True) * turn
        felt = [turn.inv().apply(wrench[:, :3]), turn.inv().apply(wrench[:, 3:])]
        return np.hstack(felt), np.hstack([pose[:, :3], hand.as_quat(scalar_first=True)])

    return touches_changed(recording, turned)


def clock_off(recording: Recording, seconds: float = 0.2) -> Recording:
    """The wrench is stamped with times that are so much too late."""
    times = np.concatenate(
        [m.observation.times for m in recording.measurements if isinstance(m.action, ProbeWindow)]
    )
    stamps = round(seconds / float(np.median(np.diff(times))))

    def late(wrench: np.ndarray, pose: np.ndarray) -> Columns:
        return np.concatenate([np.tile(wrench[:1], (stamps, 1)), wrench[:-stamps]]), pose

    return touches_changed(recording, late)


def peg_stated_thicker(recording: Recording, metres: float = 0.0005) -> Recording:
    """The peg's mesh and pieces are wider than the peg, about its axis."""
    assert recording.peg is not None
    peg = recording.peg
    width = float(np.ptp(peg.vertices[:, :2], axis=0).max())
    scale = np.diag([1.0 + metres / width, 1.0 + metres / width, 1.0])
    return replace(recording, peg=mapped(peg, scale))


MISTAKES: dict[str, Mistake] = {
    "part mirrored": Mistake(part_mirrored, ("mirrored", "turned by 180")),
    "peg 0.5 mm too thin": Mistake(peg_stated_thicker, ("thinner",)),
    "forces of the wrong sign": Mistake(forces_reversed, ("wrong sign",)),
    "peg pose at the flange": Mistake(at_flange, ("another frame of the tool",)),
    "peg turned by 18°": Mistake(peg_turned, ("the peg is turned",)),
    "clock off by 0.2 s": Mistake(clock_off, ("s late",)),
    "part moved by 3 mm": Mistake(partial(part_moved, distance=0.003), ("the part moved", "had moved")),
    "truth outside the guess": Mistake(truth_outside, ("widen the guess",)),
}


class Outcome(NamedTuple):
    """What came of a run.

    Attributes:
        warnings: of the run.
        hypotheses: that explain its touches, the best first.
        error: in position, mm.
        tells: the log Bayes factor of touches without the mistake to those with it, nats.
    """

    warnings: list[str]
    hypotheses: list[str]
    error: float
    tells: float

    def names(self, words: tuple[str, ...]) -> bool:
        """Whether the words are in a warning or in one of the first two hypotheses."""
        return any(word in text for word in words for text in [*self.warnings, *self.hypotheses[:2]])


def outcomes(seed: int, profile: str, names: tuple[str, ...], file: Path | None) -> dict[str, Outcome]:
    """The outcomes of one scene, by mistake; those that cannot be made of it, or are none, are left out."""
    keys = {name: [seed, profile, name] for name in names}
    there = {} if file is None else kept(file)
    known = {name: there.get(key_of(key)) for name, key in keys.items()}
    missing = [name for name, one in known.items() if one is None]
    if missing:
        scene = bench_scene(seed)
        *_, seen = default_run(scene.look(), PARTICLES, seed)
        good = scene.probe(three_two_one(seen.belief, scene.part, scene.peg, ROCKED))
        profiled = model.with_settings(profile=profile)
        right = log_evidence(approximated(profiled, good))
        for name in missing:
            known[name] = [outcome(good, name, seed, profiled, right)]
            if file is not None:
                keep(file, keys[name], known[name])
    return {name: Outcome(*one[0]) for name, one in known.items() if one[0]}


def outcome(good: Recording, name: str, seed: int, profiled: Model, right: float) -> Outcome | None:
    """The outcome of one recording with a mistake; without it its touches have the log evidence `right`."""
    try:
        recording = good if name == GOOD else MISTAKES[name].made(good)
    except InputError as refused:
        print(f"{name}, seed {seed}: {one_line(refused)}", flush=True)
        return None
    if symmetric(good, recording):
        return None
    checks = PredictiveChecks()
    for step in default_run(recording, PARTICLES, seed, scene=profiled.prepare(recording)):
        checks.cell(step)
    error = 1e3 * float((step.belief.mean[:3] - torch.as_tensor(good.truth)[:3]).norm())
    ranked = explanations(profiled, recording)
    hypotheses = [f"{one.hypothesis} ({one.gain:.0f} nats)" for one in ranked]
    tells = right - log_evidence(approximated(profiled, recording))
    result = Outcome(checks.warnings(step, model.pose), hypotheses, error, tells)
    of_it = f"{error:.2f} mm, {tells:.0f} nats to tell it, {len(result.warnings)} warnings"
    print(f"{name}, seed {seed}: {of_it}; {hypotheses[:2]}", flush=True)
    return result


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--only", nargs="+", default=[GOOD, *MISTAKES], choices=[GOOD, *MISTAKES])
    parser.add_argument("--profile", default="ur5e", choices=list(PROFILES))
    parser.add_argument("--file", type=Path, help="where the outcomes are kept")
    parser.add_argument("--jobs", type=int, default=1, help="scenes at a time")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    names = (GOOD, "forces of the wrong sign") if arguments.quick else tuple(arguments.only)
    seeds = list(range(arguments.seed, arguments.seed + (1 if arguments.quick else arguments.scenes)))
    work = partial(outcomes, profile=arguments.profile, names=names, file=arguments.file)
    scenes = list(in_order(work, seeds, arguments.jobs))
    rows, lines = [], []
    for name in names:
        several = [found[name] for found in scenes if name in found]
        if not several:
            continue
        warned = float(np.mean([bool(one.warnings or one.hypotheses) for one in several]))
        count = f"of {len(several)}"
        if name == GOOD:
            rows.append(Row("no mistake: warned of", warned, count, SILENT, "max"))
        else:
            names_it = [one.names(MISTAKES[name].words) for one in several]
            rows.append(Row(f"{name}: named", float(np.mean(names_it)), count, NAMED, "min"))
            tellable = [
                named for named, one in zip(names_it, several, strict=True) if one.tells > VERY_STRONG
            ]
            if tellable:
                share = float(np.mean(tellable))
                rows.append(
                    Row(f"{name}: named where touches tell", share, f"of {len(tellable)}", NAMED, "min")
                )
            rows.append(Row(f"{name}: warned of", warned, count, WARNED, "min"))
        lines += [
            [name, k, one.error, one.tells, len(one.warnings), " | ".join(one.hypotheses[:2])[:120]]
            for k, one in enumerate(several)
        ]
    show("mistakes", ["mistake", "scene", "off mm", "tells nats", "warnings", "hypotheses"], lines)
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()
