"""Normal steps: the density and the draws are those of a multivariate normal."""

import pytest
import torch
from torch.distributions import MultivariateNormal

from bcppl.distributions.vectors import NormalStep

FACTOR = torch.tensor([[0.5, 0.0, 0.0], [0.3, 1.0, 0.0], [-0.2, 0.4, 2.0]], dtype=torch.float64)


@pytest.mark.parametrize("shape", [(3,), (3, 1), (1, 3)])
def test_density_is_that_of_a_multivariate_normal(shape: tuple[int, ...]) -> None:
    torch.manual_seed(0)
    at, value = torch.randn(2, 50, *shape, dtype=torch.float64)
    size = torch.rand(50, dtype=torch.float64) + 0.1
    expected = MultivariateNormal(at.reshape(50, 3), scale_tril=size[:, None, None] * FACTOR)
    mine = NormalStep(at, FACTOR, size).log_prob(value)
    torch.testing.assert_close(mine, expected.log_prob(value.reshape(50, 3)))


def test_draws_have_the_covariance_of_the_density() -> None:
    """White noise after undoing the step: a transposed factor would leave it correlated."""
    torch.manual_seed(1)
    at = torch.randn(40_000, 3, dtype=torch.float64)
    size = torch.rand(40_000, dtype=torch.float64) + 0.1

    def whitened(factor: torch.Tensor) -> float:
        drawn = (NormalStep(at, factor, size).sample() - at) / size[:, None]
        white = torch.linalg.solve_triangular(FACTOR, drawn.mT, upper=False)
        return float((torch.cov(white) - torch.eye(3)).abs().max())

    assert whitened(FACTOR) < 0.03
    assert whitened(FACTOR.mT) > 0.3
