"""The line that ends a run: its error and its credible region, or its spread where the truth is unknown."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
import torch

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.cli.report import WIDTHS, conclusion, relative_to_peg, result
from bcppl.geometry.extrusion import round_peg
from bcppl.geometry.holes import hole_of
from bcppl.models import load_recording
from tests.command_line import short
from tests.made_recordings import assert_one_sentence
from tests.sensors.test_probe_rows import probed

TRUTH = torch.as_tensor(short(1).truth, dtype=torch.float64)


def around(pose: torch.Tensor, spread: float, count: int = 400) -> Belief:
    """A belief of that many draws, shifted along the world's axes."""
    shift = torch.zeros(count, 6, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    shift[:, :3] = spread * torch.randn(count, 3, dtype=torch.float64, generator=generator)
    return Belief(poses.retract(pose, shift), torch.zeros(count, dtype=torch.float64))


@pytest.mark.parametrize("off", [0.0, 0.01])
def test_with_the_truth_the_error_and_whether_the_region_contains_it(off: float) -> None:
    away = TRUTH.clone()
    away[0] += off
    line = result(around(away, 0.001), replace(short(1), truth=TRUTH.numpy()))
    assert_one_sentence(line)
    numbers = [float(each) for each in re.findall(r"([\d.]+) mm", line)]
    mean, symmetric, average, radius = numbers
    # Of a normal in three dimensions 90 % lie within 2.50 standard deviations, and the mean distance is 1.60.
    assert mean == pytest.approx(1e3 * off, abs=0.2) and symmetric <= mean
    assert radius == pytest.approx(2.5, abs=0.25)
    assert average == pytest.approx(1.6 if off == 0.0 else 10.1, abs=0.15)
    assert line.endswith("contains the truth." if off == 0.0 else "misses the truth.")


def test_without_the_truth_the_standard_deviations() -> None:
    line = result(around(TRUTH, 0.001), replace(short(1), truth=None))
    assert_one_sentence(line)
    deviations = re.findall(r"standard deviations ([\d.]+) ([\d.]+) ([\d.]+) mm", line)[0]
    assert [float(each) for each in deviations] == pytest.approx([1.0] * 3, abs=0.12)
    assert "90 % credible region is within 2." in line and "truth" not in line


def test_too_few_particles_have_no_region() -> None:
    line = result(around(TRUTH, 0.001, 4), replace(short(1), truth=TRUTH.numpy()))
    assert "too few for a 90 % credible region" in line and "inf" not in line


def test_the_pose_relative_to_the_held_peg_is_that_with_its_tip_at_the_part() -> None:
    """A peg that is off in the hand by as much as the belief is wide: relative to it the part is sure."""
    recording, belief = probed(100), around(TRUTH, 0.001)
    tip = torch.tensor([0.0, 0.0, recording.peg.vertices[:, 2].min(), 1.0, 0.0, 0.0, 0.0])

    def sure(at: torch.Tensor, draws: int) -> torch.Tensor:
        torch.testing.assert_close(poses.compose(at, tip.double())[:3], belief.mean[:3])
        return TRUTH.expand(len(belief), draws, 7)

    relative = relative_to_peg(replace(belief, apparent=sure), recording)
    assert relative is not None and float(relative.spread.max()) < 1e-9
    assert relative_to_peg(belief, recording) is None
    assert relative_to_peg(replace(belief, apparent=sure), short(1)) is None, "no peg is held"


def test_the_last_line_says_in_words_where_and_how_sure_and_what_to_do() -> None:
    recording = load_recording("peg_probe")
    truth = torch.as_tensor(recording.truth, dtype=torch.float64)
    sure, unsure = around(truth, 0.0001), around(truth, 0.01)
    hole = poses.compose(truth, torch.from_numpy(hole_of(recording.part).part_from_hole))
    line = conclusion(sure, recording, False)
    assert_one_sentence(line)
    at = [float(each) for each in re.findall(r"at (-?[\d.]+) (-?[\d.]+) (-?[\d.]+) mm", line)[0]]
    assert at == pytest.approx([1e3 * float(x) for x in hole[:3]], abs=0.05)
    assert line.startswith("the hole is at") and line.endswith("try the insertion (bcppl insert).")
    # Of a normal in three dimensions 90 % lie within 2.50 standard deviations.
    assert float(re.findall(r"sure to ([\d.]+) mm", line)[0]) == pytest.approx(0.25, abs=0.025)
    assert conclusion(unsure, recording, False).endswith("touch or look once more (bcppl probe).")
    assert "see to the warnings" in conclusion(sure, recording, True)
    thick = replace(recording, peg=round_peg(0.06, 0.1))
    assert conclusion(sure, thick, False).endswith("touch or look once more (bcppl probe).")
    pushes = replace(short(1), truth=None)
    assert conclusion(around(TRUTH, 0.001), pushes, False).startswith("the part is at")
    assert "too few to say how sure" in conclusion(around(TRUTH, 0.001, 4), pushes, False)


def test_the_table_fits_a_hundred_columns() -> None:
    assert sum(WIDTHS.values()) + len(WIDTHS) - 1 <= 100
