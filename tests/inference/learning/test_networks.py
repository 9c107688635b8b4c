"""Networks for poses: what they read, what they ignore, and that their mixtures are densities to train."""

from __future__ import annotations

import math
from functools import partial

import pyro
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import NormalPose, UniformPose
from bcppl.errors import InputError
from bcppl.inference import importance_sampling
from bcppl.inference.learning import Amortised, Checks, forward_kl, train
from bcppl.inference.learning.networks import DepthEncoder, PoseHead, SetEncoder
from bcppl.poses import Freedom
from bcppl.traces import assess, simulate

CENTER = poses.as_pose([0.1, -0.2, 0.3, 0.5, 0.5, -0.5, 0.5])
PLANAR = Freedom("xy", "z")


def encoder() -> DepthEncoder:
    torch.manual_seed(0)
    background = torch.full((12, 16), 0.8, dtype=torch.float64)
    background[0, 0] = torch.nan
    return DepthEncoder(background, 0.05, features=8, width=4)


def test_missing_pixels_count_alike_whatever_stands_there() -> None:
    read, images = encoder(), 0.8 + 0.05 * torch.randn(5, 12, 16, dtype=torch.float64)
    zero, nan = images.clone(), images.clone()
    zero[:, 3:6, 4:9], nan[:, 3:6, 4:9] = 0.0, torch.nan
    assert read(images).shape == (5, 8) and read(images).dtype == torch.float32
    torch.testing.assert_close(read(zero), read(nan))
    assert bool((read(images) != read(nan)).any())
    # Another measured pixel, or where a part lies, is seen; what is far in front is clipped.
    assert bool((read(images.roll(4, dims=2)) != read(images)).any())
    far, farther = images.clone(), images.clone()
    far[:, 2, 2], farther[:, 2, 2] = 0.4, 0.3
    torch.testing.assert_close(read(far), read(farther))


def test_a_set_has_no_order_and_may_miss_some() -> None:
    torch.manual_seed(0)
    read = SetEncoder(3, center=[0.1, 0.2, 0.3], spread=[0.01, 0.01, 0.02], features=6)
    vectors = torch.tensor([0.1, 0.2, 0.3]) + 0.01 * torch.randn(4, 5, 3, dtype=torch.float64)
    torch.testing.assert_close(read(vectors), read(vectors[:, torch.randperm(5)]))
    partly = vectors.clone()
    partly[:, 3:, 0] = torch.nan
    torch.testing.assert_close(read(partly), read(vectors[:, :3]))
    assert bool((read(vectors) != read(vectors[:, :3])).any())
    none = torch.full((2, 5, 3), torch.nan, dtype=torch.float64)
    assert bool(torch.isfinite(read(none)).all())
    loss = read(partly).sum()
    loss.backward()
    assert all(bool(torch.isfinite(p.grad).all()) for p in read.parameters() if p.grad is not None)
    empty, missing = torch.zeros(2, 0, 3), torch.full((2, 1, 3), math.nan)
    alone = SetEncoder(3)
    assert torch.equal(alone(empty), alone(missing))


@pytest.mark.parametrize("freedom", [Freedom(), PLANAR])
def test_the_mixture_is_normalised(freedom: Freedom) -> None:
    """Its integral, by importance sampling from a wide normal."""
    torch.manual_seed(0)
    deviations = [0.01] * len(freedom.translation) + [0.2] * (freedom.dimension - len(freedom.translation))
    head = PoseHead(5, CENTER, deviations, components=2, wide=0.1, freedom=freedom)
    mixture = head(torch.randn(1, 5))
    assert mixture.batch_shape == (1,) and mixture.log_weights.shape == (1, 3)
    assert float(mixture.log_weights[0, -1].detach().exp()) == pytest.approx(0.1)
    wide = NormalPose(CENTER, 3.0 * torch.tensor(deviations), freedom)
    drawn = wide.expand(torch.Size([100_000])).sample()
    with torch.no_grad():
        ratio = (mixture.expand(torch.Size([100_000])).log_prob(drawn) - wide.log_prob(drawn)).exp()
    assert float(ratio.mean()) == pytest.approx(1.0, abs=5 * float(ratio.std()) / math.sqrt(100_000))


def test_every_parameter_of_the_head_has_a_gradient_and_scales_are_bounded() -> None:
    torch.manual_seed(0)
    head = PoseHead(5, CENTER, [0.01] * 3 + [0.2] * 3)
    features = torch.randn(7, 5)
    drawn = NormalPose(CENTER, [0.01] * 3 + [0.2] * 3).expand(torch.Size([7])).sample()
    head(features).log_prob(drawn).sum().backward()
    assert head.last.weight.grad is not None and head.last.bias.grad is not None
    assert bool((head.last.bias.grad.abs() > 0.0).all() & torch.isfinite(head.last.weight.grad).all())
    for size in (-1e3, 1e3):
        with torch.no_grad():
            covariance = head(size * features).components.covariance
        assert bool(torch.isfinite(torch.linalg.cholesky(covariance)).all())


# ---- a pose from a set of points that have an exact posterior up to one integral

CORNERS = torch.tensor([[0.03, 0.0, 0.0], [-0.02, 0.02, 0.0], [0.0, -0.03, 0.0]], dtype=torch.float64)
PRIOR = UniformPose(CENTER, (0.02, 0.02, 0.0), 0.6, rotation="z")


def located() -> None:
    """Three corners of a part are measured; each is off by a millimetre and a half."""
    part = pyro.sample("part", PRIOR)
    pyro.sample("seen", pyro.distributions.Normal(poses.transform(part, CORNERS), 0.0015).to_event(2))


@pytest.mark.long
def test_a_network_that_reads_points_learns_the_pose() -> None:
    torch.manual_seed(0)
    points = poses.transform(CENTER, CORNERS)
    reads = torch.nn.Sequential(
        torch.nn.Flatten(), torch.nn.Linear(9, 64), torch.nn.ReLU(), torch.nn.Linear(64, 32), torch.nn.ReLU()
    )
    head = PoseHead(32, CENTER, [0.012, 0.012, 0.35], components=1, freedom=PRIOR.freedom)

    def guide(observed: dict[str, Tensor]) -> None:
        scaled = (observed["seen"] - points) / 0.02
        pyro.sample("part", head(reads(scaled.to(torch.float32))))

    proposal = Amortised(guide)
    seen = {"seen": simulate(located)["seen"][0]}

    def effective() -> float:
        torch.manual_seed(1)
        return importance_sampling(located, (), seen, 2000, proposal.given(seen)).effective_sample_size

    before = effective()
    objective = forward_kl(proposal, located, (), ["seen"], batch=64)
    record = train(
        torch.nn.ModuleList([reads, head]),
        objective,
        steps=300,
        optimiser=partial(torch.optim.Adam, lr=5e-3),
        checks=Checks(every=200, batches=2),
    )
    torch.manual_seed(1)
    prior = importance_sampling(located, (), seen, 2000).effective_sample_size
    after = effective()
    assert after > 8 * max(before, prior) and after > 200
    assert float(record.held_out.min()) < float(record.held_out[0]) - 2.0
    # Over many observations at once, and with one that all particles share, the density is the same.
    many = simulate(located, (), 24)
    both = assess(lambda: guide({"seen": many["seen"]}), (), {"part": many["part"]}, 24)
    each = [
        assess(proposal.given({"seen": many["seen"][k]}), (), {"part": many["part"][k : k + 1]}, 1)
        for k in range(24)
    ]
    torch.testing.assert_close(both, torch.cat(each), rtol=1e-4, atol=1e-4)


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(InputError, match="background of shape"):
        DepthEncoder(torch.tensor(0.5), 0.05)
    with pytest.raises(InputError, match="one above 0 for each of 3 free axes"):
        PoseHead(5, CENTER, [0.01] * 6, freedom=PLANAR)
    with pytest.raises(InputError, match="wide component of PoseHead"):
        PoseHead(5, CENTER, [0.01] * 3, wide=0.0, freedom=PLANAR)


@pytest.mark.parametrize("default", [torch.float32, torch.float64])
def test_networks_work_in_double_precision(default: torch.dtype) -> None:
    """Where torch's default type is float64, and converted to it."""
    torch.set_default_dtype(default)
    try:
        networks = torch.nn.ModuleList([encoder(), SetEncoder(3, features=8), PoseHead(8, CENTER, [0.1] * 6)])
    finally:
        torch.set_default_dtype(torch.float32)
    images, points = torch.full((2, 12, 16), 0.75, dtype=torch.float64), torch.zeros(2, 4, 3).double()
    for module in (networks, networks.double()):
        read, sets, head = module
        assert len(head(read(images)).sample()) == len(head(sets(points)).sample()) == 2
