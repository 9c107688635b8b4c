"""Posterior predictive checks of a run: a p value for each row, and a warning at the end."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from bcppl.inference.population import Population
from bcppl.inference.predictive import THRESHOLD, Check, surprise

MARK = "!"
NAMED = 6  # measurements that a warning names
MEANING = {
    "image": "an unmodelled object may occlude the view, or the camera is not where it is stated to be",
    "normal": "a camera, or another latent value, may be farther off than its prior allows",
    "touch": "the part may have moved between touches, or the finger may have touched something else",
    "contacts": "the peg may have touched something else, slipped in the hand or bent",
}


@dataclass
class PredictiveChecks:
    """The checks of a run so far, and the labels of the measurements that each address came with."""

    labels: dict[str, str] = field(default_factory=dict)

    def cell(self, step: Any) -> str:
        """The p value of a step's measurement, marked where it is small; empty where there is none."""
        population = getattr(step, "population", None)
        if not isinstance(population, Population):
            return ""
        new = [a for a in population.trace.addresses if a not in self.labels]
        is_prior = not self.labels
        self.labels.update(dict.fromkeys(new, step.info.label))
        checks = {} if is_prior else surprise(population, new)
        if not checks:
            return ""
        probability = together(checks.values())
        return f"<{THRESHOLD:g}{MARK}" if probability < THRESHOLD else f"{probability:.3f}"

    def warning(self, step: Any) -> str | None:
        """One sentence on the measurements that do not fit the belief of the last step; None where all do."""
        population = getattr(step, "population", None)
        if not isinstance(population, Population):
            return None
        by_label: dict[str, dict[str, Check]] = {}
        for address, check in surprise(population, list(self.labels)).items():
            by_label.setdefault(self.labels[address], {})[address] = check
        off = {label: checks for label, checks in by_label.items() if together(checks.values()) < THRESHOLD}
        return sentence(off) if off else None


def together(checks: Collection[Check]) -> float:
    """The p value of several sites together, after Bonferroni."""
    return min(1.0, len(checks) * min(check.probability for check in checks))


def sentence(off: Mapping[str, Mapping[str, Check]]) -> str:
    """The warning for measurements that fail their check, by measurement and address."""
    labels = list(off)
    more = f" and {len(labels) - NAMED} more" if len(labels) > NAMED else ""
    kinds = dict.fromkeys(
        min(checks.values(), key=lambda check: check.probability).kind for checks in off.values()
    )
    verb = "does" if len(labels) == 1 else "do"
    return (
        f"posterior predictive check: {', '.join(labels[:NAMED])}{more} {verb} not fit the final belief "
        f"(p value below {THRESHOLD:g}): {', or '.join(MEANING[kind] for kind in kinds)}, or the belief is "
        "wrong; look at the measurement, and try more particles or another seed."
    )
