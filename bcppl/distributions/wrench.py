"""Likelihood of the wrench itself: what was pushed and how hard, not only where."""

from __future__ import annotations

import math
from typing import Any, Protocol

import torch
from torch import Tensor

from bcppl.arguments import whole_number
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.stamps import checked_event, checked_stamps
from bcppl.errors import InputError

WIDER = 10.0  # the wide component's scale over the narrow one's


class WrenchTrack(Protocol):
    """A probe as N particles feel it: `bcppl.contact.probe_rollout.ProbeRollout`, or what answers alike."""

    @property
    def diverged(self) -> Tensor:
        """(N,) particles whose simulation failed, as far as it was run."""

    def __len__(self) -> int: ...

    def wrench(self, first: int, last: int) -> Tensor:
        """Force (N) and torque (N m) on the peg (N, T, 6), in its frame about its origin, of some stamps."""


class Wrench(LazyDistribution):
    """The wrench on the held peg at every `every`-th stamp of `first` to `last` of a probe: normalised.

    At each stamp the force's error and the torque's are independent, each a mixture of an isotropic Gaussian
    and, with weight `outlier`, of one ten times as wide, for the moments at which the simulated peg comes
    into contact or slips a little earlier or later than the real one. The scale of the narrow one grows with
    the simulated force F and torque M, for what is not known of friction and stiffness is a share of them:

        sqrt(force_scale^2 + (relative F)^2)   and   sqrt(torque_scale^2 + (relative M)^2).

    It is sharp, and as sure as the physics that it trusts. On the simulated probe, with the world's friction
    and stiffness, the truth explains the wrench better than any pose around it; with a friction of 0.3 where
    the world has 0.2, poses that are 1 mm and 2 degrees off explain it better by 30 nats (median of five
    seeds, `benchmarks/wrench.py`). Where these are not known, make them latent, or leave the wrench out.

    The density is with respect to Lebesgue measure on R^6 (N and N m) at each stamp looked at.

    The event is (last - first, 6): force and torque of the environment on the peg, in the peg's frame about
    its origin, tared and free of the tool's weight, as the simulated one is, and not filtered: a filter would
    make the errors of neighbours go together. A row that is not finite was not measured and says nothing.
    Particles whose physics diverged have log p = -inf.

    Args:
        track: the probe as the particles feel it.
        first: the first stamp.
        last: the stamp after the last.
        force_scale: newtons, along each axis.
        torque_scale: newton metres, about each axis.
        relative: share of the simulated force and torque that they may be wrong by.
        outlier: weight of the wide component.
        every: stamps whose number is a multiple of this are looked at, for errors of neighbours go together.
        bias: (N, 6) what the sensor reads without contact; None for zero. It may be latent, and differ from
            window to window where the sensor drifts.

    Raises:
        InputError: a setting is out of range, or a stamp or `every` no whole number.
    """

    cost = 2
    broadcasts = True

    def __init__(
        self,
        track: WrenchTrack,
        first: int,
        last: int,
        force_scale: float,
        torque_scale: float,
        relative: float = 0.15,
        outlier: float = 0.1,
        every: int = 10,
        bias: Tensor | None = None,
    ) -> None:
        first, last = checked_stamps("Wrench", first, last)
        every = whole_number("Wrench has every = {}", every)
        for name, value in (("force_scale", force_scale), ("torque_scale", torque_scale)):
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"Wrench has {name} = {value!r}; give a number greater than 0.")
        if not (math.isfinite(relative) and relative >= 0):
            raise InputError(f"Wrench has relative = {relative!r}; give a share of the force, 0 or more.")
        if not 0 < outlier < 1:
            raise InputError(f"Wrench has outlier = {outlier!r}; give a probability above 0 and below 1.")
        if bias is not None and tuple(bias.shape) != (len(track), 6):
            raise InputError(
                f"Wrench has a bias of shape {tuple(bias.shape)} for {len(track)} particles; give (N, 6)."
            )
        self.track, self.first, self.last, self.bias = track, first, last, bias
        self.force_scale, self.torque_scale = force_scale, torque_scale
        self.relative, self.outlier, self.every = relative, outlier, every
        super().__init__(len(track), (last - first, 6))

    @property
    def log_prob_bound(self) -> float:
        """Its value where nothing is felt, just as simulated: there it is narrowest."""
        stamps = len(range(self.first, self.last)[-self.first % self.every :: self.every])
        none, force, torque = torch.zeros(3, dtype=torch.float64), self.force_scale, self.torque_scale
        most = float(self._log_density(none, none.new_tensor(force)))
        most += float(self._log_density(none, none.new_tensor(torque)))
        # A row that is missing counts 0, which is more where the density's peak is below 1.
        return stamps * max(most, 0.0)

    def _simulated(self) -> tuple[Tensor, Tensor, Tensor]:
        """What is expected to be read (N, T, 6), and the narrow scales (N, T) of force and torque."""
        wrench = self.track.wrench(self.first, self.last).to(torch.float64)
        wrench = torch.where(self.track.diverged[:, None, None], 0.0, wrench)
        force = torch.hypot(self.relative * wrench[..., :3].norm(dim=-1), wrench.new_tensor(self.force_scale))
        torque = torch.hypot(
            self.relative * wrench[..., 3:].norm(dim=-1), wrench.new_tensor(self.torque_scale)
        )
        return wrench if self.bias is None else wrench + self.bias[:, None], force, torque

    def _log_density(self, error: Tensor, scale: Tensor) -> Tensor:
        """Of errors (..., 3), at scales (...)."""

        def gaussian(width: Tensor) -> Tensor:
            squared = (error / width[..., None]).square().sum(dim=-1)
            return -0.5 * squared - 3.0 * width.log() - 1.5 * math.log(2.0 * math.pi)

        narrow = gaussian(scale) + math.log1p(-self.outlier)
        return torch.logaddexp(narrow, gaussian(WIDER * scale) + math.log(self.outlier))

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (N,) of wrenches (T, 6), or (N, T, 6).

        Raises:
            InputError: there are not as many rows as stamps.
        """
        value = checked_event("Wrench", value, self.last - self.first, 6)
        chosen = slice(-self.first % self.every, None, self.every)
        expected, force, torque = (each[:, chosen] for each in self._simulated())
        value = value.to(torch.float64)[..., chosen, :]
        told = torch.isfinite(value).all(dim=-1)
        error = torch.where(told[..., None], value, 0.0) - expected
        terms = self._log_density(error[..., :3], force) + self._log_density(error[..., 3:], torque)
        log_prob = torch.where(told, terms, 0.0).sum(dim=-1)
        return torch.where(self.track.diverged, -math.inf, log_prob)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Wrenches (N, T, 6), NaN where the physics diverged; the errors of all stamps are independent."""
        expected, *scales = self._simulated()
        errors = []
        for scale in scales:
            wide = torch.rand(scale.shape, dtype=torch.float64) < self.outlier
            width = torch.where(wide, WIDER * scale, scale)
            errors.append(width[..., None] * torch.randn(*scale.shape, 3, dtype=torch.float64))
        drawn = expected + torch.cat(errors, dim=-1)
        return torch.where(self.track.diverged[:, None, None], torch.nan, drawn)
