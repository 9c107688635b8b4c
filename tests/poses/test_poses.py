"""Poses, their exponential map, and the one base measure of all pose densities."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.distributions import MultivariateNormal

from bcppl import poses
from bcppl.distributions.poses import NormalPose, NormalTwist, SwingTwistPose, UniformPose, tilt_and_yaw
from bcppl.errors import InputError
from bcppl.poses import Freedom, quaternions

DRAWS = 400_000


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def random_poses(count: int, spread: float = 1.0) -> torch.Tensor:
    return poses.retract(poses.identity(count), spread * torch.randn(count, 6, dtype=torch.float64))


def haar_reference(center: torch.Tensor, half_width: float, freedom: Freedom) -> tuple[torch.Tensor, float]:
    """Draws from the base measure on a box around `center`, and log of the box's total measure."""
    shift = half_width * (2 * torch.rand(DRAWS, 3, dtype=torch.float64) - 1)
    shift[:, [a not in freedom.translation for a in "xyz"]] = 0.0
    if freedom.rotation == "all":
        quaternion = torch.randn(DRAWS, 4, dtype=torch.float64)
        quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
    else:
        turn = torch.zeros(DRAWS, 3, dtype=torch.float64)
        if freedom.rotation != "none":
            turn[:, "xyz".index(freedom.rotation)] = 2 * math.pi * torch.rand(DRAWS, dtype=torch.float64)
        quaternion = quaternions.from_rotation_vector(turn)
    draws = poses.compose(
        center, poses.from_translation_quaternion_xyzw(torch.zeros(3, dtype=torch.float64), quaternion)
    )
    draws[:, :3] = center[:3] + shift
    return draws, len(freedom.translation) * math.log(2 * half_width)


CENTER = poses.retract(poses.identity(), torch.tensor([0.1, -0.2, 0.3, 0.5, -1.0, 0.7], dtype=torch.float64))
PRIORS = {
    "uniform": (UniformPose(CENTER, [0.02, 0.03, 0.01], 1.2), 0.03),
    "uniform, whole SO(3)": (UniformPose(CENTER, 0.02, math.pi), 0.02),
    "swing-twist": (SwingTwistPose(CENTER, [0.02, 0.03, 0.01], 0.8, 1.5), 0.03),
    "on a table": (SwingTwistPose(CENTER, [0.02, 0.03, 0.0], 0.0, 0.9), 0.03),
    "normal": (NormalPose(CENTER, [0.02, 0.02, 0.02, 0.3, 0.45, 0.4]), 0.1),
    "normal, wide": (NormalPose(CENTER, [0.01, 0.01, 0.02, 1.2, 0.7, 1.0]), 0.1),
    "normal, about one axis": (NormalPose(CENTER, [0.01, 1.4], Freedom("x", "y")), 0.08),
    "normal, no rotation": (NormalPose(CENTER, [0.01, 0.02], Freedom("xz", "none")), 0.1),
}


def test_a_pose_of_a_rotation_vector_is_that_of_scipy() -> None:
    vector = torch.tensor([[3.0, -0.5, 0.1], [0.0, 0.0, 0.0], [0.0, -math.pi, 0.0]], dtype=torch.float64)
    place = torch.randn(3, 3, dtype=torch.float64)
    pose = poses.from_rotation_vector(place, vector)
    expected = torch.from_numpy(Rotation.from_rotvec(vector.numpy()).as_matrix())
    torch.testing.assert_close(poses.rotation_matrix(pose), expected)
    assert torch.equal(pose[:, :3], place)


@pytest.mark.parametrize("name", PRIORS)
def test_densities_normalise_against_the_base_measure(name: str) -> None:
    prior, half_width = PRIORS[name]
    draws, log_measure = haar_reference(CENTER, half_width, prior.freedom)
    weights = torch.exp(prior.log_prob(draws) + log_measure)
    error = weights.std() / math.sqrt(DRAWS)
    assert error < 0.08
    assert abs(weights.mean() - 1.0) <= 4 * error + 1e-9


@pytest.mark.parametrize("name", PRIORS)
def test_samples_follow_the_density(name: str) -> None:
    """E[1 / density] over samples is the measure of the support: a wrong Jacobian or sampler moves it."""
    prior, _ = PRIORS[name]
    samples = prior.sample(torch.Size([DRAWS]))
    density = prior.log_prob(samples)
    assert torch.isfinite(density).all()
    tangent = poses.local(CENTER, samples)
    assert float(prior.freedom.off_axis(tangent).max()) < 1e-9
    # A smaller neighbourhood, whose measure is known exactly, must get the mass that the density gives it.
    inner = UniformPose(CENTER, [0.006] * 3, 0.5)
    shift_inside = (tangent[:, :3].abs() <= 0.006 + 1e-12).all(dim=-1)
    inside = shift_inside & (tangent[:, 3:].norm(dim=-1) <= inner.angle)
    measure = (2 * 0.006) ** len(prior.freedom.translation) * {
        "all": (0.5 - math.sin(0.5)) / math.pi,
        "none": 1.0,
    }.get(prior.freedom.rotation, 0.5 / math.pi)
    estimate = (inside / density.exp()).double()
    error = estimate.std() / math.sqrt(DRAWS)
    assert abs(estimate.mean() - measure) <= 4 * error + 1e-9


@pytest.mark.parametrize("kind", ["about all axes", "about one axis", "over twists"])
def test_a_wide_normal_has_at_its_centre_the_density_beside_it(kind: str) -> None:
    wide = {
        "about all axes": NormalPose(CENTER, [0.01, 0.02, 0.01, 0.6, 0.7, 0.5]),
        "about one axis": NormalPose(CENTER, [[1e-4, 0.01], [0.01, 4.0]], Freedom("x", "z")),
        "over twists": NormalTwist(CENTER, [0.01, 0.02, 0.01, 0.6, 0.7, 0.5]),
    }[kind]
    turn = torch.zeros(6, dtype=torch.float64)
    turn[5] = 1e-6
    beside = wide.log_prob(poses.retract(CENTER, turn))
    assert float(wide.log_prob(CENTER)) == pytest.approx(float(beside), abs=1e-5)
    # As many turns more as count, exactly.
    if kind == "about one axis":
        angles = 2.0 * math.pi * torch.arange(-1, 2, dtype=torch.float64)
        terms = [
            MultivariateNormal(torch.zeros(2, dtype=torch.float64), wide.covariance).log_prob(
                torch.stack([torch.zeros_like(angle), angle])
            )
            for angle in angles
        ]
        exact = torch.logsumexp(torch.stack(terms), dim=0) + math.log(2.0 * math.pi)
        torch.testing.assert_close(wide.log_prob(CENTER), exact)


@pytest.mark.parametrize("angle", [1e-8, 1e-4, 0.0099, 0.0101])
def test_uniform_priors_within_a_tiny_angle_have_its_measure_and_draws(angle: float) -> None:
    ball, cone = UniformPose(CENTER, 0.02, angle), SwingTwistPose(CENTER, 0.02, angle, math.pi)
    box = 3.0 * math.log(0.04)
    exact = 3.0 * math.log(angle) - math.log(6.0 * math.pi) + math.log1p(-(angle**2) / 20.0)
    assert float(ball.log_prob(CENTER)) == pytest.approx(-box - exact, abs=1e-9)
    small = 2.0 * math.log(0.5 * angle) + math.log1p(-(angle**2) / 12.0)
    assert float(cone.log_prob(CENTER)) == pytest.approx(-box - small, abs=1e-9)
    turned = poses.local(CENTER, ball.sample(torch.Size([20_000])))[:, 3:].norm(dim=-1) / angle
    assert float((turned**3).mean()) == pytest.approx(0.5, abs=0.01)  # uniform, to rounding


def test_retract_and_local_are_inverse() -> None:
    pose, tangent = random_poses(100), 0.5 * torch.randn(100, 6, dtype=torch.float64)
    torch.testing.assert_close(poses.local(pose, poses.retract(pose, tangent)), tangent, atol=1e-12, rtol=0)


def test_composition_matches_matrices_and_points() -> None:
    a, b = random_poses(50), random_poses(50)
    points = torch.randn(20, 3, dtype=torch.float64)
    through = poses.transform(a, torch.zeros(1, 3, dtype=torch.float64))
    torch.testing.assert_close(through[:, 0], a[:, :3])
    composed = poses.transform(poses.compose(a, b), points)
    inner = poses.transform(b, points)
    outer = inner @ poses.rotation_matrix(a).transpose(-1, -2) + a[:, None, :3]
    torch.testing.assert_close(composed, outer)
    torch.testing.assert_close(
        poses.compose(a, poses.inverse(a))[:, :3], torch.zeros(50, 3, dtype=torch.float64)
    )


def test_antipodal_quaternions_are_one_pose() -> None:
    pose, other = random_poses(20), random_poses(20)
    flipped = torch.cat([other[:, :3], -other[:, 3:]], dim=-1)
    normal = NormalPose(pose, [0.5] * 3 + [1.0] * 3)
    torch.testing.assert_close(normal.log_prob(other), normal.log_prob(flipped))


def test_tilt_and_yaw_of_known_rotations() -> None:
    yaw = poses.retract(poses.identity(), torch.tensor([0, 0, 0, 0, 0, 0.3], dtype=torch.float64))
    tilted = poses.compose(
        poses.retract(poses.identity(), torch.tensor([0, 0, 0, 0.2, 0, 0], dtype=torch.float64)), yaw
    )
    tilt, twist = tilt_and_yaw(poses.identity(), tilted)
    np.testing.assert_allclose([float(tilt), float(twist)], [0.2, 0.3], atol=1e-12)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: Freedom("xz", "xy"), "refused"),
        (lambda: Freedom("", "none"), "free"),
        (lambda: SwingTwistPose(poses.identity(), 0.02, 0.1, 0.0), "yaw"),
        (lambda: UniformPose(poses.identity(), 0.02, 200.0), "angle = 200.0 rad"),
        (lambda: UniformPose(poses.identity(), -0.02, 0.1), "half width"),
        (lambda: UniformPose([0, 0, 0, 2, 0, 0, 0], 0.02, 0.1), "unit length"),
        (lambda: NormalPose(poses.identity(), [0.1, 0.0], Freedom("x", "z")), "positive definite"),
        (lambda: NormalPose(poses.identity(), [0.1, 0.1]), "free axes"),
        (lambda: poses.as_pose([float("nan")] * 7), "finite"),
    ],
)
def test_bad_input_is_one_sentence(make: Callable[[], object], word: str) -> None:
    with pytest.raises(InputError, match=word) as caught:
        make()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "shapes", [((), ()), ((5,), (5,)), ((), (5,)), ((1,), (5,)), ((5, 1), (3,)), ((0,), ())]
)
def test_with_and_without_a_gradient_the_algebra_is_the_same(shapes: tuple[tuple[int, ...], ...]) -> None:
    pose, other = (random_poses(max(1, math.prod(s))).reshape(-1, 7)[: math.prod(s)] for s in shapes)
    pose, other = pose.reshape(*shapes[0], 7), other.reshape(*shapes[1], 7)
    step = torch.randn(*shapes[1], 6, dtype=torch.float64)
    followed = pose.clone().requires_grad_()
    for with_it, without in (
        (poses.retract(followed, step), poses.retract(pose, step)),
        (poses.retract(followed, 0.0 * step), poses.retract(pose, 0.0 * step)),
        (poses.local(followed, other), poses.local(pose, other)),
        (poses.compose(followed, other), poses.compose(pose, other)),
        (poses.inverse(followed), poses.inverse(pose)),
        (poses.rotation_matrix(followed), poses.rotation_matrix(pose)),
    ):
        assert with_it.requires_grad and not without.requires_grad
        torch.testing.assert_close(with_it.detach(), without, rtol=1e-13, atol=1e-14)
