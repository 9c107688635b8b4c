"""What each part of the default gives and costs, on the same recordings: a row for every variant."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from report import Row, show
from scenes import (
    END,
    MISSED,
    VISION,
    Moment,
    default_run,
    every,
    followed,
    model,
    moment_of,
    quantile,
    timed,
)
from scipy.stats import bootstrap

from bcppl.inference.filters import tempered_smc
from bcppl.inference.filters.smc import Step, smc
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.kernels import Kernel, metropolis_hastings, sequence
from bcppl.inference.kernels.kernel import Move
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.proposals.coordinates import continuous_addresses
from bcppl.inference.proposals.walk import joint_drift
from bcppl.inference.resampling import adaptive, systematic
from bcppl.models import peg_in_hole
from bcppl.models.worlds.bench.scene import bench_scene
from bcppl.sensors import Recording, View
from bcppl.sweeps import one_line

DEFAULT, SEEN, FREE_SPACE = "default", "vision only", "no free-space evidence"
MANY, FEW = 1000, 10  # particles that only so many scenes are run with
WALK = (0.2, 2.0)  # scales of the random walks, those of the default
SWEEPS = 6


class Variant(NamedTuple):
    """One variant on one scene: where it got to, wall time (s), and why it was missed."""

    end: Moment
    wall: float
    missed: str = ""


Variants = dict[str, Variant]


def walked(pose: str) -> Kernel:
    """Every latent value walks alone, then all of them together: no proposal knows of images or touches."""

    def moved(population: Population) -> Move:
        addresses = continuous_addresses(population.trace)
        others = [address for address in addresses if address != pose]
        alone = [metropolis_hastings(drift(address, WALK)) for address in addresses]
        together = [metropolis_hastings(joint_drift(pose, *others, scales=WALK))] if others else []
        return sequence([*alone, *together])(population)

    return moved


def by_walks(recording: Recording, particles: int, seed: int) -> Iterator[Step]:
    """The same model, its likelihoods tempered, its particles moved by random walks alone."""
    step = tempered(walked(model.pose), sweeps=SWEEPS, resample=adaptive(systematic, 0.5))
    return smc(model, recording, step=step, particles=particles, seed=seed)


def of_touches(recording: Recording, particles: int, seed: int) -> Iterator[Step]:
    """The windows without the images."""
    touches = [m for m in recording.measurements if not isinstance(m.action, View)]
    return default_run(dataclasses.replace(recording, measurements=touches), particles, seed)


def by_contacts(recording: Recording, particles: int, seed: int) -> Iterator[Step]:
    """Where contact was felt, in the peg's frame, by simulated physics: `peg_in_hole` without peg poses."""
    model = peg_in_hole.model
    # As wide as a room: the measured pose of the peg carries no information.
    scene = model.prepare(recording, translation_scale=10.0, rotation_scale=100.0)
    return tempered_smc.infer(model, recording, particles=particles, seed=seed, scene=scene)


def without_free_space(recording: Recording, particles: int, seed: int) -> Iterator[Step]:
    """Stamps without contact do not count."""
    scene = model.prepare(recording, free_space=False)
    return default_run(recording, particles, seed, scene)


Way = Callable[[Recording, int, int], Iterator[Step]]


def ways(particles: int, many: bool) -> dict[str, tuple[Way, int]]:
    """The variants beside the default and vision alone, by name: how, and with how many particles."""
    found: dict[str, tuple[Way, int]] = {"contact only, same plan": (of_touches, particles)}
    found["no measured peg pose (peg_in_hole: contacts by physics)"] = by_contacts, particles
    found[FREE_SPACE] = without_free_space, particles
    found["random walks only"] = by_walks, particles
    for count in (25, 300, *([MANY] if many else [])):
        found[f"N = {count}"] = default_run, count
    return found


def of_scene(seed: int, particles: int, first: int) -> Variants:
    """All variants on one scene's recording, which the default's plan has made.

    Args:
        seed: of the scene and of inference.
        particles: of the default.
        first: seed of the first scene, from which the first few are run with many particles too.
    """
    found, _, recording = followed(seed, particles)
    variants = {DEFAULT: Variant(found.at(END), found.wall, found.missed)}
    vision = found.seconds.get("vision", math.nan)
    variants[SEEN] = Variant(found.at(VISION), vision, "" if VISION in found.moments else found.missed)
    scene = bench_scene(seed)
    for name, (way, count) in ways(particles, seed < first + FEW).items():
        if recording is None:
            variants[name] = Variant(MISSED, math.nan, found.missed)
            continue
        seconds: dict[str, float] = {}
        try:
            with timed(seconds, name):
                *_, last = way(recording, count, seed)
            variants[name] = Variant(moment_of(last.belief, scene), seconds[name])
        except Exception as error:
            variants[name] = Variant(MISSED, math.nan, one_line(error))
    summary = ", ".join(f"{name} {v.end.weighted_add:.2f} mm {v.wall:.1f} s" for name, v in variants.items())
    print(f"scene {seed} ({found.part}, {found.clearance:g} mm): {summary}", flush=True)
    return variants


def lost(seed: int, why: str) -> Variants:
    """A scene whose process died: of which variant is not known, so none has a result."""
    return {name: Variant(MISSED, math.nan, why) for name in (DEFAULT, SEEN)}


def interval(differences: Sequence[float]) -> tuple[float, float]:
    """Of the median of paired differences, 95 %; differences of misses may be infinite."""
    if len(differences) < 2:
        return math.nan, math.nan

    def middle(x: Any, axis: int = -1) -> Any:
        return np.quantile(x, 0.5, axis=axis, method="lower")

    with np.errstate(invalid="ignore"):  # its standard error, which is not asked for
        drawn = bootstrap((differences,), middle, method="percentile", rng=0, n_resamples=4999)
    low, high = np.quantile(drawn.bootstrap_distribution, [0.025, 0.975], method="nearest")
    return float(low), float(high)


def rows_of(seeds: Sequence[int], particles: int, jobs: int) -> list[Row]:
    """The table of variants and its rows."""
    results = list(every(partial(of_scene, particles=particles, first=seeds[0]), seeds, jobs, lost))
    rows, lines = list[Row](), list[list[Any]]()
    names = list(dict.fromkeys(name for result in results for name in result))
    for name in names:
        pairs = [(result[name], result[DEFAULT]) for result in results if name in result]
        adds = [own.end.weighted_add for own, _ in pairs]
        # A scene that both missed does not count for their difference.
        apart = [
            own.end.weighted_add - default.end.weighted_add
            for own, default in pairs
            if not (own.missed and default.missed)
        ]
        middle, (low, high) = quantile(apart, 0.5), interval(apart)
        wall = [own.wall for own, _ in pairs if not own.missed]
        ends = [
            quantile([getattr(own.end, what) for own, _ in pairs], 0.5)
            for what in ("along", "across", "tilt")
        ]
        missed = sum(bool(own.missed) for own, _ in pairs)
        shown = name if name != DEFAULT else f"default, N = {particles}"
        lines.append(
            [shown, len(pairs), missed, quantile(adds, 0.5), quantile(adds, 0.9), middle, low, high, *ends,
             quantile(wall, 0.5)]
        )  # fmt: skip
        rows += [
            Row(f"{shown}: weighted ADD at the end, median", quantile(adds, 0.5), "mm"),
            Row(f"{shown}: weighted ADD at the end, 90 %", quantile(adds, 0.9), "mm"),
            Row(f"{shown}: minus the default's, median ({low:.3f} to {high:.3f})", middle, "mm"),
            Row(f"{shown}: wall, median", quantile(wall, 0.5), "s"),
            Row(f"{shown}: scenes missed", missed, "scenes"),
        ]
    show(
        "variants on the same recordings: weighted ADD at 6 s, mm; paired with the default, 95 % interval",
        [
            "",
            "scenes",
            "missed",
            "median",
            "90 %",
            "minus default",
            "from",
            "to",
            "along",
            "across",
            "tilt",
            "s",
        ],
        lines,
    )
    for result in results:
        for name, variant in result.items():
            if variant.missed:
                print(f"missed, {name}: {variant.missed}")
    print("no row for delayed acceptance: the default simulates no physics, so there is nothing to delay.")
    return [row._replace(value=math.nan) if math.isinf(row.value) else row for row in rows]
