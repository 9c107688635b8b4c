"""Summaries of a run's latent sites: which hole it is, how a peg sits in the hand."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from rich.markup import escape
from rich.table import Table
from torch import Tensor

from bcppl import poses
from bcppl.distributions.support import freedom_of, support_of
from bcppl.inference.population import Population
from bcppl.inference.summaries import mean, probabilities, quantiles
from bcppl.untrusted.visible_text import visible

LIKELIEST = 5  # of a discrete site's values
ROWS = 12  # of one site's numbers; run.json holds them all
INTERVAL = (0.05, 0.95)


def values_of(step: Any) -> Mapping[str, Tensor]:
    """The values (N, *event) at every latent address after a step; none where it has no population."""
    population = getattr(step, "population", None)
    return dict(population.trace.choices) if isinstance(population, Population) else {}


def summarised(step: Any) -> dict[str, dict[str, Any]]:
    """A summary of every latent site after a step by its address, made of plain lists and numbers.

    A pose has its `mean` (7 numbers) and `spread` (6: metres, radians), a discrete site its likeliest
    `values`, their `probabilities`, and that of all `others` together, any other site its `mean` and the ends
    of the interval that holds 90 % of the weight, `from` and `to`, each number by itself.
    """
    population = getattr(step, "population", None)
    if not isinstance(population, Population):
        return {}
    return {a: _summary(population, a) for a in population.trace.choices}


def _summary(population: Population, address: str) -> dict[str, Any]:
    values, distribution = population.trace.choices[address], population.trace.distributions[address]
    if freedom_of(distribution) is not None:
        if values.ndim != 2:
            return {"kind": "several poses"}
        belief = population.belief(address)
        return {"kind": "pose", "mean": belief.mean.tolist(), "spread": belief.spread.tolist()}
    if _is_discrete(values, distribution):
        marginal = probabilities(population, address)
        order = marginal.probabilities.argsort(descending=True, stable=True)[:LIKELIEST]
        kept = marginal.probabilities[order]
        others = max(0.0, 1.0 - float(kept.sum())) if len(order) < len(marginal.probabilities) else 0.0
        return {
            "kind": "discrete",
            "values": marginal.values[order].tolist(),
            "probabilities": kept.tolist(),
            "others": others,
        }
    low, high = quantiles(population, address, list(INTERVAL))
    middle = mean(population, address)
    return {"kind": "real", "mean": middle.tolist(), "from": low.tolist(), "to": high.tolist()}


def _is_discrete(values: Tensor, distribution: Any) -> bool:
    if not values.is_floating_point():
        return True
    try:
        return bool(support_of(distribution).is_discrete)
    except (NotImplementedError, AttributeError):
        return False


def table(summaries: Mapping[str, Mapping[str, Any]], pose: str) -> Table:
    """The summaries for a terminal, of all sites but the sought pose; without rows where there are none."""
    shown = Table(title="other latent values", title_justify="left", box=None, pad_edge=False)
    for name in ("site", "mean (SI units) or probability", "90 % interval, or standard deviation"):
        shown.add_column(name, justify="left")
    for address, summary in summaries.items():
        for row in _rows(address, summary) if address != pose else ():
            shown.add_row(*(escape(visible(cell)) for cell in row))
    return shown


def _rows(address: str, summary: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    if summary["kind"] == "pose":
        center, spread = torch.tensor(summary["mean"], dtype=torch.float64), summary["spread"]
        turn = poses.local(poses.identity(), center)[3:].tolist()
        place, off = (_listed([1e3 * x for x in part]) for part in (center[:3].tolist(), spread[:3]))
        yield (f"{address} x y z", f"{place} mm", f"± {off} mm")
        turned, off = (_listed([math.degrees(x) for x in part]) for part in (turn, spread[3:]))
        yield (f"{address} turn", f"{turned}°", f"± {off}°")
    elif summary["kind"] == "discrete":
        pairs = zip(summary["values"], summary["probabilities"], strict=True)
        likely = [f"{_value(value)}: {100 * share:.1f} %" for value, share in pairs]
        if summary["others"] > 0.0:
            likely.append(f"others: {100 * summary['others']:.1f} %")
        yield (address, ", ".join(likely), "")
    elif summary["kind"] == "real":
        middle, low, high = (torch.tensor(summary[k], dtype=torch.float64) for k in ("mean", "from", "to"))
        places = list(np.ndindex(*middle.shape))
        for at in places[:ROWS]:
            name = f"{address}[{', '.join(map(str, at))}]" if at else address
            yield (name, f"{float(middle[at]):.4g}", f"{float(low[at]):.4g} to {float(high[at]):.4g}")
        if len(places) > ROWS:
            yield (f"{address}: {len(places) - ROWS} more", "in run.json", "")
    else:
        yield (address, summary["kind"], "in the belief files")


def _listed(values: list[float]) -> str:
    return " ".join(f"{value:.3f}" for value in values)


def _value(value: Any) -> str:
    if isinstance(value, list):
        return f"({' '.join(map(_value, value))})"
    return f"{value:g}" if isinstance(value, float) else str(value)
