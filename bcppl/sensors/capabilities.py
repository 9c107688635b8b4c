"""Capabilities that a likelihood may have beyond its sites; filters and rankings ask for them by protocol."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

from torch import Tensor

from bcppl.distributions.pose_normals import PoseFactor
from bcppl.distributions.poses import NormalPose


class Approximated(NamedTuple):
    """A measurement of which an approximation is made.

    Attributes:
        number: in the recording.
        action: what the robot did.
        value: observed at its address.
    """

    number: int
    action: Any
    value: Tensor


@runtime_checkable
class SamplesNuisances(Protocol):
    """A likelihood that samples nuisance parameters with the first measurement that needs them."""

    nuisance_addresses: Collection[str]  # patterns


@runtime_checkable
class FitsPose(Protocol):
    """An instrument with nuisance parameters: a measurement is approximated by a Gaussian over both."""

    def instrument(self, action: Any) -> str:
        """The name of the instrument; the errors of its measurements are correlated."""

    def viewpoint(self, action: Any) -> str:
        """The name of a place of the instrument; all measurements from there share nuisance parameters."""

    def fit(
        self, number: int, action: Any, observations: Mapping[str, Tensor], near: Tensor | None = None
    ) -> Any:
        """A Gaussian approximation of one measurement's likelihood.

        `near` are poses (K, 7) about which the part may be too, and which are followed as well.
        """

    def factor(self, actions: Sequence[Any], values: Mapping[str, Tensor]) -> PoseFactor:
        """The Gaussian over the part's pose (N, 7), given an instrument's nuisance parameters by address.

        There is an action for each viewpoint.
        """

    def marginal_factor(self, actions: Sequence[Any], fits: Sequence[Any]) -> PoseFactor:
        """The Gaussian over the part's pose (1, 7), an instrument's nuisance parameters integrated out."""

    def brings_nuisances(self, action: Any, trace: Any) -> bool:
        """Whether the measurement comes with nuisance parameters that a trace does not yet have."""

    def propose(self, action: Any, fit: Any, part: NormalPose | None, values: Any) -> Mapping[str, Tensor]:
        """Sample new nuisance parameters, given the part's pose (N, 7); None where it is known by nothing.

        `values` are those that there are already, by address.
        """

    def accompany(
        self,
        action: Any,
        fit: Any,
        trace: Any,
        old: Tensor,
        new: Tensor,
        correlation: float,
        values: Mapping[str, Tensor],
    ) -> Mapping[str, Tensor]:
        """Sample the nuisance parameters that fit a part that moves from (N, 7) to (N, 7).

        `values` are those that were sampled before, by address.
        """


@runtime_checkable
class Linearised(Protocol):
    """Sites with a quadratic approximation (`quadratic`) around any pose, and no nuisance parameters."""

    def address(self, number: int) -> str:
        """The address of a measurement's site."""

    def sites(
        self, measurements: Sequence[Approximated], part: Tensor, blur: float
    ) -> Iterator[tuple[Any, Tensor]]:
        """Each measurement's likelihood at poses (S, 7), errors `blur` metres wider, and its value."""


@runtime_checkable
class Screens(Protocol):
    """A simulated likelihood, and a cheap one of the same measurements, which is what is linearised."""

    geometry: Any  # the cheap likelihood


@runtime_checkable
class Contacts(Protocol):
    """Measurements that are informative only near the part, and several of whose explanations may fit."""

    def is_informative(self, action: Any, value: Tensor, part: Tensor) -> bool:
        """Whether a measurement depends on the part's pose at all, near poses (M, 7)."""

    def new_contact(self, measurements: Sequence[Approximated], newest: bool) -> bool:
        """Whether contact begins in one of the measurements, or in the newest of them."""

    def heading(self, measurements: Sequence[Approximated]) -> Tensor | None:
        """The direction (3,) of motion when contact last began; None without contact."""


class InHole(NamedTuple):
    """Poses of a part that have a peg in its hole.

    Attributes:
        part: (K, 7).
        information: (K, 6, 6) of the room that the hole leaves the peg, in the tangent space there.
    """

    part: Tensor
    information: Tensor


@runtime_checkable
class EntersHole(Protocol):
    """Measurements of a held peg, which may have gone into the part's hole."""

    def in_hole(self, measurements: Sequence[Approximated], part: Tensor) -> InHole:
        """Poses near some (M, 7) that have the hole where the peg would lie deep in the material."""

    def at_mouth(self, measurements: Sequence[Approximated], part: Tensor) -> Tensor:
        """Poses (K, 7), turned as some (M, 7), whose hole has the tip of the peg in its mouth."""


@runtime_checkable
class Defers(Protocol):
    """Measurements that may have no site of their own: a later one brings what they inform."""

    def is_deferred(self, action: Any) -> bool:
        """Whether a measurement's observations come with a later one."""


class PegRows(NamedTuple):
    """R moments of a held peg's motion.

    Attributes:
        time: (R,) s.
        felt: (R,) bool, whether it was felt to touch.
        episode: (R,) int64, the same number for one uninterrupted contact.
        world_from_peg: (R, 7) as measured.
        force: (R, 3) on the peg, in the world's axes, N.
    """

    time: Tensor
    felt: Tensor
    episode: Tensor
    world_from_peg: Tensor
    force: Tensor

    @property
    def contacts(self) -> PegRows:
        """Those at which it was felt to touch."""
        return PegRows(*(column[self.felt] for column in self))


@runtime_checkable
class FeelsForces(Protocol):
    """A likelihood of what a held peg touches, by its gap to the part and the forces."""

    gap: Any  # of poses (N, 7) of the part and (R, 7) of the peg

    def peg_rows(self, measurements: Sequence[Approximated]) -> PegRows:
        """How the peg moved in some measurements, and when it touched."""


@runtime_checkable
class SharesErrors(Protocol):
    """A likelihood of what a held peg touches, with errors that all touches share."""

    bench: Any  # `bcppl.distributions.episodes.LinearErrors`

    @property
    def shared_prior(self) -> tuple[Tensor, Tensor]:
        """Mean (M,) and covariance (M, M) of these errors before any touch."""

    def inserted(self, world_from_part: Tensor) -> Tensor:
        """The peg's pose (7,) with its tip at a part's frame (7,), turned as the part."""


@runtime_checkable
class Grasping(Protocol):
    """A likelihood of what a held peg touches, which may sit off in the hand."""

    def grasping(self, grip_from_peg: Tensor) -> Any:
        """The likelihood given the peg's pose (N, 7) in the grip's frame."""


@runtime_checkable
class Informative(Protocol):
    """The expected information of a measurement is known without simulating it."""

    def information(self, done: Sequence[Any], action: Any, part: Tensor) -> Tensor:
        """The information (N, 6, 6) that a measurement adds about the part's pose (N, 7)."""
