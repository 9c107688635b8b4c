"""The approximation that guides a filter as plain data, and made again for a trace.

It is kept whole: a quadratic approximation depends on the order in which measurements were assimilated, and
the fit of an image on whether modes were searched for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from bcppl.distributions.fitted import FittedMixture
from bcppl.errors import InputError
from bcppl.inference.approximations.fits import ViewpointFit
from bcppl.inference.approximations.gaussian import GaussianApproximation
from bcppl.inference.approximations.laplace import QuadraticApproximation
from bcppl.sensors.capabilities import Approximated, FitsPose
from bcppl.traces import Trace

Content = dict[str, Any]


def approximation_content(approximation: Any) -> Content | None:
    """The plain data of an approximation, or None of None.

    Raises:
        InputError: it is of a kind that cannot be saved.
    """
    if approximation is None:
        return None
    if type(approximation) is not GaussianApproximation:
        raise InputError(
            f"an approximation of type {type(approximation).__name__} cannot be saved; save "
            "`population.with_approximation(None)`, from which a filter computes it again."
        )
    relevant = approximation.relevant
    return {
        "pose": approximation.pose,
        "fits": {name: list(each.fit) for name, each in approximation.fits.items()},
        "contacts": [contact.number for contact in approximation.contacts],
        "quadratic": None if approximation.quadratic is None else list(approximation.quadratic),
        "adapted": None if approximation.adapted is None else list(approximation.adapted),
        "relevant": [list(relevant), list(relevant.values())],
        "stale": approximation.stale,
    }


def approximation_of(content: Content | None, trace: Trace) -> GaussianApproximation | None:
    """The approximation that `approximation_content` was given, for the same trace made again.

    Raises:
        InputError: the trace has other measurements.
    """
    if content is None:
        return None
    try:
        scene, actions = trace.args
        held = content["fits"]  # files of before they were kept have names alone
        known = held if isinstance(held, dict) else dict.fromkeys(held)
        fits = {name: _fitted(name, fit, scene, actions, trace) for name, fit in known.items()}
        contacts = tuple(_contact(number, scene, actions, trace) for number in content["contacts"])
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise InputError(
            f"the file has an approximation of other measurements than the trace ({error}); "
            "give the scene and the actions that it was saved with."
        ) from error
    quadratic = content["quadratic"]
    adapted = content.get("adapted", quadratic)  # files of before it was computed have none
    return replace(
        GaussianApproximation(content["pose"], scene),
        fits=fits,
        contacts=contacts,
        quadratic=None if quadratic is None else QuadraticApproximation(*quadratic),
        adapted=None if adapted is None else QuadraticApproximation(*adapted),
        relevant=dict(zip(*content["relevant"], strict=True)),
        stale=content["stale"],
    )


def _fitted(name: str, known: Any, scene: Any, actions: Sequence[Any], trace: Trace) -> ViewpointFit:
    for number, action in enumerate(actions):
        sensor = scene.sensor(action)
        if isinstance(sensor, FitsPose) and sensor.viewpoint(action) == name:
            again = known is None
            fit = sensor.fit(number, action, trace.observations) if again else FittedMixture(*known)
            return ViewpointFit(action, fit)
    raise LookupError(f"no measurement by {name!r}")


def _contact(number: int, scene: Any, actions: Sequence[Any], trace: Trace) -> Approximated:
    action = actions[number]
    return Approximated(number, action, trace.observations[scene.sensor(action).address(number)])
