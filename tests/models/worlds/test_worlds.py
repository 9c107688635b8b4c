"""The truth of a simulated recording is not what inference draws first from the same seed."""

from __future__ import annotations

import torch

from bcppl.models.peg_in_hole import model
from bcppl.traces import simulate


def test_truth_is_drawn_apart_from_the_particles() -> None:
    for seed in (0, 1):
        recording = model.simulate_recording(seed)
        torch.manual_seed(seed)
        prior = simulate(model.program, (model.prepare(recording), []), particles=75)
        apart = (prior[model.pose] - torch.from_numpy(recording.truth)).abs().max(dim=-1).values
        assert float(apart.min()) > 1e-4, f"a particle of seed {seed} starts at the truth"
