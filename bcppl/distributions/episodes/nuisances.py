"""What is off on real benches: the grasp, the arm's compliance and kinematics, clocks, sizes, and slides."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.episodes.linear_errors import Effect, Jump
from bcppl.distributions.episodes.rows import SECONDS, WITHIN, WRENCH
from bcppl.distributions.parameters import NONNEGATIVE, POSITIVE, RARE, check_parameters, within


class _Unchanging:
    """The parts of an error whose parameters are standard normal and never jump."""

    count = 6

    def __post_init__(self) -> None:
        check_parameters(self)

    @property
    def means(self) -> Tensor:
        """(M,) in standard deviations."""
        return torch.zeros(self.count, dtype=torch.float64)

    @property
    def variances(self) -> Tensor:
        """(M,) 1, or 0 for what only jumps."""
        return torch.ones(self.count, dtype=torch.float64)

    @property
    def jumps(self) -> Sequence[Jump]:
        """Its sudden changes."""
        return ()

    @property
    def delays(self) -> Mapping[int, float]:
        """None: it is no delay."""
        return {}


@dataclass(frozen=True)
class Grasp(_Unchanging):
    """The peg sits off in the hand, and may slip.

    Attributes:
        shift, turn, yaw: standard deviations along each of the peg's axes (m), about those across it, and
            about its own (rad): 0 for a round peg, which slips do not turn either.
        slip, slip_turn: of a slip, m and rad; about a peg's own axis only where there is a `yaw`.
        slips: the probability of one, at each episode of contact.
    """

    shift: float = field(default=0.001, metadata=NONNEGATIVE)
    turn: float = field(default=math.radians(1.0), metadata=NONNEGATIVE)
    yaw: float = field(default=math.radians(2.0), metadata=NONNEGATIVE)
    slip: float = field(default=0.0005, metadata=NONNEGATIVE)
    slip_turn: float = field(default=math.radians(0.2), metadata=NONNEGATIVE)
    slips: float = field(default=0.005, metadata=RARE)
    name = "the peg's pose in the hand"

    @property
    def variances(self) -> Tensor:
        """(M,) 1, or 0 for what only jumps."""
        return (self._begins > 0.0).double()

    @property
    def _begins(self) -> Tensor:
        return torch.tensor([self.shift] * 3 + [self.turn, self.turn, self.yaw], dtype=torch.float64)

    @property
    def _slips(self) -> Tensor:
        about = self.slip_turn if self.yaw else 0.0
        return torch.tensor([self.slip] * 3 + [self.slip_turn] * 2 + [about], dtype=torch.float64)

    @property
    def _scale(self) -> Tensor:
        # What is known at first, and slips all the same, is counted in standard deviations of a slip.
        return torch.where(self._begins > 0.0, self._begins, self._slips)

    @property
    def jumps(self) -> Sequence[Jump]:
        """Its sudden changes."""
        change = torch.where(self._scale > 0.0, self._slips / self._scale, 0.0)
        return (Jump("the peg slipped in the hand", self.slips, change**2),)

    def effect(self, rows: Tensor) -> Effect:
        """Its effect at rows (T, COLUMNS)."""
        return Effect(torch.diag(self._scale).expand(len(rows), 6, 6), rows.new_zeros(len(rows), 6))


@dataclass(frozen=True)
class ArmCompliance(_Unchanging):
    """Arm and grip yield to the wrench, beyond what the joints measure.

    Along and about each of the peg's axes the compliance is positive: its standard deviation is its mean, as
    of an exponential distribution, of which it is the normal with the same moments.

    Attributes:
        translation: mean compliance along the axes, m/N.
        rotation: about them, rad/(N m).
    """

    translation: float = field(default=2e-5, metadata=NONNEGATIVE)
    rotation: float = field(default=5e-4, metadata=NONNEGATIVE)
    name = "the compliance of arm and grip"

    @property
    def means(self) -> Tensor:
        """(M,) in standard deviations."""
        return torch.ones(6, dtype=torch.float64)

    def effect(self, rows: Tensor) -> Effect:
        """Its effect at rows (T, COLUMNS)."""
        scale = torch.tensor([self.translation] * 3 + [self.rotation] * 3, dtype=torch.float64)
        yielded = torch.nan_to_num(rows[:, WRENCH]) * scale
        return Effect(torch.diag_embed(yielded), rows.new_zeros(len(rows), 6))


@dataclass(frozen=True)
class KinematicError(_Unchanging):
    """A smooth error of the arm's kinematics over the workspace, to first order.

    That of a Gaussian process over the peg's position x with covariance s^2 exp(-|x - x'|^2 / 2 l^2) in each
    axis of the world: a constant of standard deviation s, and a linear field of standard deviation s / l in
    each of its nine derivatives.

    Attributes:
        size: s, m.
        length: l, m.
        center: (3,) x about which the field is linear, in the world, m.
    """

    size: float = field(default=0.0003, metadata=NONNEGATIVE)
    length: float = field(default=0.1, metadata=POSITIVE)
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    name = "the error of the arm's kinematics"
    count = 12

    def effect(self, rows: Tensor) -> Effect:
        """Its effect at rows (T, COLUMNS)."""
        away = (rows[:, :3] - torch.tensor(self.center, dtype=torch.float64)) / self.length
        basis = self.size * torch.cat([torch.ones_like(away[:, :1]), away], dim=1)  # (T, 4)
        turned = poses.rotation_matrix(rows[:, :7]).transpose(-1, -2)  # of the world into the peg's frame
        moved = (turned[:, :, None, :] * basis[:, None, :, None]).reshape(len(rows), 3, 12)
        return Effect(torch.cat([moved, torch.zeros_like(moved)], dim=1), rows.new_zeros(len(rows), 12))


@dataclass(frozen=True)
class PartSlides:
    """The part slides on its table when it is touched: it never does before the first jump.

    A push at an arm a turns it by its shift times a / r^2, r about 30 mm being the radius of the friction's
    limit surface (Howe and Cutkosky, IJRR 15, 1996): by half a degree where a is 15 mm and the shift 0.5 mm.

    Attributes:
        shift: standard deviation along the table's two axes, m.
        turn: about its normal, rad.
        probability: at each episode of contact.
        center: (3,) about which the part turns, in the world, m.
    """

    shift: float = field(default=0.0005, metadata=POSITIVE)
    turn: float = field(default=math.radians(0.5), metadata=POSITIVE)
    probability: float = field(default=0.005, metadata=RARE)
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    name = "the part's place on the table"

    def __post_init__(self) -> None:
        check_parameters(self)

    @property
    def means(self) -> Tensor:
        """(M,) in standard deviations."""
        return torch.zeros(3, dtype=torch.float64)

    @property
    def variances(self) -> Tensor:
        """(M,) 1, or 0 for what only jumps."""
        return torch.zeros(3, dtype=torch.float64)

    @property
    def jumps(self) -> Sequence[Jump]:
        """Its sudden changes."""
        return (Jump("the part slid", self.probability, torch.ones(3, dtype=torch.float64)),)

    @property
    def delays(self) -> Mapping[int, float]:
        """None: it is no delay."""
        return {}

    def effect(self, rows: Tensor) -> Effect:
        """Its effect at rows (T, COLUMNS)."""
        # A part that moves one way is a peg that moves the other.
        away = rows[:, :3] - torch.tensor(self.center, dtype=torch.float64)
        moved = rows.new_zeros(len(rows), 6, 3)
        moved[:, 0, 0] = moved[:, 1, 1] = self.shift
        moved[:, 0, 2], moved[:, 1, 2], moved[:, 5, 2] = (
            -self.turn * away[:, 1],
            self.turn * away[:, 0],
            self.turn,
        )
        into_peg = poses.rotation_matrix(rows[:, :7]).transpose(-1, -2)
        return Effect(
            -torch.cat([into_peg @ moved[:, :3], into_peg @ moved[:, 3:]], dim=1),
            rows.new_zeros(len(rows), 3),
        )


@dataclass(frozen=True)
class Delay(_Unchanging):
    """The wrench is later than the pose: where it was felt, the peg was on the way.

    A peg that stops, as in a touch, was not where its velocity says: so intervals of the delay are hypotheses
    (`Hypothesis.delay`), each with a place of its own for the peg. The parameter is of the rest.

    Attributes:
        longest: s, at most the last of `rows.SECONDS`; the delay is anything between 0 and it, evenly.
        within: standard deviation of the rest, in halves of an interval: 0.58 of an even distribution.
        later: the probability that it is in the interval after that, where there is one. Without it a wrench
            that is 60 ms late under a limit of 45 gave a belief that was sure of a pose 3 mm off.
    """

    longest: float = field(default=SECONDS[-2], metadata=within(above=0.0, most=SECONDS[-1]))
    within: float = field(default=0.7, metadata=POSITIVE)
    later: float = field(default=0.05, metadata=RARE)
    name = "the time between wrench and pose"
    count = 1

    @property
    def delays(self) -> Mapping[int, float]:
        """Probabilities of the intervals in which it may lie."""
        ends = [min(end, self.longest) for end in (0.0, *SECONDS)]
        spans = {k: ends[k] - ends[k - 1] for k in range(1, len(ends)) if ends[k] > ends[k - 1]}
        after = {len(spans) + 1: self.later} if self.later and len(spans) < len(SECONDS) else {}
        return {k: (1.0 - sum(after.values())) * span / ends[-1] for k, span in spans.items()} | after

    def effect(self, rows: Tensor) -> Effect:
        """Its effect at rows (T, COLUMNS)."""
        twist = self.within * torch.nan_to_num(rows[:, WITHIN])[..., None]
        return Effect(twist, rows.new_zeros(len(rows), 1))


@dataclass(frozen=True)
class Size(_Unchanging):
    """Part and peg are larger than stated by the same everywhere.

    Attributes:
        growth: standard deviation of how much the gap is smaller, m.
    """

    growth: float = field(default=0.0001, metadata=NONNEGATIVE)
    name = "the size of part and peg"
    count = 1

    def effect(self, rows: Tensor) -> Effect:
        """Its effect at rows (T, COLUMNS)."""
        return Effect(rows.new_zeros(len(rows), 6, 1), rows.new_full((len(rows), 1), -self.growth))
