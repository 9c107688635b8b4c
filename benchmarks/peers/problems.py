"""Problems with exact answers, in plain numpy, as every peer's environment and bcppl's own can read them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

# Prior N(0, I), likelihood N(x; 0, covariance) at 0: six correlated axes with spreads from 0.05 to 0.3.
GAUSSIAN_AXES = 6
_spread = np.linspace(0.05, 0.3, GAUSSIAN_AXES)
_order = np.arange(GAUSSIAN_AXES)
GAUSSIAN_COVARIANCE = np.outer(_spread, _spread) * 0.5 ** np.abs(np.subtract.outer(_order, _order))
GAUSSIAN_PRECISION = np.linalg.inv(GAUSSIAN_COVARIANCE)
GAUSSIAN_PEAK = -0.5 * (GAUSSIAN_AXES * np.log(2 * np.pi) + np.linalg.slogdet(GAUSSIAN_COVARIANCE)[1])
GAUSSIAN_LOG_EVIDENCE = -0.5 * (
    GAUSSIAN_AXES * np.log(2 * np.pi) + np.linalg.slogdet(GAUSSIAN_COVARIANCE + np.eye(GAUSSIAN_AXES))[1]
)

# Two shells exp(-(|x - c| - r)^2 / 2w^2) / sqrt(2 pi w^2) with centres at +-SHELL_CENTRE on the first axis,
# uniform on [-SHELL_HALF, SHELL_HALF]^2: Feroz and Hobson, Multimodal nested sampling, MNRAS 384, 2008, 5.3.
SHELL_RADIUS, SHELL_WIDTH, SHELL_CENTRE, SHELL_HALF = 2.0, 0.1, 3.5, 6.0
SHELLS_LOG_EVIDENCE = -1.745642

# x_0 ~ N(0, 1), x_t = x_{t-1} + N(0, WALK^2), y_t = x_t + N(0, NOISE^2), the first y being y_1.
WALK, NOISE = 0.5, 0.3


def gaussian_log_likelihood(x: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Of values (N, 6)."""
    return GAUSSIAN_PEAK - 0.5 * ((x @ GAUSSIAN_PRECISION) * x).sum(1)


def shells_log_likelihood(x: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Of values (N, 2)."""
    off = [np.hypot(x[:, 0] - centre, x[:, 1]) - SHELL_RADIUS for centre in (-SHELL_CENTRE, SHELL_CENTRE)]
    nearest = np.logaddexp(*(-(each**2) / (2 * SHELL_WIDTH**2) for each in off))
    return nearest - 0.5 * np.log(2 * np.pi * SHELL_WIDTH**2)


def linear_gaussian(steps: int, seed: int = 0) -> tuple[np.ndarray[Any, Any], float]:
    """Observations (T,) of the linear-Gaussian series and their exact log evidence, by Kalman's filter."""
    generator = np.random.default_rng(seed)
    x = generator.normal()
    observed = np.empty(steps)
    for k in range(steps):
        x += WALK * generator.normal()
        observed[k] = x + NOISE * generator.normal()
    mean, variance, log_evidence = 0.0, 1.0, 0.0
    for y in observed:
        variance += WALK**2
        spread = variance + NOISE**2
        log_evidence -= 0.5 * (np.log(2 * np.pi * spread) + (y - mean) ** 2 / spread)
        gain = variance / spread
        mean, variance = mean + gain * (y - mean), (1 - gain) * variance
    return observed, float(log_evidence)


# x_0 ~ N(0, 1), x_t = rho x_{t-1} + N(0, 1), y_t = x_t + N(0, SERIES_NOISE^2), rho uniform on [-1, 1].
SERIES_RHO, SERIES_NOISE = 0.9, 0.7


def autoregression(steps: int, seed: int = 0) -> np.ndarray[Any, Any]:
    """Observations (T,) of the autoregression at SERIES_RHO, the first y being y_1."""
    generator = np.random.default_rng(seed)
    x = generator.normal()
    observed = np.empty(steps)
    for k in range(steps):
        x = SERIES_RHO * x + generator.normal()
        observed[k] = x + SERIES_NOISE * generator.normal()
    return observed


def autoregression_posterior(observed: np.ndarray[Any, Any]) -> tuple[float, float, float]:
    """Posterior mean and standard deviation of rho, and the log evidence: Kalman's filter on a grid."""
    rho = (np.arange(4000) + 0.5) / 2000.0 - 1.0
    mean, variance, log = np.zeros_like(rho), np.ones_like(rho), np.zeros_like(rho)
    for y in observed:
        mean, variance = rho * mean, rho**2 * variance + 1.0
        spread = variance + SERIES_NOISE**2
        log -= 0.5 * (np.log(2 * np.pi * spread) + (y - mean) ** 2 / spread)
        gain = variance / spread
        mean, variance = mean + gain * (y - mean), (1 - gain) * variance
    weights = np.exp(log - log.max())
    evidence = float(log.max() + np.log(weights.mean()))
    weights /= weights.sum()
    centre = float(weights @ rho)
    return centre, float(np.sqrt(weights @ (rho - centre) ** 2)), evidence


# Logistic regression: rows, standardised features that are correlated as 0.5^|i - j|, prior N(0, I).
ROWS, FEATURES, CORRELATION, EFFECT = 1000, 50, 0.5, 0.5


def logistic_regression(seed: int = 0) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Features (ROWS, FEATURES) and labels (ROWS,), 0 or 1, of true coefficients from N(0, EFFECT^2)."""
    generator = np.random.default_rng(seed)
    order = np.arange(FEATURES)
    factor = np.linalg.cholesky(CORRELATION ** np.abs(np.subtract.outer(order, order)))
    features = generator.normal(size=(ROWS, FEATURES)) @ factor.T
    features = (features - features.mean(axis=0)) / features.std(axis=0)
    chances = 1.0 / (1.0 + np.exp(-features @ generator.normal(scale=EFFECT, size=FEATURES)))
    return features, (generator.uniform(size=ROWS) < chances).astype(np.float64)


def emit(**fields: Any) -> None:
    """Print one result as a JSON line."""
    print(json.dumps(fields), flush=True)
