"""Checks of arguments: a number out of range, or a pose that is none, is refused in one sentence."""

from __future__ import annotations

import math
import operator
from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING

from bcppl.errors import InputError

if TYPE_CHECKING:
    from bcppl.arrays import Array

POSE_NUMBERS = "x y z (m) qw qx qy qz in the last dimension"

# What torch's generators and numpy's seed sequences all take.
LARGEST_SEED = 2**63 - 1


def whole_number(what: str, value: object, *, least: int = 1, most: int | None = None) -> int:
    """A whole number from `least` to `most` as an int: numpy's and torch's count, True and 3.0 do not.

    Raises:
        InputError: it is another; `what` begins the sentence, {} for the value: "until makes {} sweeps".
    """
    try:
        count = None if isinstance(value, bool) else operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        count = None
    if count is None or count < least or (most is not None and count > most):
        upper = f"{least} or more" if most is None else f"from {least} to {most}"
        raise InputError(f"{named(what, value)}; give a whole number, {upper}.")
    return count


def seed_number(value: object) -> int:
    """A seed: a whole number from 0 to 2^63 - 1."""
    return whole_number("the seed is {}", value, least=0, most=LARGEST_SEED)


def number_within(
    what: str,
    value: object,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    below: float = math.inf,
    most: float = math.inf,
) -> float:
    """A finite number as a float: above and below bounds that are excluded, from `least` to `most`.

    Raises:
        InputError: it is another, NaN or no number; `what` begins the sentence, {} for the value.
    """
    try:
        number = math.nan if isinstance(value, str | bytes | bool) else float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, RuntimeError, OverflowError):
        number = math.nan
    if math.isfinite(number) and above < number < below and least <= number <= most:
        return number
    bounds = [(above, "above"), (least, "at least"), (below, "below"), (most, "at most")]
    asked = " and ".join(f"{name} {bound:g}" for bound, name in bounds if math.isfinite(bound))
    raise InputError(f"{named(what, value)}; give a finite number{' ' * bool(asked)}{asked}.")


def pose_problem(name: str, pose: Array) -> str | None:
    """Why numbers (..., 7) are no poses x y z (m) qw qx qy qz; None where they are."""
    import numpy as np

    if np.ndim(pose) == 0 or np.shape(pose)[-1] != 7:
        return f"{name} has shape {np.shape(pose)}; a pose is seven numbers {POSE_NUMBERS}."
    if not np.isfinite(pose).all():
        return f"{name} holds a number that is not finite; give finite ones, {POSE_NUMBERS}."
    norm = np.linalg.norm(pose[..., 3:], axis=-1)
    if (wrong := np.abs(norm - 1.0) > 1e-3).any():
        return (
            f"{name} has a quaternion of length {norm[wrong].flat[0]:.4g}; give qw qx qy qz of unit length."
        )
    return None


def address_list(addresses: str | Iterable[str]) -> list[str]:
    """Addresses where one may be given as it is: a word is one address, and not its letters."""
    return [addresses] if isinstance(addresses, str) else list(addresses)


def latent_address(what: str, address: str, latent: Collection[str]) -> None:
    """Refuse an address that is not among the latent ones; `what` begins the sentence, {} the address.

    Raises:
        InputError: names the address and the latent ones.
    """
    if address not in latent:
        listed = ", ".join(latent) or "none"
        raise InputError(f"{named(what, address)}, which is no latent address; latent are {listed}.")


def named(what: str, value: object) -> str:
    """The beginning of a sentence with a value, shortened where it is long, in the place of {}."""
    try:
        text = repr(value)
    except ValueError:  # Python spells no whole number of more than 4300 digits
        text = "a number too long to print"
    return what.replace("{}", text if len(text) <= 200 else f"{text[:30]}... ({len(text)} characters)")
