"""What a run prints: a row for each measurement, then the posterior, in one line and in tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from bcppl import poses
from bcppl.beliefs import Belief, average_distance, average_nearest_distance, average_point_distance
from bcppl.beliefs.regions import rotation_angle, translation_distance
from bcppl.cli import latent_sites
from bcppl.cli.predictive_checks import PredictiveChecks, piece_errors
from bcppl.errors import InputError
from bcppl.geometry.holes import fit_in, hole_of
from bcppl.geometry.parts import Part, with_tip_at
from bcppl.inference.criticism import Explanation, explanations
from bcppl.inference.planning.insertion import InsertionParameters
from bcppl.recordings import Recording
from bcppl.traces import Model
from bcppl.untrusted.visible_text import visible

WIDTHS = {
    "measurement": 12,
    "time s": 6,
    "ESS": 5,
    "± mm": 6,
    "± °": 5,
    "rel. mm": 7,
    "rel. °": 6,
    "log Z": 8,
    "acc.": 4,
    "ADD mm": 6,
    "gap": 6,
    "p value": 8,
    "wall s": 6,
}
LARGEST_GAP = 5.0  # nats: the truth may score better than the best particle by chance, not by more
MASS = 0.9  # of the credible region in the last line
UNITS = {"rendering": "images", "physics": "rollouts"}


class Report:
    """Prints a run."""

    def __init__(self, console: Console, recording: Recording, model: Model) -> None:
        self.console = console
        self.recording = recording
        self.model = model
        self.steps: list[Any] = []
        self.rows = 0
        self.checks = PredictiveChecks()
        self.conclusion = ""  # of `finish`

    def resume(self, step: Any, rows: Sequence[Mapping[str, str]], checks: PredictiveChecks) -> None:
        """Print the rows of a run that was stopped after a step, which it goes on from."""
        self.steps, self.rows, self.checks = [step], len(rows), checks
        self._print_row({name: name for name in WIDTHS}, style="bold")
        for row in rows:
            self._print_row(row)

    def row(self, step: Any) -> dict[str, str]:
        """Print a step's row, and give its cells by column."""
        if not self.rows:
            self._print_row({name: name for name in WIDTHS}, style="bold")
        self.steps.append(step)
        self.rows += 1
        info, add = step.info, math.nan
        if self.recording.truth is not None:
            add = 1e3 * step.belief.weighted_add(self.recording.part.surface_points(), self.recording.truth)
        simulated = info.effort["physics"].amount if "physics" in info.effort else math.nan
        relative = relative_to_peg(step.belief, self.recording, self.rows - 1)
        cells = {
            "measurement": info.label,
            "time s": _number(info.time, 2),
            "ESS": _number(info.effective_sample_size, 1),
            **_sizes(step.belief, "±"),
            **({} if relative is None else _sizes(relative, "rel.")),
            "log Z": _number(info.log_evidence, 2),
            "acc.": _number(info.acceptance, 2),
            "ADD mm": _number(add, 2),
            "gap": _number(info.truth_gap, 1),
            "p value": self.checks.cell(step),
            "wall s": _number(info.seconds, 2),
            # These are in run.json alone.
            "distinct": str(info.distinct),
            "exponents": str(len(info.exponents) or ""),
            "simulated s": _number(simulated, 0),
        }
        row = {name: cells.pop(name, "") for name in WIDTHS} | cells
        self._print_row(row)
        return row

    def _print_row(self, row: Mapping[str, str], style: str | None = None) -> None:
        first, *others = (visible(row.get(name, "")).rjust(width) for name, width in WIDTHS.items())
        line = " ".join([first.strip().ljust(WIDTHS["measurement"]), *others])
        self.console.print(line, style=style, soft_wrap=True, markup=False)

    @property
    def is_complete(self) -> bool:
        """Whether all measurements were assimilated."""
        return self.rows > len(self.recording.measurements)

    def finish(self) -> list[str]:
        """Print the posterior after the last step, and the warnings, which it gives back."""
        last, sites = self.steps[-1], latent_sites.summarised(self.steps[-1])
        total = len(self.recording.measurements)
        if not self.is_complete:
            self._warn(
                f"stopped after {last.info.label}: {self.rows - 1} of {total} measurements were assimilated."
            )
        self.console.print(self._pose(last.belief))
        others = latent_sites.table(sites, self.model.pose)
        if others.row_count:
            self.console.print(others)
        gap = last.info.truth_gap
        if gap > LARGEST_GAP:
            self._warn(
                f"the particles missed the truth, which scores {gap:.0f} nats better than the best of them: "
                "try more particles or another seed."
            )
        warnings = [*self.checks.warnings(last, self.model.pose), *piece_errors(self.recording)]
        for warning in warnings:
            self._warn(warning)
        self._note(self._effort())
        self.console.print(result(last.belief, self.recording), markup=False)
        self.conclusion = conclusion(last.belief, self.recording, bool(warnings))
        self.console.print(self.conclusion, markup=False)
        return warnings

    def explain(self) -> list[Explanation]:
        """Print what would explain the touches better than what is stated, and give it back."""
        found = explanations(self.model, self.recording)
        for each in found:
            self._warn(f"touches fit better by {each.gain:.0f} nats if {each.hypothesis}.")
        if not found:
            self._note(
                "no other hypothesis explains the touches better than what the recording states; compared "
                "are touches of a held peg that the model explains by its gap to the part."
            )
        return found

    def relative_deviations(self) -> list[float] | None:
        """Standard deviations (6,) of the part's pose relative to the held peg, m and rad."""
        relative = relative_to_peg(self.steps[-1].belief, self.recording)
        return None if relative is None else relative.spread.tolist()

    def _warn(self, sentence: str) -> None:
        self.console.print(visible(sentence), style="yellow", markup=False)

    def _note(self, sentence: str) -> None:
        self.console.print(sentence, style="dim", markup=False)

    def _pose(self, belief: Belief) -> Table:
        guess = torch.as_tensor(self.recording.guess.world_from_part, dtype=torch.float64)
        turned = torch.rad2deg(poses.local(guess, belief.mean)[3:]).tolist()
        mean, spread = belief.mean.tolist(), belief.spread.tolist()
        # q and -q are one rotation: the one with w >= 0 is what people compare.
        sign = -1.0 if mean[3] < 0 else 1.0
        table = Table(
            title="pose of the part (world_from_part)",
            caption="quaternion w x y z: " + " ".join(f"{sign * q:.6f}" for q in mean[3:]),
            title_justify="left",
            caption_justify="left",
            box=None,
            pad_edge=False,
        )
        spreads = {"standard deviation": spread}
        if (relative := self.relative_deviations()) is not None:
            spreads["relative to the held peg"] = relative
        for name in ("axis", "mean", *spreads):
            table.add_column(name, justify="left" if name == "axis" else "right")
        for k, axis in enumerate("xyz"):
            each = [f"{1e3 * values[k]:.3f} mm" for values in spreads.values()]
            table.add_row(axis, f"{1e3 * mean[k]:.3f} mm", *each)
        for k, axis in enumerate("xyz", 3):
            name = f"turn about the part's {axis}, from the guess"
            each = [f"{math.degrees(values[k]):.3f}°" for values in spreads.values()]
            table.add_row(name, f"{turned[k - 3]:.3f}°", *each)
        return table

    def _effort(self) -> str:
        spent = [f"wall time {sum(step.info.seconds for step in self.steps):.2f} s"]
        for name in self.steps[-1].info.effort:
            efforts = [step.info.effort[name] for step in self.steps if name in step.info.effort]
            seconds, items = sum(e.seconds for e in efforts), sum(e.items for e in efforts)
            simulated = f", {sum(e.amount for e in efforts):.0f} s simulated" if name == "physics" else ""
            spent.append(f"{name} {seconds:.2f} s ({items} {UNITS.get(name, 'items')}{simulated})")
        return ", ".join(spent)


def relative_to_peg(belief: Belief, recording: Recording, taken: int | None = None) -> Belief | None:
    """The belief as seen from the held peg, turned as it was last, with its tip at the part's frame.

    None where the peg is where it is measured, or has touched nothing. `taken` is how many measurements the
    belief has assimilated; all by default.
    """
    if belief.apparent is None or recording.peg is None:
        return None
    each = (getattr(m.observation, "world_from_peg", None) for m in recording.measurements[:taken])
    stood = [window[-1] for window in each if window is not None and len(window)]
    if not stood:
        return None
    last = torch.as_tensor(stood[-1], dtype=torch.float64)
    return belief.relative(with_tip_at(recording.peg, last, belief.mean[:3]))


def conclusion(belief: Belief, recording: Recording, doubtful: bool) -> str:
    """Where the part is, how sure that is as seen from the held peg, and what to do next, in words."""
    relative = relative_to_peg(belief, recording)
    seen = belief if relative is None else relative
    what, at = _place(belief, recording)
    where = f"the {what} is at {' '.join(f'{1e3 * number:.2f}' for number in at.tolist())} mm"
    radii = [
        seen.credible_region(MASS, distance).radius for distance in (translation_distance, rotation_angle)
    ]
    if any(math.isinf(radius) for radius in radii):
        return f"{where}; the particles are too few to say how sure."
    whose = "" if relative is None else ", as seen from the held peg"
    sure = f"sure to {1e3 * radii[0]:.2f} mm and {math.degrees(radii[1]):.2f}° at {100 * MASS:.0f} %{whose}"
    if recording.peg is None:
        return f"{where}, {sure}."
    if doubtful:
        return f"{where}, {sure}; see to the warnings before you trust it."
    # As wide as a search may be (`InsertionParameters.maximum_radius`).
    ready = (
        what == "hole"
        and _fits(recording.part, recording.peg)
        and radii[0] < InsertionParameters().maximum_radius
    )
    advice = "try the insertion (bcppl insert)" if ready else "touch or look once more (bcppl probe)"
    return f"{where}, {sure}; {advice}."


def _fits(part: Part, peg: Part) -> bool:
    """Whether a peg goes into the part's hole."""
    try:
        fit_in(hole_of(part, peg=peg), peg)
    except InputError:
        return False
    return True


def _place(belief: Belief, recording: Recording) -> tuple[str, torch.Tensor]:
    """The hole and its position (3,), m; where there is none, or several, the part and its own."""
    try:
        hole = hole_of(recording.part)
    except InputError:
        return "part", belief.mean[:3]
    return "hole", poses.compose(belief.mean, torch.from_numpy(hole.part_from_hole))[:3]


def _sizes(belief: Belief, name: str) -> dict[str, str]:
    """How far off a pose is from the mean, root mean square, as cells in mm and degrees."""
    variance = belief.covariance.diagonal()
    far, turned = variance[:3].sum().sqrt(), variance[3:].sum().sqrt()
    return {f"{name} mm": _number(1e3 * float(far), 2), f"{name} °": _number(math.degrees(float(turned)), 2)}


def result(belief: Belief, recording: Recording) -> str:
    """The posterior in one line: its error where the truth is known, else its spread; a credible region."""
    points = recording.part.surface_points()
    region = belief.credible_region(MASS, average_point_distance(points))
    size = f"the {100 * MASS:.0f} % credible region is within {1e3 * region.radius:.2f} mm ADD of the mean"
    if math.isinf(region.radius):
        size = f"the particles are too few for a {100 * MASS:.0f} % credible region"
    truth = recording.truth
    if truth is None:
        spread = belief.spread
        return (
            f"standard deviations {_listed(1e3 * spread[:3])} mm and {_listed(torch.rad2deg(spread[3:]))}°; "
            f"{size}."
        )
    if not math.isinf(region.radius):
        size += " and contains the truth" if bool(region.contains(truth)) else " and misses the truth"
    error = 1e3 * float(average_distance(belief.mean, points, truth))
    nearest = 1e3 * float(average_nearest_distance(belief.mean, points, truth))
    return (
        f"ADD {error:.2f} mm at the posterior mean (ADD-S {nearest:.2f} mm), "
        f"{1e3 * belief.weighted_add(points, truth):.2f} mm on average over the particles; {size}."
    )


def _listed(values: torch.Tensor) -> str:
    return " ".join(f"{value:.3f}" for value in values.tolist())


def _number(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"
