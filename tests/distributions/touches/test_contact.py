"""Contact likelihoods: exact small cases, invariances, and that the normalised one is normalised."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.contact import ChamferContacts, ContactsInTime, PegPose, chamfer
from bcppl.errors import InputError

NAN = math.nan
MILLIMETRE = 0.001


class Felt:
    """A track that is known already."""

    def __init__(self, contacts: Tensor, pose: Tensor | None = None, diverged: Tensor | None = None) -> None:
        self.contacts = contacts
        self.pose = poses.identity(*contacts.shape[:2]) if pose is None else pose
        self.diverged = torch.zeros(len(contacts), dtype=torch.bool) if diverged is None else diverged
        self.inputs = (contacts,)
        self.asked: list[tuple[int, int]] = []

    def __len__(self) -> int:
        return len(self.contacts)

    def window(self, first: int, last: int) -> tuple[Tensor, Tensor]:
        self.asked.append((first, last))
        return self.contacts[:, first:last], self.pose[:, first:last]


def points(*rows: tuple[float, float, float]) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64) * MILLIMETRE


def test_chamfer_of_small_sets_is_exact() -> None:
    one, two = points((0, 0, 0)), points((0, 0, 0), (3, 0, 0))
    # {0} and {0, 3}: 0 from the one, (0 + 9) / 2 from the two.
    assert float(chamfer(one, two, 1.0)) == pytest.approx(4.5e-6, rel=1e-12)
    assert float(chamfer(one, points((0, 2, 0)), 1.0)) == pytest.approx(2 * 4e-6, rel=1e-12)
    other = points((1, 0, 0), (0, 2, 0))
    # From {0, 3}: 1 and 4; from the other, (1, 0) is nearest to 0 at 1 and (0, 2) to 0 at 4.
    assert float(chamfer(two, other, 1.0)) == pytest.approx(
        (1 + 4) / 2 * 1e-6 + (1 + 4) / 2 * 1e-6, rel=1e-12
    )


def test_chamfer_is_symmetric_and_blind_to_order_copies_and_missing_rows() -> None:
    generator = torch.Generator().manual_seed(0)
    a = torch.randn(4, 30, 3, generator=generator, dtype=torch.float64)
    b = torch.randn(4, 40, 3, generator=generator, dtype=torch.float64)
    expected = chamfer(a, b, 1.0)
    torch.testing.assert_close(chamfer(b, a, 1.0), expected)
    torch.testing.assert_close(chamfer(a[:, torch.randperm(30)], b, 1.0), expected)
    holes = torch.cat([a[:, :10], torch.full((4, 7, 3), NAN, dtype=torch.float64), a[:, 10:]], dim=1)
    torch.testing.assert_close(chamfer(holes, b, 1.0), expected)
    torch.testing.assert_close(chamfer(a.repeat(1, 2, 1), b, 1.0), expected)
    torch.testing.assert_close(chamfer(a[0], b[0], 1.0), expected[0])
    assert float(chamfer(a[0], a[0], 1.0)) == 0.0


def test_empty_sets_have_their_stated_cost() -> None:
    nothing, something = torch.full((2, 3), NAN, dtype=torch.float64), points((1, 2, 3), (NAN, NAN, NAN))
    assert float(chamfer(nothing, nothing, 7e-6)) == 0.0
    assert float(chamfer(nothing, something, 7e-6)) == 7e-6
    assert float(chamfer(something, nothing, 7e-6)) == 7e-6
    assert float(chamfer(nothing[:0], something, 7e-6)) == 7e-6


def test_the_surrogate_s_value_laziness_and_refusals() -> None:
    contacts = torch.stack(
        [points((0, 0, 0), (0, 0, 0)), points((2, 0, 0), (NAN, 0, 0)), points((0, 0, 0), (0, 0, 0))]
    )
    track = Felt(contacts, diverged=torch.tensor([False, False, True]))
    contact = ChamferContacts(track, 0, 2, scale=MILLIMETRE, one_empty=18e-6)
    assert track.asked == [] and contact.expand(torch.Size([3])) is contact
    assert contact.log_prob(points((1, 0, 0), (NAN, NAN, NAN))).tolist() == pytest.approx(
        [-1.0, -1.0, -math.inf]
    )
    nothing = torch.full((2, 3), NAN, dtype=torch.float64)
    assert contact.log_prob(nothing).tolist() == pytest.approx([-9.0, -9.0, -math.inf])
    each = torch.stack([points((0, 0, 0), (0, 0, 0))] * 3)
    assert contact.log_prob(each).tolist() == pytest.approx([0.0, -4.0, -math.inf])
    assert contact.event_shape == (2, 3)
    with pytest.raises(InputError, match="first"):
        ChamferContacts(track, 2, 2, scale=1.0, one_empty=1.0)


def test_the_surrogate_s_noise_model() -> None:
    torch.manual_seed(0)
    contacts = torch.zeros(200, 100, 3, dtype=torch.float64)
    contacts[:, ::2] = NAN
    drawn = ChamferContacts(Felt(contacts), 0, 100, 0.001, 1e-5, missed=0.1).sample()
    assert torch.isnan(drawn[:, ::2]).all()
    felt = torch.isfinite(drawn[:, 1::2]).all(dim=-1)
    assert float(felt.double().mean()) == pytest.approx(0.9, abs=0.015)
    assert float(drawn[:, 1::2][felt].std()) == pytest.approx(0.0005, rel=0.03)


def test_the_pose_likelihood_is_normalised() -> None:
    torch.manual_seed(1)
    count, scale = 200_000, 0.004
    turned = torch.tensor([0.1, 0.2, 0.3, 1.0, -0.5, 0.3], dtype=torch.float64)
    pose = poses.retract(poses.identity(), turned)
    # Importance sampling: two Gaussians on the translation, Haar measure on the rotation.
    width = torch.where(torch.rand(count, 1, dtype=torch.float64) < 0.5, scale, 10 * scale)
    step = width * torch.randn(count, 3, dtype=torch.float64)
    quaternion = torch.nn.functional.normalize(torch.randn(count, 4, dtype=torch.float64), dim=-1)
    drawn = torch.cat([pose[:3] + step, quaternion], dim=-1)
    gaussian = torch.distributions.Normal(0.0, torch.tensor([scale, 10 * scale], dtype=torch.float64))
    proposal = gaussian.log_prob(step[..., None]).sum(dim=1).logsumexp(dim=-1) - math.log(2.0)
    track = Felt(torch.zeros(count, 1, 3), pose.expand(count, 1, 7))
    weights = torch.exp(PegPose(track, 0, 1, scale, 0.5, 1).log_prob(drawn[:, None]) - proposal)
    assert float(weights.mean()) == pytest.approx(1.0, abs=4 * float(weights.std()) / math.sqrt(count))
    assert float(weights.std()) / math.sqrt(count) < 0.02


def test_the_pose_likelihood_s_samples_have_its_scales() -> None:
    torch.manual_seed(2)
    pose = poses.identity(500, 40)
    drawn = PegPose(Felt(torch.zeros(500, 40, 3), pose), 0, 40, 0.001, 0.01, 1).sample()
    error = poses.local(pose, drawn).reshape(-1, 6).abs()
    # Of a mixture with 5 % ten times as wide, the median of |error| is 0.7 of the scale.
    assert error.quantile(0.5, dim=0)[:3].tolist() == pytest.approx([0.00072] * 3, rel=0.05)
    assert error.quantile(0.5, dim=0)[3:].tolist() == pytest.approx([0.0072] * 3, rel=0.05)
    assert float((error[:, :3].amax(dim=1) > 0.0045).double().mean()) == pytest.approx(
        0.05 * 0.957, abs=0.006
    )


class Pressed(Felt):
    """The peg is pushed along y of the world in the first half of the particles, and touches nothing else."""

    def contact_normals(self, first: int, last: int) -> torch.Tensor:
        direction = torch.full((len(self), last - first, 3), math.nan, dtype=torch.float64)
        direction[: len(self) // 2] = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        return direction


def test_along_the_contact_s_force_the_pose_counts_by_a_scale_of_its_own() -> None:
    """In contact along the force, without one in all directions; what is drawn has the density's spread."""
    torch.manual_seed(4)
    pose, scales = poses.identity(800, 40), {"translation_scale": 0.004, "normal_scale": 0.001}
    site = PegPose(Pressed(torch.zeros(800, 40, 3), pose), 0, 40, rotation_scale=0.01, every=1, **scales)
    error = poses.local(pose, site.sample())[..., :3].abs()
    middle = [half.reshape(-1, 3).quantile(0.5, dim=0).tolist() for half in (error[:400], error[400:])]
    assert middle[0] == pytest.approx([0.0029, 0.00072, 0.0029], rel=0.06)
    assert middle[1] == pytest.approx([0.00072] * 3, rel=0.06)
    one = PegPose(Pressed(torch.zeros(2, 1, 3), pose[:2, :1]), 0, 1, rotation_scale=0.01, every=1, **scales)
    off = [poses.retract(poses.identity(1), torch.eye(6).double()[[axis]] * 0.003) for axis in range(3)]
    lost = [(one.log_prob(poses.identity(1)) - one.log_prob(each)).tolist() for each in off]
    # Half the square of three deviations along the force, and of three quarters of one across it.
    assert [round(pressed, 1) for pressed, _ in lost] == [0.3, 4.5, 0.3]
    assert all(free == pytest.approx(lost[1][0], rel=0.02) for _, free in lost)
    assert float(one.log_prob(poses.identity(1)).max()) == pytest.approx(one.log_prob_bound, abs=1e-9)
    # Normalised over a translation: a grid about the pose.
    line = torch.linspace(-0.06, 0.06, 61, dtype=torch.float64)
    grid = torch.cartesian_prod(line, 0.25 * line, line)
    places = torch.cat([grid, poses.identity(1)[:, 3:].expand(len(grid), 4)], dim=1)
    many = PegPose(
        Pressed(torch.zeros(2 * len(grid), 1, 3), poses.identity(2 * len(grid), 1)),
        0,
        1,
        rotation_scale=0.01,
        every=1,
        **scales,
    )
    density = many.log_prob(places.repeat(2, 1)[:, None])[: len(grid)]
    rotation = one._log_rotation(torch.zeros(1, dtype=torch.float64))
    cell = float(0.25 * (line[1] - line[0]) ** 3)
    assert float((density - rotation).exp().sum()) * cell == pytest.approx(1.0, abs=0.12)


def test_the_pose_likelihood_looks_at_every_nth_stamp_of_the_probe() -> None:
    pose = poses.identity(2, 30)
    pose[1, :, 0] = 0.001
    track = Felt(torch.zeros(2, 30, 3), pose, torch.tensor([False, False]))
    value = poses.identity(10)
    value[:, 1] = 1e3
    value[[2, 7], 1] = 0.0  # stamps 10 and 15, of a window that starts at 8
    log_prob = PegPose(track, 8, 18, 0.001, 0.01, every=5).log_prob(value)
    centre = math.log(0.95 + 0.05 * 1e-3) - 1.5 * math.log(2 * math.pi)
    rotation = centre - 3 * math.log(0.01) + math.log(8 * math.pi**2)
    assert float(log_prob[0]) == pytest.approx(2 * (centre - 3 * math.log(0.001) + rotation), rel=1e-9)
    assert float(log_prob[0] - log_prob[1]) == pytest.approx(
        2
        * (centre + 1.5 * math.log(2 * math.pi) - math.log(0.95 * math.exp(-0.5) + 5e-5 * math.exp(-0.005))),
        rel=1e-9,
    )
    lost = Felt(torch.zeros(2, 30, 3), torch.full((2, 30, 7), NAN).double(), torch.tensor([True, True]))
    assert PegPose(lost, 8, 18, 0.001, 0.01, 5).log_prob(value).tolist() == [-math.inf, -math.inf]


def test_the_normalised_contact_likelihood_is_normalised() -> None:
    torch.manual_seed(3)
    settings: dict[str, Any] = {
        "scale": 0.002,
        "missed": 0.1,
        "false_alarm": 0.2,
        "outlier": 0.3,
        "reach": 0.03,
        "every": 1,
    }
    place = points((10, -5, 3))
    for contact in (place, torch.full((1, 3), NAN, dtype=torch.float64)):
        one = ContactsInTime(Felt(contact[None]), 0, 1, **settings)
        none = float(one.log_prob(torch.full((1, 3), NAN, dtype=torch.float64)).exp())
        count = 200_000
        width = torch.tensor([0.002, 0.03], dtype=torch.float64)
        pick = torch.rand(count, 1, dtype=torch.float64) < 0.5
        drawn = torch.where(
            pick, place + width[0] * torch.randn(count, 3), width[1] * torch.randn(count, 3)
        ).double()
        gaussian = torch.distributions.Normal(torch.stack([place[0], 0 * place[0]]), width[:, None])
        proposal = gaussian.log_prob(drawn[:, None]).sum(dim=-1).logsumexp(dim=-1) - math.log(2.0)
        many = ContactsInTime(Felt(contact.expand(count, 1, 3)), 0, 1, **settings)
        weight = torch.exp(many.log_prob(drawn[:, None]) - proposal)
        assert none + float(weight.mean()) == pytest.approx(1.0, abs=0.01)
        assert none == pytest.approx(0.1 if contact is place else 0.8)


def test_the_normalised_contact_likelihood_samples_from_its_density() -> None:
    torch.manual_seed(4)
    contacts = torch.zeros(300, 100, 3, dtype=torch.float64)
    contacts[:, ::2] = NAN
    settings: dict[str, Any] = {
        "scale": 0.001,
        "missed": 0.1,
        "false_alarm": 0.2,
        "outlier": 0.3,
        "reach": 0.05,
        "every": 1,
    }
    drawn = ContactsInTime(Felt(contacts), 0, 100, **settings).sample()
    felt = torch.isfinite(drawn).all(dim=-1)
    assert float(felt[:, ::2].double().mean()) == pytest.approx(0.2, abs=0.012)
    assert float(felt[:, 1::2].double().mean()) == pytest.approx(0.9, abs=0.009)
    far = drawn[:, 1::2][felt[:, 1::2]].norm(dim=-1) > 0.005
    assert float(far.double().mean()) == pytest.approx(0.3, abs=0.015)
    assert float(drawn[:, ::2][felt[:, ::2]].std()) == pytest.approx(0.05, rel=0.03)


class Pulled(Felt):
    """The peg is pushed with 2 N in the first half of the stamps, with 20 N in the others."""

    def wrench(self, first: int, last: int) -> torch.Tensor:
        wrench = torch.zeros(len(self), last - first, 6, dtype=torch.float64)
        wrench[:, : (last - first) // 2, 2], wrench[:, (last - first) // 2 :, 2] = 2.0, 20.0
        return wrench


def test_a_location_is_as_unsure_as_the_torque_s_noise_over_the_force() -> None:
    torch.manual_seed(6)
    contacts, never = torch.zeros(300, 100, 3, dtype=torch.float64), 1e-9
    rare = {"missed": never, "false_alarm": never, "outlier": never, "every": 1}
    site = ContactsInTime(Pulled(contacts), 0, 100, 0.001, torque_noise=0.01, **rare)
    drawn = site.sample()
    expected = [math.hypot(0.001, 0.01 / force) for force in (2.0, 20.0)]
    for stamps, scale in zip((slice(50), slice(50, 100)), expected, strict=True):
        assert float(drawn[:, stamps].std()) == pytest.approx(scale, rel=0.03)
    normal = torch.distributions.Normal(0.0, torch.tensor(expected).double().repeat_interleave(50)[:, None])
    torch.testing.assert_close(
        site.log_prob(drawn), normal.log_prob(drawn).sum(dim=(1, 2)), rtol=1e-5, atol=1e-3
    )


def test_locations_anywhere_are_in_the_pegs_frame_wherever_the_peg_is() -> None:
    contacts = torch.stack([points((0, 0, -50)), torch.full((1, 3), NAN, dtype=torch.float64)])
    here, far = poses.identity(2, 1), poses.identity(2, 1)
    far[..., 0] = 0.6
    felt = points((3, 0, -50))
    first, second = (ContactsInTime(Felt(contacts, pose), 0, 1, 0.001, every=1) for pose in (here, far))
    assert torch.equal(first.log_prob(felt), second.log_prob(felt))
    torch.manual_seed(5)
    drawn = ContactsInTime(
        Felt(torch.full((500, 1, 3), NAN, dtype=torch.float64), far[:1].expand(500, 1, 7)),
        0,
        1,
        0.001,
        false_alarm=0.9,
    ).sample()
    assert float(drawn[..., 0].nanmean()) == pytest.approx(0.0, abs=0.01)
