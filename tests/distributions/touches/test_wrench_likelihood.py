"""The wrench's likelihood: normalised, robust, and highest where the wrench came from."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from torch import Tensor

from bcppl.contact.physics import PegPhysics
from bcppl.contact.probe_rollout import ProbeRollout
from bcppl.contact.sensing.location import ContactSensing
from bcppl.distributions.contact import Wrench
from bcppl.errors import InputError
from bcppl.geometry.extrusion import block, box_peg
from bcppl.robot.motion import Probe

PEG = box_peg(0.016, 0.05)


@dataclass(frozen=True)
class Given:
    """A track whose wrenches (N, T, 6) are given."""

    values: Tensor
    diverged: Tensor
    inputs: tuple[Tensor, ...] = field(default=())

    def __len__(self) -> int:
        return len(self.values)

    def wrench(self, first: int, last: int) -> Tensor:
        return self.values[:, first:last]


def given(particles: int, stamps: int = 1, force: float = 8.0) -> Given:
    values = torch.tensor([0.0, 0.0, force, 0.1, -0.2, 0.05], dtype=torch.float64)
    return Given(values.expand(particles, stamps, 6), torch.zeros(particles, dtype=torch.bool))


def test_the_density_integrates_to_one() -> None:
    """Force and torque are independent, each isotropic about what is expected: two radial integrals."""
    radius = torch.logspace(-4, 2.5, 4001, dtype=torch.float64)
    for force, relative, bias in ((0.0, 0.3, 0.0), (8.0, 0.0, 0.4), (8.0, 0.3, 0.4)):
        track = given(len(radius), force=force)
        shift = torch.full((len(radius), 6), bias, dtype=torch.float64)
        likelihood = Wrench(track, 0, 1, 0.3, 0.02, relative, bias=shift)
        center = track.values + bias
        peak = likelihood.log_prob(center).exp()[0]
        masses = []
        for axis, unit in ((1, 1.0), (4, 0.1)):
            value = center.clone()
            value[:, 0, axis] += unit * radius
            density = likelihood.log_prob(value).exp()
            masses.append(torch.trapezoid(4.0 * math.pi * (unit * radius) ** 2 * density, unit * radius))
        assert float(masses[0] * masses[1] / peak) == pytest.approx(1.0, abs=1e-3)


def test_samples_follow_the_density() -> None:
    """The mean of q / p over samples of p is the mass of q: 1 for another normalised q that p covers."""
    torch.manual_seed(0)
    track = given(40000)
    bias = 0.3 * torch.ones(40000, 6, dtype=torch.float64)
    p = Wrench(track, 0, 1, 0.5, 0.03, 0.1, outlier=0.2, bias=bias)
    sample = p.sample()
    for narrower in (
        Wrench(track, 0, 1, 0.45, 0.03, 0.1, outlier=0.2, bias=bias),
        Wrench(track, 0, 1, 0.5, 0.027, 0.1, outlier=0.2, bias=bias),
        Wrench(track, 0, 1, 0.5, 0.03, 0.1, outlier=0.1, bias=bias),
    ):
        ratio = (narrower.log_prob(sample) - p.log_prob(sample)).exp()
        assert float(ratio.mean()) == pytest.approx(1.0, abs=5.0 * float(ratio.std()) / 200.0)
    assert bool((p.log_prob(sample) <= p.log_prob_bound).all())


def test_a_stamp_by_hand_and_what_is_not_looked_at() -> None:
    track = given(1, stamps=30)
    likelihood = Wrench(track, 3, 30, 0.3, 0.02, 0.0, outlier=1e-12, every=10)
    value = track.values[0, 3:30].clone()
    value[7, 0] += 0.6  # stamp 10, which is looked at
    value[5] += 100.0  # stamp 8, which is not
    peak = -3.0 * (math.log(0.3) + math.log(0.02)) - 3.0 * math.log(2.0 * math.pi)
    assert float(likelihood.log_prob(value)) == pytest.approx(2.0 * peak - 2.0, abs=1e-9)
    value[17] = torch.nan  # stamp 20: not measured
    assert float(likelihood.log_prob(value)) == pytest.approx(peak - 2.0, abs=1e-9)
    # An outlier costs no more than the wide component says, however many deviations it is off.
    robust, far = Wrench(track, 0, 1, 0.3, 0.02, 0.0), track.values[0, :1].clone()
    far[0, 0] += 3.0
    assert float(robust.log_prob(far)) > float(robust.log_prob(track.values[0, :1])) - 11.0


def test_diverged_particles_are_impossible_and_bad_settings_refused() -> None:
    track = given(3)
    lost = Given(torch.where(torch.tensor([False, True, False])[:, None, None], torch.nan, track.values),
                torch.tensor([False, True, False]))  # fmt: skip
    likelihood = Wrench(lost, 0, 1, 0.3, 0.02)
    assert torch.isneginf(likelihood.log_prob(track.values[0])).tolist() == [False, True, False]
    assert torch.isnan(likelihood.sample()).all(dim=-1)[:, 0].tolist() == [False, True, False]
    with pytest.raises(InputError, match=r"Wrench has a bias of shape \(6,\); give \(3, 6\)"):
        Wrench(track, 0, 1, 0.3, 0.02, bias=torch.zeros(6))
    with pytest.raises(InputError, match="Wrench has first = 2 and last = 1; give first before last"):
        Wrench(track, 2, 1, 0.3, 0.02)


def test_the_truth_explains_its_own_wrench_best() -> None:
    """A press near the block's edge: whichever way the block is off, force or torque differ."""
    times, command = np.array([0.0, 0.4, 0.8]), np.tile([0.012, 0.0, 0.06, 1.0, 0, 0, 0], (3, 1))
    command[1:, 2] = 0.045
    stiffness, damping = np.repeat([1000.0, 150.0], 3), np.repeat([400.0, 10.0], 3)
    probe = Probe("press", times, command, stiffness, damping, np.arange(80) / 100.0)
    part = torch.zeros(5, 7, dtype=torch.float64)
    part[:, 3], part[1, 0], part[2, 0], part[3, 2], part[4, 2] = 1.0, 0.002, -0.002, 0.001, -0.001
    sensing = ContactSensing(PEG, rate=100.0)
    track = ProbeRollout.start(PegPhysics(block((0.03, 0.03, 0.02)), PEG), sensing, part, probe)
    torch.manual_seed(1)
    likelihood = Wrench(track, 0, 80, 0.2, 0.003, 0.02, every=5)
    seen = likelihood.sample()[0]
    log_prob = likelihood.log_prob(seen)
    assert bool((log_prob[0] > log_prob[1:] + 5.0).all())
    # The mutants: a wrench on the part instead of the peg, and torques in N mm.
    flipped, scaled = -seen, seen * torch.tensor([1, 1, 1, 1000, 1000, 1000])
    assert all(float(likelihood.log_prob(bad)[0]) < float(log_prob[0]) - 20.0 for bad in (flipped, scaled))
