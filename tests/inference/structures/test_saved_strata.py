"""Strata in files: another process goes on with them to the bit."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from bcppl.errors import InputError
from bcppl.inference import saved
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.structures import (
    Strata,
    generate_strata,
    in_turn,
    jump,
    load_strata,
    resample_strata,
    save_strata,
    within,
)
from bcppl.inference.targets import POSTERIOR
from tests.inference.structures.structural_programs import SEEN, birth, nudge, slipping, summed


def gone_on(strata: Strata) -> Strata:
    move = in_turn(within(metropolis_hastings(nudge)), jump(birth))
    for _ in range(2):
        strata = resample_strata(move(strata, POSTERIOR).strata, 40, least=5)
    return strata


def numbers(strata: Strata) -> str:
    values = [float(strata.log_evidence), float(strata.log_weights.sum()), float(strata["term_0"].sum())]
    return " ".join(value.hex() for value in values)


GOES_ON = """
import sys, torch
from bcppl.inference import saved
from bcppl.inference.structures import load_strata
from tests.inference.structures.structural_programs import summed
from tests.inference.structures.test_saved_strata import gone_on, numbers
strata = load_strata(sys.argv[1], summed)
torch.set_rng_state(saved.random_state(sys.argv[1]))
print(numbers(gone_on(strata)))
"""


@pytest.mark.long
def test_another_process_goes_on_with_equal_bits(tmp_path: Path) -> None:
    torch.manual_seed(0)
    strata = gone_on(generate_strata(summed, (3,), {"y": SEEN}, 40))
    save_strata(strata, tmp_path / "strata.h5")
    expected = numbers(gone_on(strata))
    command = [sys.executable, "-c", GOES_ON, str(tmp_path / "strata.h5")]
    ran = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[3])
    assert ran.stdout.strip() == expected, ran.stderr


def test_what_is_loaded_is_what_was_saved(tmp_path: Path) -> None:
    torch.manual_seed(0)
    strata = generate_strata(slipping, (0,), {}, 20)
    save_strata(strata, tmp_path / "strata.h5")
    loaded = load_strata(tmp_path / "strata.h5", slipping)
    assert loaded.structures == strata.structures and loaded.log_evidence == strata.log_evidence
    with pytest.raises(InputError, match="the file is of 'slipping'"):
        load_strata(tmp_path / "strata.h5", summed)
    saved.save(next(iter(strata.populations.values())), tmp_path / "one.h5")
    with pytest.raises(InputError, match="no strata"):
        load_strata(tmp_path / "one.h5", slipping)
