"""Touches that share an error: the joint density in closed form, order, normalisation, what is left of it."""

import math

import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.touch import Path, Placed, SharedError, SharedOnset
from tests.distributions.touches.exact_boxes import Boxes

BOX = Boxes((0.05, 0.1, 0.15))
SHIFT, TURN, OFFSET, SPREAD = 0.0004, 0.005, 0.0002, 0.0003
NEVER = torch.full((3,), math.nan, dtype=torch.float64)


def t(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def towards(y: float) -> Path:
    """Straight at the face at x = -0.05 m, from 10 mm before it to 10 mm inside."""
    return Path(torch.stack([t(-0.06 + 0.0005 * k, y, 0.0) for k in range(41)]))


def log_probs(
    pose: Tensor,
    touches: list[tuple[Path, Tensor]],
    outlier: float = 0.0,
    varying: float = 0.0,
    wider: float = 1.0,
) -> list[Tensor]:
    """Of every touch given those before it, as a program asks for them: after it has run."""
    scatter = wider * SHIFT, wider * TURN, OFFSET, wider * SPREAD, outlier, varying
    shared = SharedError(Placed(BOX, pose), t(0.0, 0.0, 0.0), *scatter)
    sites = []
    for path, place in touches:
        shared.placed.expect(path.points)
        shared.add(path)
        sites.append(SharedOnset(shared))
        shared.condition_on(place)
    return [site.log_prob(place) for site, (_, place) in zip(sites, touches, strict=True)]


def at(*x: float) -> Tensor:
    pose = poses.identity(len(x))
    pose[:, 0] = t(*x)
    return pose


TOUCHES = [(towards(y), t(x, y, 0.0)) for y, x in ((-0.08, -0.0497), (0.05, -0.0502), (0.09, -0.0495))]


def test_touches_of_one_face_are_jointly_normal() -> None:
    # A shift moves the face as it is, a turn moves a place at y by -y to first order.
    slopes = t(*[p.points[0, 1].item() for p, _ in TOUCHES])
    covariance = SPREAD**2 * torch.eye(3) + SHIFT**2 + TURN**2 * torch.outer(slopes, slopes)
    pose = at(0.0, 0.0003, -0.0004)
    for k, x in enumerate(pose[:, 0]):
        inside = torch.stack([place[0] + 0.05 - x for _, place in TOUCHES])
        exact = torch.distributions.MultivariateNormal(torch.full((3,), OFFSET).double(), covariance.double())
        found = sum(float(one[k]) for one in log_probs(pose, TOUCHES))
        assert found == pytest.approx(float(exact.log_prob(inside)), abs=1e-6)


def test_the_order_of_touches_does_not_matter() -> None:
    pose = at(0.0, 0.0004)
    there, back = log_probs(pose, TOUCHES), log_probs(pose, TOUCHES[::-1])
    assert torch.allclose(sum(there), sum(back), atol=1e-9)
    # A touch that met nothing and ought not to tells nothing of the others.
    away = Path(towards(0.0).points + t(0.0, 0.0, 0.5))
    more = log_probs(pose, [TOUCHES[0], (away, NEVER), *TOUCHES[1:]])
    assert torch.allclose(sum(more), sum(there), atol=1e-9)


@pytest.mark.parametrize("varying", [0.0, 0.4])
def test_each_touch_integrates_to_one_given_the_others(varying: float) -> None:
    path, steps = towards(0.03), 800
    places = path.at((torch.arange(steps, dtype=torch.float64) + 0.5) / steps * path.length)
    every = torch.cat([places, NEVER[None], path.points[:1]])
    mass = log_probs(at(*[0.0002] * len(every)), [*TOUCHES[:2], (path, every)], 0.05, varying)[-1].exp()
    assert float(mass[:steps].mean() * path.length + mass[steps:].sum()) == pytest.approx(1.0, abs=5e-3)


def test_samples_err_together() -> None:
    torch.manual_seed(0)
    pose = at(0.0).expand(20000, 7)
    shared = SharedError(Placed(BOX, pose), t(0.0, 0.0, 0.0), SHIFT, 0.0, OFFSET, SPREAD)
    drawn = []
    for y in (-0.08, 0.05):
        shared.add(towards(y))
        drawn.append(SharedOnset(shared).sample())
        shared.condition_on(drawn[-1])
    inside = torch.stack(drawn)[..., 0] + 0.05
    covariance = torch.cov(inside)
    assert inside.mean(dim=1).tolist() == pytest.approx([OFFSET] * 2, abs=1.5e-5)
    assert covariance[0, 1].item() == pytest.approx(SHIFT**2, rel=0.05)
    assert covariance[1, 1].item() == pytest.approx(SHIFT**2 + SPREAD**2, rel=0.05)


def test_a_session_that_scatters_more_is_a_mixture_of_sessions() -> None:
    """The joint density is the average of three, each with all its errors wider by a factor."""
    pose, varying, stray = at(0.0, 0.0003, -0.0004), 0.4, 0.02
    found = sum(log_probs(pose, TOUCHES, stray, varying))
    each = []
    for node, share in ((-1.0, 1 / 6), (0.0, 2 / 3), (1.0, 1 / 6)):
        factor = math.exp(varying * math.sqrt(3.0) * node)
        each.append(math.log(share) + sum(log_probs(pose, TOUCHES, stray, wider=factor)))
    assert torch.allclose(found, torch.stack(each).logsumexp(dim=0), atol=1e-9)
    there, back = (sum(log_probs(pose, touches, 0.0, varying)) for touches in (TOUCHES, TOUCHES[::-1]))
    assert torch.allclose(there, back, atol=1e-9)


def test_a_touch_that_is_impossible_tells_nothing_of_the_scatter() -> None:
    astray = (towards(0.03), t(-0.05, 0.05, 0.0))  # 20 mm off its path
    after, alone = (log_probs(at(0.0), each, 0.0, 0.4)[-1] for each in ([astray, TOUCHES[0]], TOUCHES[:1]))
    assert torch.isfinite(after).all() and torch.allclose(after, alone, atol=0.5)


@pytest.mark.long
def test_two_touches_that_scatter_widen_the_third() -> None:
    torch.manual_seed(0)
    pose, spreads = at(0.0).expand(20000, 7), []
    for x in (-0.0498, -0.0490):
        shared = SharedError(Placed(BOX, pose), t(0.0, 0.0, 0.0), 0.0, 0.0, OFFSET, SPREAD, varying=0.4)
        for y, off in ((-0.08, x), (0.05, -0.0996 - x)):
            shared.add(towards(y))
            shared.condition_on(t(off, y, 0.0))
        shared.add(towards(0.0))
        spreads.append(float(SharedOnset(shared).sample()[:, 0].std()))
    assert spreads[0] < 0.95 * SPREAD and spreads[1] > 1.5 * SPREAD, spreads
