"""Whether a belief that is wrong says so: faults that leave a narrow belief, and scenes without a fault.

Each scene of the accuracy bench is looked at and probed, and the default inference is run on the recording as
it is and with one fault: the part moved by 20 mm halfway, the truth outside the guess's box, a mesh that is
mirrored or turned in its frame, convex pieces 10 % larger than the mesh. Views alone, of a part that moves
after half of them, are explained by `part_in_view`; real pushes, the later ones displaced, by `point_probe`.
A fault is named where one of the warnings of `bcppl run` holds the words that say what to look at. A mesh
that is symmetric under its fault has none, and is left out. Where the evidence of a fault is not decisive
(a log Bayes factor below 6.9) nothing could name it: such runs are counted by themselves. For a mesh it is
that of the true mesh; for pushes, that of two poses, one for each half.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from foreign.faults import part_mirrored, part_moved, part_turned, truth_outside
from report import Row, finish, options, show
from scenes import PARTICLES, followed, model
from touches import LOGS, pushes

from bcppl import poses
from bcppl.cli.predictive_checks import PredictiveChecks, piece_errors
from bcppl.errors import InputError
from bcppl.geometry.distance import SignedDistance
from bcppl.geometry.parts import Piece
from bcppl.inference.criticism.hypotheses import DECISIVE
from bcppl.inference.filters.default import infer
from bcppl.inference.filters.smc import Step
from bcppl.models import load_recording, part_in_view, point_probe
from bcppl.models.worlds.bench.scene import bench_scene
from bcppl.recordings import Recording
from bcppl.traces import Model

SYMMETRIC = 0.001  # m: a mesh that is so near to the part's is the part's
SILENT = 0.03  # the largest share of scenes without a fault that are warned of
SHIPPED = {"peg_probe": model, "point_probe_10_pushes": point_probe.model}


class Outcome(NamedTuple):
    """One run: how far off its mean is, mm, its largest standard deviation, mm, its evidence and warnings."""

    error: float
    spread: float
    log_evidence: float
    warnings: list[str]


def outcome(model: Model, recording: Recording, truth: np.ndarray, seed: int) -> Outcome:
    """The default inference of a recording, and all that `bcppl run` warns of."""
    return judged(list(infer(model, recording, particles=PARTICLES, seed=seed)), model, recording, truth)


def judged(steps: Sequence[Step], model: Model, recording: Recording, truth: np.ndarray) -> Outcome:
    """The outcome of the steps of a run."""
    checks = PredictiveChecks()
    for step in steps:
        checks.cell(step)
    return Outcome(
        1e3 * float((step.belief.mean[:3] - torch.as_tensor(truth)[:3]).norm()),
        1e3 * float(step.belief.spread[:3].max()),
        float(step.population.log_evidence),
        [*checks.warnings(step, model.pose), *piece_errors(recording)],
    )


def pieces_enlarged(recording: Recording, factor: float = 1.1) -> Recording:
    """The part's convex pieces are larger than its mesh by a factor."""
    pieces = [Piece(p.kind, factor * p.size, factor * p.center) for p in recording.part.pieces]
    return replace(recording, part=replace(recording.part, pieces=tuple(pieces)))


def moved_between_views(seed: int, distance: float = 0.02) -> Recording:
    """Two views of a scene, and two of the same cameras after the part has moved along the table."""
    scene = bench_scene(seed)
    shift = torch.tensor([distance, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    later = replace(scene, truth=poses.retract(torch.from_numpy(scene.truth), shift).numpy())
    before, after = scene.look(), later.look()
    return replace(before, measurements=[*before.measurements, *after.measurements], model="part_in_view")


FAULTS: dict[str, tuple[Callable[[Recording], Recording], str]] = {
    "part moved by 20 mm halfway": (part_moved, "moved"),
    "truth 10 mm outside the guess": (truth_outside, "widen the guess"),
    "mesh mirrored": (part_mirrored, "mirrored"),
    "mesh turned by 90°": (part_turned, "turned"),
    "pieces 10 % too large": (pieces_enlarged, "convex pieces"),
}
MESHES = ("mesh mirrored", "mesh turned by 90°")
VIEWS = "part moved between views"
PUSHES = "part moved by 20 mm between pushes"
UNDECIDED = ", not decided by the data"


def moved_between_pushes(seed: int, count: int = 10, distance: float = 0.02) -> Recording:
    """Real pushes, the later half of them displaced in the plane: the finger's path moves with the part."""
    recording = pushes("10_90", count, seed)
    heading = 2.0 * np.pi * np.random.default_rng(seed).random()
    shift = distance * np.array([np.cos(heading), np.sin(heading), 0.0, 0.0, 0.0, 0.0, 0.0])
    later = [
        replace(m, action=replace(m.action, world_from_tip=m.action.world_from_tip + shift))
        for m in recording.measurements[count // 2 :]
    ]
    return replace(recording, measurements=[*recording.measurements[: count // 2], *later])


def halves(recording: Recording) -> list[Recording]:
    """The measurements of the first half, and those of the second."""
    middle = len(recording.measurements) // 2
    both = recording.measurements[:middle], recording.measurements[middle:]
    return [replace(recording, measurements=some) for some in both]


def symmetric(first: Recording, second: Recording) -> bool:
    """Whether the mesh of a second recording is another than that of the first, and the same surface."""
    if first.part.vertices is second.part.vertices:
        return False
    points = torch.from_numpy(second.part.surface_points(300))
    return float(SignedDistance(first.part)(points).distance.abs().max()) < SYMMETRIC


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--scenes", type=int, default=20, help="how many seeds")
    parser.add_argument("--only", nargs="*", default=[*FAULTS, VIEWS, PUSHES], help="faults by name")
    arguments = parser.parse_args()
    seeds = range(arguments.seed, arguments.seed + (1 if arguments.quick else arguments.scenes))
    runs: dict[str, list[Outcome]] = {"no fault": []}
    lines: list[Sequence[object]] = []

    def note(case: str, seed: int, one: Outcome) -> None:
        runs.setdefault(case, []).append(one)
        lines.append([case, f"{seed}", one.error, one.spread, " | ".join(one.warnings)[:150]])
        words = " | ".join(one.warnings) or "no warning"
        print(f"{case}, seed {seed}: {one.error:.1f} mm off; {words}", flush=True)

    for seed in seeds:
        _, steps, recording = followed(seed, PARTICLES)
        if recording is None:
            continue
        truth = recording.truth
        good = judged(steps, model, recording, truth)
        note("no fault", seed, good)
        for name, (fault, _) in FAULTS.items():
            if name not in arguments.only:
                continue
            try:
                faulty = fault(recording)
            except InputError as error:
                print(f"{name}, seed {seed}: {error}")
                continue
            if symmetric(recording, faulty):
                continue
            one = outcome(model, faulty, truth, seed)
            if name in MESHES and good.log_evidence - one.log_evidence < DECISIVE:
                name = f"{name}{UNDECIDED}"
            note(name, seed, one)
        if VIEWS in arguments.only:
            seen = moved_between_views(seed)
            note(VIEWS, seed, outcome(part_in_view.model, seen, seen.truth, seed))
        if PUSHES in arguments.only and LOGS.exists():
            pushed = moved_between_pushes(seed)
            one = outcome(point_probe.model, pushed, pushed.truth, seed)
            # Two poses, each from the guess, explain the halves of what one explains.
            apart = sum(
                outcome(point_probe.model, half, pushed.truth, seed).log_evidence for half in halves(pushed)
            )
            decided = apart - one.log_evidence > DECISIVE
            note(PUSHES if decided else f"{PUSHES}{UNDECIDED}", seed, one)
    for name, of in SHIPPED.items():
        shipped = load_recording(name)
        note(f"shipped {name}", 0, outcome(of, shipped, shipped.truth, 0))

    show("warnings", ["case", "seed", "off mm", "spread mm", "warnings"], lines)
    words = {**{name: warning for name, (_, warning) in FAULTS.items()}, VIEWS: "moved", PUSHES: "moved"}
    rows: list[Row] = []
    for case, several in runs.items():
        if case in words:
            named = np.mean([any(words[case] in w for w in one.warnings) for one in several])
            warned = np.mean([bool(one.warnings) for one in several])
            rows.append(Row(f"{case}: named", float(named), f"of {len(several)}", 1.0, "min"))
            rows.append(Row(f"{case}: warned of", float(warned), f"of {len(several)}", 1.0, "min"))
        else:
            warned = np.mean([bool(one.warnings) for one in several])
            goal = None if case.endswith(UNDECIDED) else SILENT
            rows.append(Row(f"{case}: warned of", float(warned), f"of {len(several)}", goal, "max"))
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()
