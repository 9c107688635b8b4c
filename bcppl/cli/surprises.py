"""Which measurements of a run do not fit its belief: what the table and its last line say of that."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from bcppl.inference.population import Population
from bcppl.inference.predictive import THRESHOLD, Check, surprise

MARK = "!"
NOT_TOLD = "p value: empty, for nothing in this model is a depth image, a contact manifold or normal."
NAMED = 6  # measurements that a warning names
MEANING = {
    "image": "something unknown may stand before the camera, or it is not where it says",
    "normal": "a camera, or what else is latent, may be farther off than was stated",
    "contacts": "the peg may have touched something else, slipped in the hand or bent",
}


@dataclass
class Watch:
    """A run as it goes on: which addresses came with which measurement.

    Attributes:
        labels: of the measurement that each address came with.
        told: whether any p value could be told.
    """

    labels: dict[str, str] = field(default_factory=dict)
    told: bool = False

    def cell(self, step: Any) -> str:
        """The p value of what came with a step, marked where surprising; empty where none can be told."""
        population = getattr(step, "population", None)
        if not isinstance(population, Population):
            return ""
        new = [a for a in population.trace.addresses if a not in self.labels]
        nothing_measured = not self.labels
        self.labels.update(dict.fromkeys(new, step.info.label))
        found = {} if nothing_measured else surprise(population, new)
        if not found:
            return ""
        self.told = True
        least = together(found.values())
        return f"{least:.1g}{MARK}" if least < THRESHOLD else f"{least:.2f}"

    def warning(self, step: Any) -> str | None:
        """One sentence on the measurements that do not fit the belief of the last step; None where all do."""
        population = getattr(step, "population", None)
        if not isinstance(population, Population) or not self.told:
            return None
        found = surprise(population, list(self.labels))
        by_label: dict[str, dict[str, Check]] = {}
        for address, each in found.items():
            by_label.setdefault(self.labels[address], {})[address] = each
        off = {label: sites for label, sites in by_label.items() if together(sites.values()) < THRESHOLD}
        return None if not off else sentence(off)


def together(found: Collection[Check]) -> float:
    """The p value of several sites together, after Bonferroni."""
    return min(1.0, len(found) * min(each.probability for each in found))


def sentence(off: Mapping[str, Mapping[str, Check]]) -> str:
    """The warning for surprising sites by measurement and address."""
    labels = list(off)
    more = f" and {len(labels) - NAMED} more" if len(labels) > NAMED else ""
    kinds = dict.fromkeys(
        min(sites.values(), key=lambda each: each.probability).kind for sites in off.values()
    )
    verb = "does" if len(labels) == 1 else "do"
    return (
        f"surprising: {', '.join(labels[:NAMED])}{more} {verb} not fit the final belief (p value below "
        f"{THRESHOLD:g}): {', or '.join(MEANING[kind] for kind in kinds)}, or the belief is wrong; "
        "look at what was measured, and try more particles or another seed."
    )
