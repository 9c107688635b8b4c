"""When to resample: always, never or adaptively, as decorators of a scheme (`bcppl.inference.schemes`)."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from bcppl.arguments import number_within
from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.inference.schemes import Scheme, multinomial, residual, ssp, stratified, systematic

__all__ = [
    "Resample",
    "Scheme",
    "adaptive",
    "always",
    "multinomial",
    "never",
    "residual",
    "ssp",
    "stratified",
    "systematic",
]


# The resampled population and its ancestors (N,), or the same population and None.
Resample = Callable[[Population], tuple[Population, Tensor | None]]


def always(scheme: Scheme = systematic) -> Resample:
    """Resample at every opportunity.

    Raises:
        InputError: it is given no scheme.
    """
    if not callable(scheme):
        raise InputError(f"resampling is given {scheme!r} in place of a scheme; give one such as systematic.")

    def resample(population: Population) -> tuple[Population, Tensor | None]:
        ancestors = scheme(population.log_weights)
        return population.selected(ancestors), ancestors

    return resample


def check_resample(where: str, resample: object) -> None:
    """Check that an argument is a `Resample`, and not a scheme by itself.

    Raises:
        InputError: it is no function of a population.
    """
    if not callable(resample) or resample in (systematic, stratified, multinomial, residual, ssp):
        name = getattr(resample, "__name__", type(resample).__name__)
        raise InputError(
            f"{where} is given {name} as resample, which does not define when to resample; "
            "give always(scheme), adaptive(scheme, 0.5) or never."
        )


def never(population: Population) -> tuple[Population, Tensor | None]:
    """Do not resample."""
    return population, None


def adaptive(scheme: Scheme = systematic, threshold: float = 0.5) -> Resample:
    """Resample when the effective sample size falls below a share `threshold` of the particles.

    Raises:
        InputError: the threshold is no number from 0 (never) to 1.
    """
    threshold = number_within("adaptive is given the threshold {}", threshold, least=0.0, most=1.0)
    resample = always(scheme)

    def when_needed(population: Population) -> tuple[Population, Tensor | None]:
        if population.effective_sample_size >= threshold * len(population):
            return population, None
        return resample(population)

    return when_needed
