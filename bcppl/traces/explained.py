"""Errors of Pyro and torch in a program that does not fit its particles, as sentences that name the site."""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Any

import torch
from torch import Tensor

from bcppl.distributions.support import masks
from bcppl.errors import InferenceError, InputError, NotANumberError
from bcppl.traces.faults import Fault, ProgramError

_MISMATCHED = re.compile(r"Shape mismatch inside plate\('(.+)'\) at site (.+) dim (-?\d+), (\d+) vs (\d+)")
_COLLIDING = re.compile(r'at plates "(.+)" and "(.+)", collide at dim=(-?\d+)')
_SHAPES = re.compile(
    r"must match the (existing )?size|expects each tensor to be equal size|inconsistent tensor size|"
    r"shape mismatch|shapes cannot be multiplied|could not be broadcast|incompatible (matrix|tensor)"
)
_ONE = re.compile(
    r"Boolean value of Tensor|converted to (a )?(Python )?[sS]calar|"
    r"single element can be converted to an index"
)


def unfit(site: str, dim: int, plate: str, size: int, given: int) -> InputError:
    """The error of a site whose batch shape has `given` entries where a plate has `size`."""
    return InputError(
        f"site {site!r} has {given} entries at dimension {dim} where plate {plate!r} has {size}; inside "
        "a program the particles are the last batch dimension and plates lie to the left of it, so give "
        "what depends on a plate a last axis of 1 (`[:, None]`), and put other dimensions into the event "
        "with `.to_event()`."
    )


def unfit_particles(site: str, particles: int, given: int) -> InputError:
    """The error of a site outside all plates whose batch has `given` entries for so many particles."""
    return InputError(
        f"site {site!r} has {given} entries where there are {particles} particles; index the entries of a "
        "sampled vector with `[:, k]`, and make a vector one event with `.to_event(1)`."
    )


def other_addresses(addresses: Collection[str]) -> InputError:
    """The error of values at which a program visits other addresses than before."""
    return ProgramError(
        Fault.ADDRESSES,
        min(addresses),
        "new values changed which addresses the program visits "
        f"({', '.join(map(repr, sorted(addresses)))}); "
        "sample such a site always, from its prior, and where it plays no part ignore its value with "
        "`torch.where`, or make a trace for each structure.",
    )


def unsampled(address: str, distribution: Any) -> InputError:
    """The error of a site that is to be sampled from a distribution that cannot be."""
    return InputError(
        f"site {address!r} is to be sampled, but its distribution {type(distribution).__name__} defines no "
        "`sample`; give the site an observation, or the distribution a sampler."
    )


def refuse_masked(address: str, distribution: Any) -> None:
    """Refuse the distribution of a latent site that masks some of its values."""
    if masks(distribution):
        raise ProgramError(
            Fault.MASKED,
            address,
            f"site {address!r} is latent and its distribution is masked, so that the target would be "
            "improper; sample it from its prior for every particle, and where it plays no part ignore its "
            "value with `torch.where`.",
        )


def changed_outside(address: str, name: str) -> ProgramError:
    """The error of a site that reads a variable which has changed before it was evaluated."""
    return ProgramError(
        Fault.DEPENDENCE,
        address,
        f"site {address!r} reads {name!r} from outside its distribution, and that has changed since the "
        "program was run; hold all that the distribution depends on in it, as an attribute that is made in "
        "each run.",
    )


def hidden_site(address: str) -> InputError:
    """The error of a proposal that asks for a hidden site."""
    return InputError(
        f"site {address!r} is hidden from a proposal, which asked for its distribution or log-probability; "
        "let the proposal read earlier sites only."
    )


def not_a_number(
    address: str, log_prob: Tensor, latent: Tensor | None, observed: Tensor | None
) -> NotANumberError:
    """The error of a site whose log-probability (N,) is NaN or +inf, of a latent or an observed value."""
    missing = None if observed is None else torch.isnan(observed)
    if missing is not None and bool(missing.any()):
        return NotANumberError(
            f"the observation at site {address!r} is NaN in {int(missing.sum())} of {missing.numel()} "
            "entries; leave out what was not measured, or mask it in the site's distribution."
        )
    which = (torch.isnan(log_prob) | (log_prob == torch.inf)).nonzero().flatten().tolist()
    first = float(log_prob[which[0]])
    reason = "a value or a parameter of its distribution is out of range there."
    if latent is not None and first == torch.inf:
        reason = (
            f"rounding to {latent.dtype} put values on the edge of the support, where the density is "
            "infinite; give the prior parameters in double precision, or less extreme ones."
        )
    return NotANumberError(
        f"site {address!r} has a log-probability of {first} for {len(which)} of {len(log_prob)} particles "
        f"(first: {', '.join(map(str, which[:5]))}); {reason}"
    )


def explained(error: Exception, particles: int, last: str | None) -> Exception:
    """An error of a program, after its `last` site, as an InputError where the particles are its cause."""
    if isinstance(error, InputError | InferenceError):
        return error
    message = str(error).partition("\n")[0]
    if match := _MISMATCHED.match(message):
        plate, site, dim, size, given = match.groups()
        return unfit(site, int(dim), plate, int(size), int(given))
    if match := _COLLIDING.match(message):
        plate, other, dim = match.groups()
        return InputError(
            f"plate {plate!r} is put at dimension {dim}, which is that of plate {other!r}"
            "; leave its `dim` out, or take one further to the left (the particles have -1, so -2)."
        )
    if message.startswith("duplicate plate"):
        return InputError(f"two plates, one within the other, have the same name ({message}); rename one.")
    where = "before its first site" if last is None else f"after site {last!r}"
    if _ONE.search(message):
        return InputError(
            f"{where} the program asks a tensor of {particles} particles for one number or one truth "
            "(`if`, `float`, `int`, `math`); compute with all at once, and choose with `torch.where`."
        )
    if _SHAPES.search(message) and str(particles) in re.findall(r"\d+", message):
        return InputError(
            f"{where} the program combines tensors that do not fit ({_clause(message)}), with {particles} "
            "particles; a sampled number has the particles as its last axis, so give what depends on a plate "
            "a last axis of 1 (`[:, None]`), and index the entries of a sampled vector with `[:, k]`."
        )
    return error


def _clause(message: str) -> str:
    """The first sentence, to stand in brackets."""
    return message.split(". ")[0].rstrip(".").replace("The ", "the ", 1)
