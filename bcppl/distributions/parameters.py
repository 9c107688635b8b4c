"""Ranges of the parameters of a distribution: declared by its class, checked in one place.

A class declares them as torch's distributions declare their `arg_constraints`:

    parameters = {"scale": POSITIVE, "outlier": PROBABILITY}
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.errors import InputError


@dataclass(frozen=True)
class Range:
    """Finite numbers between two bounds.

    Attributes:
        above: a lower bound that is excluded.
        least: a lower bound that is included.
        below: an upper bound that is excluded.
        most: an upper bound that is included.
        unit: written behind a value that is refused.
        whole: whether the numbers are whole ones; only `least` bounds these.
        optional: whether None may be given.
        latent: whether a tensor (N,), a value for each particle, may be given. It is not checked: a proposed
            value may leave the range, and then has probability zero.
    """

    above: float = -math.inf
    least: float = -math.inf
    below: float = math.inf
    most: float = math.inf
    unit: str = ""
    whole: bool = False
    optional: bool = False
    latent: bool = False

    def checked(self, what: str, value: Any) -> Any:
        """The value as a float or an int.

        Args:
            what: the beginning of the sentence that refuses it, {} for the value.
            value: of the parameter.

        Raises:
            InputError: the value is out of the range.
        """
        if (self.optional and value is None) or (
            self.latent and isinstance(value, Tensor) and value.ndim > 0
        ):
            return value
        if self.whole:
            return whole_number(what, value, least=int(self.least))
        bounds = {"above": self.above, "least": self.least, "below": self.below, "most": self.most}
        return number_within(what, value, **bounds)


POSITIVE = Range(above=0.0)
NONNEGATIVE = Range(least=0.0)
PROBABILITY = Range(above=0.0, below=1.0)
COUNT = Range(least=1, whole=True)


def check_parameters(distribution: Any) -> None:
    """Check the attributes that a distribution's class declares, and make them floats and ints.

    Raises:
        InputError: one is out of its range.
    """
    kind = type(distribution)
    for name, allowed in kind.parameters.items():
        value = getattr(distribution, name)
        what = f"{kind.__name__} has {name} = {{}} {allowed.unit}".rstrip()
        setattr(distribution, name, allowed.checked(what, value))


def check_shape(
    where: str, name: str, value: Tensor | npt.NDArray[Any] | float | None, *shapes: tuple[int, ...]
) -> None:
    """Check that an array, where one is given, has one of some shapes.

    Raises:
        InputError: it has another.
    """
    if isinstance(value, Tensor | np.ndarray) and tuple(value.shape) not in shapes:
        raise InputError(
            f"{where} has {name} of shape {tuple(value.shape)}; give {' or '.join(map(str, shapes))}."
        )
