"""Strata in files: saved in one process, gone on with in another, equal to the bit."""

from __future__ import annotations

from typing import Any

import torch

from bcppl.errors import InputError
from bcppl.inference.saved.populations import (
    Location,
    given_arguments,
    opened,
    population_content,
    population_of,
    write,
)
from bcppl.inference.structures.strata import Strata
from bcppl.traces.run import Program


def save_strata(strata: Strata, path: Location) -> None:
    """Write strata and the state of torch's generator to one HDF5 file, as `bcppl.inference.saved.save` does.

    Args:
        strata: with the populations of all structures.
        path: where to.

    Raises:
        InputError: what is given are no strata, there is no such folder, or something is no plain data.
    """
    if not isinstance(strata, Strata):
        raise InputError(
            f"save_strata is given a {type(strata).__name__}; give strata, and a population to `save` of "
            "bcppl.inference.saved."
        )
    populations = [population_content(each) for each in strata.populations.values()]
    content = {"populations": populations, "log_evidence": strata.log_evidence}
    write(path, content, torch.get_rng_state())


def load_strata(path: Location, program: Program, args: Any = None) -> Strata:
    """The strata in a file that `save_strata` wrote; for torch's generator see `saved.random_state`.

    Args:
        path: of the file.
        program: that the strata are of.
        args: a tuple, the program's arguments; needed where they are no plain data.

    Raises:
        InputError: there is no such file, it is damaged, holds no strata, or is of another program or other
            arguments.
    """
    with opened(path) as content:
        if "log_evidence" not in content:
            raise InputError("it holds a population and no strata; use `load` of bcppl.inference.saved.")
        populations = [
            population_of(each, program, given_arguments(args, each)) for each in content["populations"]
        ]
        return Strata({each.trace.structure: each for each in populations}, content["log_evidence"])
