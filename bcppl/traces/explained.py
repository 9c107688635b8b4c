"""What Pyro and torch say of a program that does not fit its particles, in a sentence that names the site."""

from __future__ import annotations

import re

from bcppl.errors import InferenceError, InputError

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
        "what hangs on a plate a last axis of 1 (`[:, None]`), and put other dimensions into the event "
        "with `.to_event()`."
    )


def unfit_particles(site: str, particles: int, given: int) -> InputError:
    """The error of a site outside all plates whose batch has `given` entries for so many particles."""
    return InputError(
        f"site {site!r} has {given} entries where there are {particles} particles; index the entries of a "
        "sampled vector with `[:, k]`, and make a vector one event with `.to_event(1)`."
    )


def explained(error: Exception, particles: int, last: str | None) -> Exception:
    """An error out of a program as an InputError, where it is one of those that particles bring about.

    Args:
        error: what was raised.
        particles: N.
        last: the address visited last; None if there was none yet.
    """
    if isinstance(error, InputError | InferenceError):
        return error
    said = str(error).partition("\n")[0]
    if found := _MISMATCHED.match(said):
        plate, site, dim, size, given = found.groups()
        return unfit(site, int(dim), plate, int(size), int(given))
    if found := _COLLIDING.match(said):
        plate, other, dim = found.groups()
        return InputError(
            f"plate {plate!r} is put at dimension {dim}, which is that of plate {other!r}"
            "; leave its `dim` out, or take one further to the left (the particles have -1, so -2)."
        )
    if said.startswith("duplicate plate"):
        return InputError(f"two plates, one within the other, have the same name ({said}); rename one.")
    where = "before its first site" if last is None else f"after site {last!r}"
    if _ONE.search(said):
        return InputError(
            f"{where} the program asks a tensor of {particles} particles for one number or one truth "
            "(`if`, `float`, `int`, `math`); compute with all at once, and choose with `torch.where`."
        )
    if _SHAPES.search(said) and str(particles) in re.findall(r"\d+", said):
        return InputError(
            f"{where} the program combines tensors that do not fit ({_clause(said)}), with {particles} "
            "particles; a sampled number has the particles as its last axis, so give what hangs on a plate "
            "a last axis of 1 (`[:, None]`), and index the entries of a sampled vector with `[:, k]`."
        )
    return error


def _clause(said: str) -> str:
    """The first sentence, to stand in brackets."""
    return said.split(". ")[0].rstrip(".").replace("The ", "the ", 1)
