"""The mistakes in programs that bcppl names, each with the site where it shows."""

from __future__ import annotations

from enum import Enum

from bcppl.errors import InputError


class Fault(Enum):
    """A kind of mistake in a program; `bcppl.traces.checks` states how each is detected."""

    RANDOMNESS = "randomness that is no site"
    STATE = "state that a run leaves behind"
    OVERWRITTEN = "a value of a site is written into"
    ADDRESSES = "addresses that change with values"
    MASKED = "a masked latent site"
    MIXING = "particles that depend on one another"
    ONE_PARTICLE = "particles that depend on a certain one"
    PLACE = "particles that depend on their place"
    COUNT = "particles that depend on their number"
    DEPENDENCE = "a dependence that the trace does not see"
    NOT_A_NUMBER = "a log-probability that is no number"
    SUPPORT = "a support that is not that of the density"
    DENSITY = "draws and a density that disagree"
    BOUND = "a bound that the density exceeds"
    GRADIENT = "a gradient that is cut"


class ProgramError(InputError):
    """A program is wrong: one sentence that states how, at which site, and what to do about it.

    Attributes:
        fault: the kind of mistake.
        site: the address where it shows; None where it is not one site's.
    """

    def __init__(self, fault: Fault, site: str | None, sentence: str) -> None:
        super().__init__(sentence)
        self.fault = fault
        self.site = site
