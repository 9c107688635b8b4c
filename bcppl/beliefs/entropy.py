"""Entropies of a belief, in nats: of its weights, and of its density against the base measure of poses.

The base measure is Lebesgue on the free translations times the normalised Haar measure on the free rotations
(`bcppl.poses.Freedom`). A density p over the tangent coordinates at the mean is p / J against it, J being the
base measure's density there, so an entropy against it is that of the coordinates plus the mean of log J.
Copies are merged first, so doubling every particle changes nothing.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.special import digamma
from torch import Tensor

from bcppl import poses
from bcppl.arguments import whole_number
from bcppl.poses import Freedom

if TYPE_CHECKING:
    from bcppl.beliefs.belief import Belief


def weight_entropy(weights: Tensor) -> float:
    """-sum w log w of normalised weights (K,): log K where they are equal."""
    return float(torch.special.entr(weights).sum())


def gaussian_entropy(belief: Belief) -> float:
    """1/2 log det(2 pi e covariance), plus the mean of log J; -inf where particles do not span the axes."""
    tangent, weights, freedom = _merged(belief)
    factor = _cholesky(freedom.coordinates(tangent), weights)
    if factor is None:
        return -math.inf
    determinant = float(factor.diagonal().log().sum())
    gaussian = 0.5 * freedom.dimension * math.log(2.0 * math.pi * math.e) + determinant
    return gaussian + _mean_log_base_density(tangent, weights, freedom)


def nearest_neighbour_entropy(belief: Belief, neighbours: int) -> float:
    """The k-nearest-neighbour estimate of the entropy of a belief of any shape.

    Kozachenko and Leonenko, Sample estimate of the entropy of a random vector, Problems of Information
    Transmission 23, 1987, for k neighbours as in Kraskov, Stögbauer and Grassberger, Physical Review E 69,
    2004, eq. 20. Distances are Mahalanobis distances in the tangent space at the mean. They estimate the
    density q of the particles; that of the belief is q times K times the local weight, the mean weight of the
    k neighbours (the particle's own would be counted twice).

    It is biased upwards where the density varies within that distance: with few particles and many axes by
    tenths of a nat and more. -inf where the particles do not span the axes.

    Raises:
        InputError: k is no whole number, 1 or more.
    """
    neighbours = whole_number("nearest_neighbour_entropy is given {} neighbours", neighbours)
    tangent, weights, freedom = _merged(belief)
    coordinates = freedom.coordinates(tangent)
    count = len(coordinates)
    factor = _cholesky(coordinates, weights)
    if count <= neighbours or factor is None:
        return -math.inf
    near, volume = neighbourhoods(coordinates, factor, neighbours)
    local = weights[near[:, 1:]].mean(dim=1)
    particles_density = float(digamma(neighbours) - digamma(count)) - volume
    white_entropy = -float(weights @ (particles_density + (count * local).log()))
    volume_ratio = float(factor.diagonal().log().sum())
    return white_entropy + volume_ratio + _mean_log_base_density(tangent, weights, freedom)


def neighbourhoods(coordinates: Tensor, factor: Tensor, neighbours: int) -> tuple[Tensor, Tensor]:
    """Each of K points with k neighbours (K, k + 1), and the log-volume (K,) up to the last, whitened."""
    white = torch.linalg.solve_triangular(factor, coordinates.T, upper=False).T.numpy()
    found = cKDTree(white).query(white, k=neighbours + 1)
    radius, near = (torch.from_numpy(np.asarray(each)) for each in found)
    dimension = len(factor)
    ball = 0.5 * dimension * math.log(math.pi) - math.lgamma(0.5 * dimension + 1.0)
    return near, ball + dimension * radius[:, -1].log()


def _merged(belief: Belief) -> tuple[Tensor, Tensor, Freedom]:
    """Tangents (K, 6) at the mean and weights (K,) of the distinct particles, and the free axes."""
    return poses.local(belief.mean, belief.merged.world_from_part), belief.merged.weights, belief.freedom


def _cholesky(coordinates: Tensor, weights: Tensor) -> Tensor | None:
    """The lower factor of the weighted covariance of coordinates (K, d); None where it is singular."""
    centred = coordinates - weights @ coordinates
    return cholesky((weights[:, None] * centred).T @ centred)


def cholesky(covariance: Tensor) -> Tensor | None:
    """The lower factor of a covariance (d, d) of particles; None where it is singular."""
    scale = covariance.diagonal().clamp_min(0.0).sqrt()
    # A picometre is rounding.
    if not bool((scale > 1e-12).all()):
        return None
    correlation = covariance / torch.outer(scale, scale)
    spans = float(torch.linalg.eigvalsh(correlation)[0]) > 1e-10
    return scale[:, None] * torch.linalg.cholesky(correlation) if spans else None


def _mean_log_base_density(tangent: Tensor, weights: Tensor, freedom: Freedom) -> float:
    return float(weights @ freedom.log_base_density(tangent[:, 3:].norm(dim=-1)))
