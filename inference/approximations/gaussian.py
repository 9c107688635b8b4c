"""A Gaussian approximation of the posterior of a part's pose, carried by a population from step to step.

An image is approximated by a Gaussian over the pose at which its camera sees the part and the camera's bias;
contacts and ranges by the quadratic approximation of their likelihood around its modes. It guides proposals
only: the target never depends on it. It is immutable, and `including` a measurement gives a new one, so that
a run that is resumed, branched or repeated gives the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from bcppl import poses
from bcppl.cached import cached_property
from bcppl.devices import HOST, current_device, on_host, to_device
from bcppl.distributions.pose_normals import GaussianMixture, matched, mixture_of, widened_mixture
from bcppl.distributions.poses import MixturePose
from bcppl.distributions.support import freedom_of
from bcppl.errors import InputError
from bcppl.inference.approximations.adaptive import adapted
from bcppl.inference.approximations.fits import ViewpointFit, conditional, given_fits
from bcppl.inference.approximations.laplace import (
    QuadraticApproximation,
    Search,
    component_of,
    concatenated_modes,
    quadratic_approximation,
    together,
    within_component,
)
from bcppl.inference.targets import PHYSICS, cost_of
from bcppl.sensors.capabilities import Approximated, Contacts, EntersHole, FitsPose, Linearised, Screens

# A mode that particles miss: of at least this share of all modes' weight, at most so many nats less probable
# than the best particle, and no particle within so many squared standard deviations.
_SHARE, _LESS, _APART = 0.05, 5.0, 50.0
# Draws of a normal, the same in every run.
_DRAWS = torch.randn(128, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
_BETTER = 3.0  # nats by which a particle is more probable than all modes, which have been lost
_FOLLOWED = 32  # particles from which modes are searched for
UNSURE = 0.0005  # m: beyond this standard deviation the contact may be with another place of the part


@dataclass(frozen=True, eq=False)
class GaussianApproximation:
    """The posterior given some measurements, as a mixture of Gaussians."""

    pose: str  # the address of the part's pose
    scene: Any  # of the model; it has the prior and the sensors' likelihoods
    fits: Mapping[str, ViewpointFit] = field(default_factory=dict)  # by viewpoint
    contacts: tuple[Approximated, ...] = ()  # measurements with a quadratic approximation
    quadratic: QuadraticApproximation | None = None  # of the contacts' likelihood; None before the first
    adapted: QuadraticApproximation | None = None  # the same by importance sampling, for proposals
    # by number of the measurement, whether it is informative near the fits' estimate
    relevant: Mapping[int, bool] = field(default_factory=dict)
    stale: bool = False  # whether contacts were added after `quadratic` was computed
    near: Tensor | None = None  # (K, 7) poses that fits of measurements follow too
    thorough: bool = True  # whether modes are searched for from many places where there may be several

    def __post_init__(self) -> None:
        if not hasattr(self.scene, "prior") or not hasattr(self.scene, "sensor"):
            raise InputError(
                "a Gaussian approximation needs a scene with a prior and sensors (bcppl.sensors.Scene); "
                "compose the model of sensors, or use tempered SMC."
            )
        freedom = freedom_of(self.scene.prior)
        if freedom is not None and freedom.dimension < 6:
            raise InputError(
                f"the prior holds {6 - freedom.dimension} of the part's 6 axes fixed, and a Gaussian "
                "approximation needs all free; use tempered SMC (--inference tempered_smc)."
            )

    def including(
        self, scene: Any, number: int, action: Any, observations: Mapping[str, Tensor]
    ) -> GaussianApproximation:
        """The approximation given one more measurement, the `number`-th of the recording."""
        longer = self.updated().deferring(scene, number, action, observations)
        return replace(longer, stale=longer.stale or bool(longer.contacts)).updated()

    @cached_property
    def here(self) -> GaussianApproximation:
        """The same on the device of the run (`bcppl.devices`): it is worked on by the host, being small."""
        device = current_device()
        if device == HOST:
            return self
        fits = {name: replace(each, fit=to_device(each.fit, device)) for name, each in self.fits.items()}
        there = replace(
            self,
            scene=to_device(self.scene, device),
            fits=fits,
            quadratic=to_device(self.quadratic, device),
            adapted=to_device(self.adapted, device),
        )
        there.__dict__.update(
            here=there,
            prior=to_device(self.prior, device),
            modes=to_device(self.modes, device),
            mixture=to_device(self.mixture, device),
        )
        return there

    @on_host()
    def deferring(
        self, scene: Any, number: int, action: Any, observations: Mapping[str, Tensor]
    ) -> GaussianApproximation:
        """The same with a measurement that changes little; the quadratic approximation is updated later."""
        scene = to_device(scene, HOST)
        sensor = scene.sensor(action)
        if isinstance(sensor, FitsPose):
            name = sensor.viewpoint(action)
            if name in self.fits:
                return replace(self, scene=scene)
            near = to_device(self.near, HOST)
            fits = {**self.fits, name: ViewpointFit(action, sensor.fit(number, action, observations, near))}
            # The estimate moves, so it is asked again which contacts are informative there.
            return replace(self, scene=scene, fits=fits, relevant={})
        if isinstance(sensor, Linearised) and sensor.address(number) in observations:
            contact = Approximated(number, action, observations[sensor.address(number)])
            return replace(self, scene=scene, contacts=(*self.contacts, contact), stale=True)
        return replace(self, scene=scene)

    @on_host()
    def updated(self) -> GaussianApproximation:
        """The same with the quadratic approximation of all contacts, adapted to the posterior."""
        if not self.stale:
            return self
        found, known = self.searched(), self.prior
        assert found.quadratic is not None
        wider = None if self.quadratic is None else self.mixture
        own, each = known.component(found.quadratic.around), []
        for k in own.unique().tolist():
            modes = QuadraticApproximation(*(values[own == k] for values in found.quadratic))
            each.append(
                adapted(found._sites, component_of(known, k), modes, within_component(known, k, wider))
            )
        return replace(found, adapted=concatenated_modes(each))

    @on_host()
    def searched(self) -> GaussianApproximation:
        """The same with the quadratic approximation of all contacts, by its curvature at the modes."""
        relevant = dict(self.relevant)
        for contact in self.contacts:
            sensor = self.scene.sensor(contact.action)
            if contact.number not in relevant:
                relevant[contact.number] = not isinstance(sensor, Contacts) or sensor.is_informative(
                    contact.action, contact.value, self.prior.centers
                )
        given = replace(self, relevant=relevant)
        by_sensor = list(self._by_sensor(given._informative))
        contacts = [(sensor, own) for sensor, own in by_sensor if isinstance(sensor, Contacts)]
        first = self.quadratic is None
        ambiguous = any(sensor.new_contact(own, newest=not first) for sensor, own in contacts)
        # No contact has begun, which could have been with several places: the modes hardly move.
        again = self.near is not None
        nearby = not (first or ambiguous or again) and len(contacts) == len(by_sensor)
        headings = [sensor.heading(own) for sensor, own in contacts]
        known = self.prior
        everywhere = self.thorough and (again or (ambiguous and self._is_unsure()))
        before = None if self.quadratic is None else self.modes
        heading = next((heading for heading in headings if heading is not None), None)
        entering = [(sensor, c) for sensor, c in by_sensor if isinstance(sensor, EntersHole)]
        each = []
        for k in range(len(known.centers)):
            mine, normal = within_component(known, k, before), component_of(known, k)
            near = normal.center if mine is None else torch.cat([normal.center, mine.centers])
            inside = [sensor.in_hole(c, near) for sensor, c in entering]
            inside = [places for places in inside if len(places.part)]
            entries = tuple(partial(s.at_mouth, c) for s, c in entering)
            search = Search(heading, everywhere, entries, self.near)
            each.append(quadratic_approximation(given._sites, normal, mine, search, inside, nearby))
        quadratic = each[0] if len(each) == 1 else together(each, known)
        return replace(given, quadratic=quadratic, adapted=quadratic, stale=False)

    def _sites(self, pose: Tensor, blur: float) -> Iterator[tuple[Any, Tensor]]:
        """The likelihood of the contacts at poses (S, 7), as `laplace.Sites`."""
        for sensor, own in self._by_sensor(self._informative):
            yield from sensor.sites(own, pose, blur)

    def _by_sensor(self, contacts: tuple[Approximated, ...]) -> Iterator[tuple[Any, list[Approximated]]]:
        groups: dict[int, tuple[Any, list[Approximated]]] = {}
        for contact in contacts:
            sensor = self.scene.sensor(contact.action)
            groups.setdefault(id(sensor), (sensor, []))[1].append(contact)
        yield from groups.values()

    def _is_unsure(self) -> bool:
        """Whether the part may be at several places so far, or at one that is not known well."""
        covariances = self.mixture.covariances
        wide = torch.linalg.eigvalsh(covariances[:, :3, :3])[:, -1].sqrt()
        return len(wide) > 1 or bool((wide > UNSURE).any())

    @cached_property
    @on_host()
    def prior(self) -> GaussianMixture:
        """The pose given the instruments' fits; the model's prior where there is none."""
        return given_fits(self.scene, list(self.fits.values()))

    @cached_property
    @on_host()
    def modes(self) -> GaussianMixture:
        """The posterior by its modes and its curvature there (Laplace's method)."""
        return self._posterior(self.quadratic)

    @cached_property
    @on_host()
    def mixture(self) -> GaussianMixture:
        """The posterior of the part's pose, the nuisance parameters integrated out."""
        return self._posterior(self.adapted)

    @cached_property
    def widened(self) -> MixturePose:
        """The mixture as an independence proposal of the part's pose."""
        return widened_mixture(self.mixture)

    def _posterior(self, quadratic: QuadraticApproximation | None) -> GaussianMixture:
        prior = self.prior
        if quadratic is None:
            return prior
        own = prior.component(quadratic.around)
        centers, covariances, log_weights = quadratic.posterior_each(
            prior.centers[own], torch.linalg.inv(prior.covariances[own])
        )
        return GaussianMixture(centers, covariances, log_weights + prior.log_weights[own])

    @property
    def is_ambiguous(self) -> bool:
        """Whether the instruments leave several modes."""
        return len(self.prior.log_weights) > 1

    @on_host()
    def is_far(self, scene: Any, number: int, action: Any, observations: Mapping[str, Tensor]) -> bool:
        """Whether a contact is too far from where the instruments place the part to depend on its pose."""
        sensor = scene.sensor(action)
        if not (isinstance(sensor, Contacts) and isinstance(sensor, Linearised)):
            return False
        value = observations.get(sensor.address(number))
        return value is not None and not sensor.is_informative(action, value, self.prior.centers)

    @on_host()
    def share_inside(self, action: Any) -> float:
        """How much of it lies where the prior is as dense as anywhere in it, before a measurement."""
        if self.adapted is None and isinstance(self.scene.sensor(action), FitsPose):
            return 1.0  # its conditional has the same limits
        centers, covariances, log_weights = self.mixture
        drawn = poses.exp(centers[:, None], _DRAWS @ torch.linalg.cholesky(covariances).transpose(-1, -2))
        density = self.scene.prior.log_prob(drawn)
        relative = (density - density.max()).exp()
        return float(log_weights.softmax(dim=0) @ relative.mean(dim=1))

    def screens(self, action: Any) -> bool:
        """Whether a measurement is simulated, and what is approximated is a cheap likelihood of it."""
        return isinstance(self.scene.sensor(action), Screens)

    def stratum(self, trace: Any) -> Tensor:
        """The mode of each particle (N,), int64."""
        return self.here.mixture.component(trace[self.pose])

    def shortfall(self, trace: Any) -> float:
        """By how many nats the best mode explains all measurements better than the median particle does.

        Where the population is spread over the posterior it is about 3, half a chi-square of six degrees of
        freedom; -inf without contacts.
        """
        if self.quadratic is None:
            return -math.inf
        here = self.here
        best, reached = here._at_modes(), here._at_particles(trace)
        return float(best.max() - reached.median())

    def is_exceeded(self, trace: Any) -> bool:
        """Whether some particle explains all measurements far better than all modes do."""
        if self.quadratic is None:
            return False
        here = self.here
        return bool(here._at_particles(trace).max() > here._at_modes().max() + _BETTER)

    @on_host()
    def following(self, trace: Any) -> GaussianApproximation:
        """The same with modes that are searched for again: from particles, and from many places."""
        count = len(trace[self.pose])
        some = torch.linspace(0, count - 1, min(count, _FOLLOWED)).long()
        near = to_device(trace[self.pose], HOST)[some]
        return replace(replace(self, near=near, stale=True).updated(), near=None)

    def misses_a_mode(self, trace: Any) -> bool:
        """Whether some mode has no particle near it, and is about as probable as the best particle."""
        if self.quadratic is None:
            return False
        here, mixture = self.here, self.here.modes
        squared = mixture.squared_deviations(trace[self.pose])
        alone = (squared > _APART).all(dim=0) & (mixture.log_weights.softmax(dim=0) > _SHARE)
        if not bool(alone.any()):
            return False
        return bool(here._at_modes()[alone].max() > here._at_particles(trace).max() - _LESS)

    def _at_modes(self) -> Tensor:
        """The log-density (M,) of the modes, given all measurements."""
        assert self.quadratic is not None
        return self.quadratic.log_likelihood + self._log_prior(self.quadratic.around)

    def _at_particles(self, trace: Any) -> Tensor:
        """The same (N,) of a trace's particles."""
        informative = self._informative
        sites = [self.scene.sensor(c.action).address(c.number) for c in informative]
        cheap = [address for address in sites if cost_of(trace.distributions[address]) < PHYSICS]
        reached = self._log_prior(trace[self.pose]) + self.log_likelihood(trace)
        return reached + trace.log_prob(*cheap) if cheap else reached

    def _log_prior(self, pose: Tensor) -> Tensor:
        within = self.scene.prior.log_prob(pose) > -torch.inf
        return torch.where(within, mixture_of(self.prior).log_prob(pose), -torch.inf)

    def log_likelihood(self, trace: Any) -> Tensor:
        """Of the informative contacts that run physics in a trace (N,), by what is approximated of them."""
        pose = trace[self.pose]
        total, sites = pose.new_zeros(len(pose)), trace.distributions

        def simulated(contact: Approximated) -> bool:
            return cost_of(sites[self.scene.sensor(contact.action).address(contact.number)]) >= PHYSICS

        for sensor, own in self._by_sensor(tuple(c for c in self._informative if simulated(c))):
            for site, value in sensor.sites(own, pose, 0.0):
                total = total + site.log_prob(value)
        return total

    @property
    def _informative(self) -> tuple[Approximated, ...]:
        return tuple(c for c in self.contacts if self.relevant.get(c.number))

    def conditional(self, trace: Any, values: Mapping[str, Tensor] | None = None) -> Any:
        """The approximate conditional distribution of the pose, given each particle's nuisance parameters.

        `values` has those that the trace lacks, by address.
        """
        return conditional(self.scene, list(self.fits.values()), self.adapted, trace, values or {})

    def predicted(self, trace: Any) -> Any:
        """The Gaussian with the moments of `conditional`; None where no measurement is included yet."""
        before = self.conditional(trace)
        if before is self.scene.prior:
            return None
        return matched(before) if isinstance(before, MixturePose) else before
