"""Normal steps and mixtures: the density and the draws are those of multivariate normals."""

import pytest
import torch
from torch.distributions import Categorical, MixtureSameFamily, MultivariateNormal

from bcppl.distributions.vectors import NormalMixture, NormalStep

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


SHARES = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
FACTORS = torch.stack([FACTOR, 2.0 * FACTOR, torch.eye(3, dtype=torch.float64)])


@pytest.mark.parametrize("factors", [FACTOR, FACTORS], ids=["one factor", "a factor each"])
@pytest.mark.parametrize("own", [False, True], ids=["same centers", "centers for each particle"])
def test_density_and_draws_of_a_mixture(factors: torch.Tensor, own: bool) -> None:
    """The draws by their mean log-density and their moments, which a component of the wrong share changes."""
    torch.manual_seed(2)
    particles = 100_000
    centers = 4.0 * torch.randn(3, 3, dtype=torch.float64)
    logits = SHARES.log() + 5.0  # of any sum
    if own:
        centers, logits = centers.expand(particles, 3, 3), logits.expand(particles, 3)
    mine = NormalMixture(particles, logits, centers, factors)
    each = MultivariateNormal(centers.expand(particles, 3, 3), scale_tril=factors)
    expected = MixtureSameFamily(Categorical(logits=logits.expand(particles, 3)), each)
    value = mine.sample()
    torch.testing.assert_close(mine.log_prob(value), expected.log_prob(value))
    drawn = expected.sample()
    error = (value - drawn).std(0) / particles**0.5
    assert bool(((value - drawn).mean(0).abs() < 4.5 * error).all())
    covariance = torch.cov(value.T) - torch.cov(drawn.T)
    assert float(covariance.abs().max()) < 0.02 * float(torch.cov(drawn.T).abs().max())
    entropies = mine.log_prob(value) - mine.log_prob(drawn)
    assert abs(float(entropies.mean() / entropies.std())) < 4.5 / particles**0.5
