"""What a finger feels: distances in closed form, densities that integrate to one, signs, real pushes."""

import math

import numpy as np
import pytest
import torch
import trimesh
from scipy import stats
from torch import Tensor

from bcppl import poses
from bcppl.distributions.touch import ForceDirection, FreePath, OnsetLocation, Path
from bcppl.distributions.touch.direction import scale_of
from bcppl.errors import InputError
from bcppl.geometry.distance import SignedDistance
from bcppl.geometry.parts import Part
from tests.distributions.touches.exact_boxes import Boxes

BOX = Boxes((0.05, 0.1, 0.15))


def t(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def split_box() -> Part:
    """A box 0.1 x 0.2 x 0.3 m whose triangles share no vertex, as exporters that split by normals do."""
    corners = trimesh.creation.box((0.1, 0.2, 0.3)).triangles.reshape(-1, 3)
    return Part("box", np.array(corners), np.arange(len(corners)).reshape(-1, 3))


def shifted(*x: float) -> Tensor:
    """Poses turned by nothing, at x along the world's x axis."""
    pose = poses.identity(len(x))
    pose[:, 0] = t(*x)
    return pose


def straight(start: tuple[float, ...], end: tuple[float, ...], count: int = 101) -> Path:
    return Path(t(*start) + torch.linspace(0, 1, count, dtype=torch.float64)[:, None] * (t(*end) - t(*start)))


# ---------------------------------------------------------------- distance


def test_distance_to_a_box_is_exact() -> None:
    points = torch.from_numpy(np.random.default_rng(0).uniform(-0.3, 0.3, (4, 500, 3)))
    near, exact = SignedDistance(split_box())(points), BOX(points)
    for mine, theirs in zip(near, exact, strict=True):
        assert torch.allclose(mine, theirs, atol=1e-12)


def test_normals_are_the_gradient_and_point_outwards() -> None:
    sphere = trimesh.creation.icosphere(4, 0.05)
    distance = SignedDistance(Part("sphere", np.asarray(sphere.vertices), np.asarray(sphere.faces)))
    directions = torch.nn.functional.normalize(
        torch.from_numpy(np.random.default_rng(1).normal(size=(300, 3))), dim=-1
    )
    for radius in (0.03, 0.08):
        near = distance(radius * directions)
        # A chord of 5120 triangles lies up to 0.1 % of the radius under the sphere.
        assert float((near.distance - (radius - 0.05)).abs().max()) < 1e-4
        assert float((near.normal * directions).sum(-1).min()) > 0.99


def test_an_open_mesh_is_refused() -> None:
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    with pytest.raises(InputError, match="open"):
        SignedDistance(Part("lid off", np.asarray(box.vertices), np.asarray(box.faces)[:-1]))


# ---------------------------------------------------------------- onset


@pytest.mark.parametrize(
    ("start", "end"),
    [
        (
            (-0.06, 0.01, 0.02),
            (-0.04, 0.02, 0.02),
        ),  # into the face, obliquely, deep enough to be felt for sure
        ((-0.06, 0.0, 0.0), (-0.0504, 0.0, 0.0)),  # stops where it may not have been felt
        ((-0.0506, 0.0, 0.0), (-0.04, 0.0, 0.0)),  # starts where it may be felt at once
        ((-0.07, 0.09, 0.0), (-0.03, 0.115, 0.0)),  # grazes a corner and leaves again
    ],
)
def test_onset_masses_sum_to_one(start: tuple[float, ...], end: tuple[float, ...]) -> None:
    path, distance, steps = straight(start, end, 201), BOX, 1000
    inner = path.at((torch.arange(steps, dtype=torch.float64) + 0.5) / steps * path.length)
    atoms = torch.stack([path.points[0], t(math.nan, math.nan, math.nan)])
    for x, spread in ((0.0, 0.0005), (0.0003, 0.0004), (-0.002, 0.0006)):
        pose = shifted(*[x] * (steps + 2))
        onset = OnsetLocation(distance, pose, path, 0.0004, spread, 0.05)
        mass = onset.log_prob(torch.cat([inner, atoms])).exp()
        assert float(mass[:steps].mean() * path.length + mass[steps:].sum()) == pytest.approx(1.0, abs=4e-3)


@pytest.mark.long
def test_onset_masses_sum_to_one_where_the_finger_touches_twice() -> None:
    distance = Boxes((0.05, 0.1, 0.15), (0.0, 0.0, 0.0), (0.0, 0.22, 0.0))
    path, steps = straight((-0.0497, 0.08, 0.0), (-0.0497, 0.14, 0.0), 401), 4000
    path = Path(torch.cat([straight((-0.06, 0.08, 0.0), (-0.0497, 0.08, 0.0), 51).points, path.points]))
    inner = path.at((torch.arange(steps, dtype=torch.float64) + 0.5) / steps * path.length)
    value = torch.cat([inner, path.points[:1], torch.full((1, 3), math.nan, dtype=torch.float64)])
    onset = OnsetLocation(distance, shifted(*[0.0] * (steps + 2)), path, 0.0002, 0.0004, 0.05)
    mass = onset.log_prob(value).exp()
    assert float(mass[:steps].mean() * path.length + mass[steps:].sum()) == pytest.approx(1.0, abs=5e-3)


def test_onset_samples_follow_the_density() -> None:
    torch.manual_seed(0)
    path, count = straight((-0.06, 0.01, 0.02), (-0.0495, 0.012, 0.02)), 20000
    onset = OnsetLocation(BOX, shifted(*[0.0] * count), path, 0.0003, 0.0005, 0.1)
    sample = onset.sample()
    never = torch.isnan(sample).any(-1)
    one = OnsetLocation(onset.distance, shifted(0.0), path, 0.0003, 0.0005, 0.1)
    assert float(never.double().mean()) == pytest.approx(
        float(one.log_prob(t(*[math.nan] * 3)).exp()), abs=0.01
    )
    edges = torch.linspace(0, path.length, 21, dtype=torch.float64)
    travelled = path.locate(sample[~never]).travelled
    seen = torch.histogram(travelled, edges).hist / count
    fine = (torch.arange(2000, dtype=torch.float64) + 0.5) / 2000 * path.length
    same = OnsetLocation(onset.distance, shifted(*[0.0] * 2000), path, 0.0003, 0.0005, 0.1)
    density = same.log_prob(path.at(fine)).exp()
    expected = density.reshape(20, 100).sum(dim=1) * path.length / 2000
    assert float((seen - expected).abs().max()) < 0.012


def test_onset_prefers_a_tip_inside_and_an_approach_from_outside() -> None:
    distance, inside, outside = BOX, t(-0.0495, 0.0, 0.0), t(-0.0505, 0.0, 0.0)
    inward = straight((-0.06, 0.0, 0.0), (-0.04, 0.0, 0.0), 21)
    onset = OnsetLocation(distance, shifted(0.0), inward, 0.0005, 0.0002, 0.01)
    assert float(onset.log_prob(inside)) > float(onset.log_prob(outside)) + 5.0
    # On its way out the finger was inside before: only the outlier explains that it felt nothing there.
    outward = OnsetLocation(
        distance, shifted(0.0), straight((-0.04, 0.0, 0.0), (-0.06, 0.0, 0.0), 21), 0.0005, 0.0002, 0.01
    )
    assert float(outward.log_prob(inside)) == pytest.approx(math.log(0.01 / 0.02), abs=1e-9)
    assert float(onset.log_prob(t(-0.0495, 0.002, 0.0))) == -math.inf  # off the path


def test_never_is_likely_only_where_the_path_misses() -> None:
    path = straight((-0.06, 0.0, 0.0), (-0.04, 0.0, 0.0), 21)
    never = OnsetLocation(BOX, shifted(0.05, 0.0), path, 0.0, 0.0005, 0.01)
    miss, hit = never.log_prob(t(*[math.nan] * 3))
    assert float(miss) == pytest.approx(math.log(0.99), abs=1e-9)
    assert float(hit) < -50.0


def test_scales_may_differ_between_particles() -> None:
    distance, path, place = (
        BOX,
        straight((-0.06, 0.0, 0.0), (-0.04, 0.0, 0.0)),
        t(-0.0502, 0, 0),
    )
    pose, offset, spread = shifted(0.0, 0.0), t(0.0, 0.0005), t(0.0003, 0.0006)
    both = OnsetLocation(distance, pose, path, offset, spread, 0.01).log_prob(place)
    each = [
        OnsetLocation(distance, pose, path, *s, 0.01).log_prob(place)[0]
        for s in ((0.0, 0.0003), (0.0005, 0.0006))
    ]
    assert torch.equal(both, torch.stack(each))


# ---------------------------------------------------------------- direction


def direction(
    pose: Tensor, motion: Tensor, tip: Tensor | None = None, outlier: float = 0.02
) -> ForceDirection:
    tip = t(-0.0502, 0.0, 0.0) if tip is None else tip
    return ForceDirection(BOX, pose, tip, motion, 0.4, 0.1, outlier)


def test_direction_integrates_to_one_over_the_circle() -> None:
    angles = (torch.arange(720, dtype=torch.float64) + 0.5) / 720 * 2 * math.pi - math.pi
    for motion in (t(1.0, 0.2, 0.0), t(-1.0, 0.1, 0.0), t(0.0, 1.0, 0.0)):
        density = direction(shifted(*[0.0] * 720), motion).log_prob(angles).exp()
        assert float(density.mean() * 2 * math.pi) == pytest.approx(1.0, abs=1e-6)


def test_direction_is_inward_and_leans_with_the_motion() -> None:
    cone = math.atan(0.4)
    # Onto the face at -x, and along it.
    angles = torch.linspace(-math.pi, math.pi, 721, dtype=torch.float64)
    best = float(angles[direction(shifted(*[0.0] * 721), t(0.3, 1.0, 0.0)).log_prob(angles).argmax()])
    assert 0.9 * cone < best <= cone  # the force on the part points to +x (inward) and leans to +y
    straight_on = direction(shifted(0.0), t(1.0, 0.0, 0.0))
    assert float(straight_on.log_prob(t(0.0)[0])) > float(straight_on.log_prob(t(math.pi)[0])) + 3.0


@pytest.mark.parametrize("along", [1.0, -0.01])
def test_a_vertical_motion_leaves_the_force_along_the_normal_of_every_side(along: float) -> None:
    angles = torch.linspace(-math.pi, math.pi, 721, dtype=torch.float64)[:-1]
    sides = {0.0: t(-0.0502, 0, 0), 0.5 * math.pi: t(0, -0.1002, 0), -0.5 * math.pi: t(0, 0.1002, 0)}
    for inward, tip in sides.items():
        density = direction(shifted(*[0.0] * 720), t(0.0, 0.0, along), tip).log_prob(angles)
        assert float(angles[density.argmax()]) == pytest.approx(inward, abs=1e-9)


def test_direction_samples_follow_the_density() -> None:
    torch.manual_seed(1)
    many = direction(shifted(*[0.0] * 20000), t(1.0, 0.3, 0.0), outlier=0.2).sample()
    edges = torch.linspace(-math.pi, math.pi, 33, dtype=torch.float64)
    middle = torch.linspace(-math.pi, math.pi, 3201, dtype=torch.float64)[:-1] + math.pi / 3200
    density = direction(shifted(*[0.0] * 3200), t(1.0, 0.3, 0.0), outlier=0.2).log_prob(middle).exp()
    expected = density.reshape(32, 100).sum(dim=1) * 2 * math.pi / 3200
    assert float((torch.histogram(many, edges).hist / 20000 - expected).abs().max()) < 0.012


def test_errors_of_a_direction_have_the_tails_of_a_t() -> None:
    """Head on the expected angle is 0; 0.1 rad is one scale of the error."""
    errors = t(0.0, 0.1, 0.3, 0.7)
    density = direction(shifted(*[0.0] * 4), t(1.0, 0.0, 0.0), outlier=0.0).log_prob(errors).numpy()
    np.testing.assert_allclose(density, stats.t.logpdf(errors.numpy(), 3, scale=0.1), atol=2e-3)
    site = direction(shifted(0.0), t(1.0, 0.0, 0.0), outlier=0.0)
    for error in (0.1, 0.7):
        probability = site.predictive_check(t(error), lambda: site).probability
        assert probability == pytest.approx(2.0 * stats.t.sf(error / 0.1, 3), rel=1e-6)


def test_the_scale_of_directions_is_that_of_their_bulk() -> None:
    errors = torch.from_numpy(stats.t.rvs(3, size=1000, scale=0.05, random_state=0))
    assert scale_of(errors) == pytest.approx(0.05, rel=0.06)
    errors[0] = 2.0  # one outlier doubles their root mean square
    assert scale_of(errors) == pytest.approx(0.05, rel=0.06)


def test_no_force_has_no_direction() -> None:
    tips = torch.stack([t(math.nan, math.nan, math.nan), t(-0.0502, 0.0, 0.0)])
    none = direction(shifted(0.0, 0.0), t(1.0, 0.0, 0.0), tips)
    assert none.log_prob(t(math.nan)[0]).tolist() == [0.0, -math.inf]
    assert none.log_prob(t(0.0)[0])[0] == -math.inf
    assert torch.isnan(none.sample()).tolist() == [True, False]


# ---------------------------------------------------------------- free path


def test_free_path_counts_to_one_and_ends_at_the_onset() -> None:
    path = straight((-0.06, 0.0, 0.0), (-0.04, 0.0, 0.0), 41)
    pose = shifted(0.01, 0.0, -0.003)
    free = FreePath(BOX, pose, path, t(-0.05, 0.0, 0.0), 0.001, 0.0005)
    total = free.log_prob(t(1.0)[0]).exp() + free.log_prob(t(0.0)[0]).exp()
    assert torch.allclose(total, torch.ones(3, dtype=torch.float64))
    # The last point before the onset is at -50.5 mm: 9.5 mm outside, 0.5 mm outside, 2.5 mm inside.
    exact = torch.special.log_ndtr((t(0.0095, 0.0005, -0.0025) + 0.001) / 0.0005)
    assert torch.allclose(free.log_prob(t(1.0)[0]), exact, atol=1e-6)
    whole = FreePath(free.distance, pose, path, t(math.nan, math.nan, math.nan), 0.001, 0.0005)
    assert float(whole.log_prob(t(1.0)[0])[1]) < -100.0


def test_a_finger_that_comes_back_the_way_that_it_went_has_touched_on_the_way_out() -> None:
    out = straight((-0.06, 0.0, 0.0), (-0.03, 0.0, 0.0), 601).points
    scattered = 2e-6 * torch.randn(out.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    both = Path(torch.cat([out, (out + scattered).flip(0)])).thinned(0.0005)
    # Off the path by a few micrometres, as what is interpolated between stamps.
    places = torch.stack([t(x, 3e-6, 0.0) for x in (-0.0597, -0.0503, -0.0411, -0.0302)])
    one, other = Path(out).thinned(0.0005).locate(places), both.locate(places)
    torch.testing.assert_close(other.travelled, one.travelled, atol=1e-5, rtol=0.0)
    torch.testing.assert_close(other.direction, one.direction, atol=1e-2, rtol=0.0)
