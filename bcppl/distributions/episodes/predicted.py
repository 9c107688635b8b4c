"""Windows of a probe that is not yet carried out, under errors that all touches share."""

from __future__ import annotations

import torch
from torch import Tensor

from bcppl.distributions.episodes.displaced import by_shared_errors, mismeasured
from bcppl.distributions.episodes.linear_errors import LinearErrors
from bcppl.distributions.episodes.rows import FELT
from bcppl.distributions.manifold import ContactManifold, Quadratic


class PredictedEpisodes(ContactManifold):
    """What `ContactEpisodes` says of windows (N, T, 8) that `motion` predicts."""

    bench: LinearErrors
    compliance: float

    def joint_log_prob(self, value: Tensor, errors: Tensor) -> Tensor:
        """Log-likelihood (N,) of a predicted window (N, T, 8) at shared errors (N, M)."""
        distance, felt, lost, _ = self._moved(value, errors)
        log_prob = self._of_contacts(distance, felt == 1.0) + self._of_free(distance, felt == 0.0)
        return torch.where(lost, torch.nan, log_prob)

    def joint_quadratic(self, value: Tensor, errors: Tensor) -> Quadratic:
        """The log-likelihood of a predicted window (N, T, 8) to second order about pose and shared errors.

        At errors (N, M) in their standard deviations, on which gaps depend linearly. The gradient is
        (N, 6 + M) and the information (N, 6 + M, 6 + M), in the tangent space of the pose and in standard
        deviations of the errors. The peg is pressed on with the force that `sink` stands for, the median
        compliance of its contacts times it. Errors that last and the contacts' own compliance, which the
        likelihood of a measured window has besides, are left out: a second of contact counts for up to 1.7
        times as much as it will.
        """
        distance, felt, lost, slope = self._moved(value, errors)
        pull, information = self._second_order(distance, felt, slope)
        return Quadratic(
            torch.where(lost[:, None], torch.nan, pull),
            torch.where(lost[:, None, None], torch.nan, information),
        )

    def with_shared_errors(self, value: Tensor, errors: Tensor) -> Tensor:
        """A window (N, T, 8) that was predicted without shared errors as it is measured under some (N, M)."""
        _, felt, lost, gaps = self._measured(value[..., : FELT + 1])
        if gaps is None:
            return value
        kept, stood, pressed = self._pressed(value, felt, lost)
        measured = value.clone()
        measured[:, kept, :7] = mismeasured(gaps, self.pose, stood, pressed, self.bench, errors)
        return torch.where(lost[:, None, None], torch.nan, measured)

    def _moved(self, value: Tensor, errors: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Distances and contact signals (N, S) of a predicted window at shared errors, and which are lost.

        Then the distances' derivatives (N, S, 6 + M) by pose and errors.
        """
        distance, felt, lost, gaps = self._measured(value[..., : FELT + 1])
        if gaps is None:
            return distance, felt, lost, distance.new_zeros(*distance.shape, 6 + errors.shape[-1])
        _, stood, pressed = self._pressed(value, felt, lost)
        shared = by_shared_errors(gaps, self.pose, stood, pressed, self.bench)
        slope = torch.cat([gaps.gradient(self.pose), shared], dim=-1)
        return distance + (shared @ errors[..., None])[..., 0], felt, lost, slope

    def _pressed(self, value: Tensor, felt: Tensor, lost: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Which stamps (T,) of a predicted window are decided; there pegs (N, S, 7) and forces (N, S)."""
        kept = ~torch.isnan(value[..., FELT]).all(dim=0)
        stood = torch.where(lost[:, None, None], self.pose[:, None], value[:, kept, :7])
        return kept, stood, torch.where(felt == 1.0, self.sink / self.compliance, 0.0)
