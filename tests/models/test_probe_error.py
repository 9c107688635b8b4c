"""The error of beliefs given simulated probes: minutes of simulation, so not in every run of the tests."""

from __future__ import annotations

import numpy as np
import pytest

from bcppl.inference.filters.tempered_smc import infer
from bcppl.models.peg_in_hole import model


@pytest.mark.long
def test_six_probes_end_within_three_millimetres_in_the_median() -> None:
    """The world has its own friction, stiffness, time steps and camera noise."""
    errors, gaps = [], []
    for seed in range(100, 106):
        recording = model.simulate_recording(seed)
        *_, last = infer(model, recording, seed=seed)
        errors.append(last.belief.weighted_add(recording.part.surface_points(), recording.truth))
        gaps.append(last.info.truth_gap)
    assert np.median(errors) < 0.003
    assert np.median(gaps) > -5.0
