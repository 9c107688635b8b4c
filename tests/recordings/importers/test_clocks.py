"""How late a force's stamps are, of simulated touches whose mechanism is not the estimate's model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bcppl.recordings.importers.bench.clocks import lateness
from bcppl.recordings.streams import Stream
from tests.recordings.importers.touching_arms import TouchingArm, touching

YIELDING = TouchingArm(dissipation=15.0, threshold=1000.0)  # presses for a while, however hard
STIFF = TouchingArm(stiffness=None, press=3.0)  # stops by its threshold


def yielding(stiffness: float, mass: float, damping: float, contact: float, **other: object) -> TouchingArm:
    arm = replace(YIELDING, stiffness=stiffness, mass=mass, damping=damping, contact=contact)
    return replace(arm, **other)  # type: ignore[arg-type]


PRESSED = yielding(4150.0, 6.0293, 0.9182, 165e3, seed=7, late=-0.055, oblique=0.0423, speed=0.0252)
PRESSED = replace(PRESSED, braking=1.2261, press=0.191, force_noise=0.2373, pose_noise=3.38e-5)
WITHDRAWN = replace(STIFF, late=-0.0338, contact=82100.0, oblique=0.2808, speed=0.00821, threshold=4.3592)
WITHDRAWN = replace(WITHDRAWN, latency=0.0075, braking=1.69, rest=0.0, force_noise=0.0566, pose_noise=2.45e-5)
STOPPED_LATE = replace(STIFF, seed=6, late=-0.0272, contact=98300.0, oblique=0.1581, speed=0.00637)
STOPPED_LATE = replace(STOPPED_LATE, threshold=7.7202, latency=0.0315, braking=0.989, rest=0.0)
STOPPED_LATE = replace(STOPPED_LATE, force_noise=0.2895, pose_noise=4.44e-5)
SLOWED = yielding(1060.0, 7.8889, 0.9832, 58500.0, seed=1, late=-0.0459, oblique=0.2498, speed=0.0156)
SLOWED = replace(SLOWED, slowed=0.8618, approach=0.639, braking=0.7627, press=0.5, force_noise=0.1478)
SLOWED = replace(SLOWED, pose_noise=3.23e-5)
RUBBING = replace(STIFF, seed=1, late=0.0442, contact=74700.0, friction=0.388, oblique=0.7832, speed=0.00281)
RUBBING = replace(RUBBING, threshold=4.4332, latency=0.0289, braking=0.183, force_noise=0.2718)
RUBBING = replace(RUBBING, pose_noise=1.4e-5)
BOUNCING = yielding(4390.0, 3.2906, 0.5, 197e3, seed=1, late=0.0355, oblique=0.1526, speed=0.0147)
BOUNCING = replace(BOUNCING, dissipation=3.4539, braking=0.6676, press=0.377, force_noise=0.0756)
BOUNCING = replace(BOUNCING, pose_noise=4.93e-5)
FILTERED = replace(STIFF, late=-0.0201, contact=15400.0, oblique=0.2493, speed=0.0107, threshold=3.1723)
FILTERED = replace(FILTERED, latency=0.0081, braking=1.48, rest=0.0, force_noise=0.2699)
FILTERED = replace(FILTERED, force_filter=(1, 22.1), pose_noise=3.69e-5)
HEAVY_TOOL = yielding(3770.0, 3.6332, 0.5818, 36500.0, seed=3, late=0.0349, oblique=0.1955, speed=0.0231)
HEAVY_TOOL = replace(HEAVY_TOOL, braking=0.1757, press=0.23, rest=0.0, tool=0.9327, force_noise=0.2898)
HEAVY_TOOL = replace(HEAVY_TOOL, pose_noise=1.58e-5)
ESTIMATED = yielding(2500.0, 4.3149, 0.712, 726e3, seed=6, late=0.0463, oblique=0.2715, speed=0.00853)
ESTIMATED = replace(ESTIMATED, braking=0.1518, press=0.5, rest=0.0, force_noise=0.1462, pose_noise=0.0)
ESTIMATED = replace(ESTIMATED, pose_filter=(2, 17.4))
SELDOM = yielding(3840.0, 5.3852, 0.5296, 370e3, seed=4, late=-0.0114, oblique=0.0293, speed=0.013)
SELDOM = replace(SELDOM, braking=1.6205, press=0.401, force_noise=0.2032, pose_noise=3.3e-5, pose_rate=125.0)
JITTERING = replace(STIFF, seed=2, late=-0.0277, contact=22500.0, oblique=0.0726, speed=0.00701)
JITTERING = replace(JITTERING, threshold=6.8566, latency=0.0025, braking=0.531, force_noise=0.2868)
JITTERING = replace(JITTERING, pose_noise=1.14e-5, jitter=0.0018)


# A path that stops where the force is full looks like one that stops where it begins, 40 ms off.
SINKING = replace(STIFF, seed=2065, touches=7, late=-0.0231, contact=13524.0, dissipation=10.0, oblique=0.082)
SINKING = replace(SINKING, speed=0.02357, threshold=7.328, latency=0.01304, braking=1.4528, press=0.16542)
SINKING = replace(SINKING, rest=0.0, tool=0.8, force_noise=0.29483, pose_noise=2.459e-5)
# Releases that all seem to be 20 to 40 ms before they are.
WITHDRAWN_SMOOTHLY = TouchingArm(seed=1064, late=-0.006858, touches=8, stiffness=1104.1, mass=3.36671)
WITHDRAWN_SMOOTHLY = replace(
    WITHDRAWN_SMOOTHLY, damping=0.63458, contact=27054.7, oblique=0.1112, speed=0.0073
)
WITHDRAWN_SMOOTHLY = replace(
    WITHDRAWN_SMOOTHLY, threshold=1000.0, latency=0.004283, braking=0.95555, rest=0.0
)
WITHDRAWN_SMOOTHLY = replace(WITHDRAWN_SMOOTHLY, press=0.4562, dissipation=10.0, force_noise=0.22996)
WITHDRAWN_SMOOTHLY = replace(WITHDRAWN_SMOOTHLY, pose_noise=2.6925e-5)


@pytest.mark.long
@pytest.mark.parametrize(
    "arm",
    [
        pytest.param(PRESSED, id="an arm that yields"),
        pytest.param(SINKING, id="a soft pad and a heavy tool"),
        pytest.param(WITHDRAWN, id="an arm that stops at once"),
        pytest.param(WITHDRAWN_SMOOTHLY, id="an arm that yields and is withdrawn smoothly"),
        pytest.param(STOPPED_LATE, id="an arm that stops late"),
        pytest.param(SLOWED, id="an approach that slows down"),
        pytest.param(RUBBING, id="an oblique touch with friction"),
        pytest.param(BOUNCING, id="a peg that bounces"),
        pytest.param(FILTERED, id="a force through a low-pass filter"),
        pytest.param(HEAVY_TOOL, id="a tool that is felt to accelerate"),
        pytest.param(ESTIMATED, id="a path through a low-pass filter"),
        pytest.param(SELDOM, id="a path at 125 Hz"),
        pytest.param(JITTERING, id="a path with jittering stamps"),
    ],
)
def test_it_is_unknown_or_no_farther_off_than_three_spreads(arm: TouchingArm) -> None:
    force, position, late = touching(arm)
    found = lateness(force, position, within=0.1)
    assert found is None or abs(found.late - late) <= 3.0 * found.spread


def apart(first: TouchingArm, second: TouchingArm, seconds: float) -> tuple[Stream, Stream, float]:
    """The streams of touches after which the arm rests for so long, and touches again; between, s."""
    (felt, path, _), (felt_later, path_later, _) = touching(first), touching(second)
    rng = np.random.default_rng(0)
    step = felt.step
    steps = round((float(felt.times[-1]) + seconds) / step)
    shift = float(felt.times[0]) + steps * step - float(felt_later.times[0])
    idle = first.force_noise * rng.normal(size=(steps - len(felt.times), 3))
    force = np.concatenate([felt.values, idle, felt_later.values])
    still = np.arange(path.times[-1] + path.step, path_later.times[0] + shift, path.step)
    rest = path.values[-1] + first.pose_noise * rng.normal(size=(len(still), 3))
    position = Stream(
        "position",
        np.concatenate([path.times, still, path_later.times + shift]),
        np.concatenate([path.values, rest, path_later.values - path_later.values[0] + path.values[-1]]),
    )
    return Stream("force", felt.times[0] + step * np.arange(len(force)), force), position, shift


@pytest.mark.long
def test_a_clock_that_drifts_is_not_one_that_was_set() -> None:
    one, other = replace(YIELDING, seed=1, late=0.01), replace(YIELDING, seed=2, late=0.04)
    force, position, between = apart(one, other, seconds=400.0)
    found = lateness(force, position, within=0.1, drifts=True)
    assert found is not None and not found.contradicting
    assert abs(found.drift - 0.03 / between) < 3.0 * found.drift_spread < 3e-5
    assert abs(found.late - 0.025) < 3.0 * found.spread < 0.01
    # Clocks that do not drift cannot be apart by that much unless one was set.
    steady = lateness(force, position, within=0.1)
    assert steady is None or steady.contradicting
