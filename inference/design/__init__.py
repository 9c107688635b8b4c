"""Bayesian experimental design: candidates for the next measurement, ranked by expected information gain."""

from bcppl.exports import exported

__getattr__, __dir__, __all__ = exported(__name__)
