"""Other hypotheses than a belief's, by evidence: a part outside the guess, mirrored, turned, or moved.

    for edge in edges(population, "part"):
        print(edge.axis, edge.mass, edge.beyond)

A truth outside the prior's box, a part that is mirrored, was put down turned, or moved between images, leaves
a belief that is narrow and wrong. Inference is not run again: the particles that there are are moved, and the
measurements' likelihood there is compared with that of the belief.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array
from bcppl.distributions.checks import THRESHOLD
from bcppl.distributions.depth import ClutteredDepth, DepthDistribution
from bcppl.distributions.poses import SwingTwistPose, UniformPose
from bcppl.distributions.poses.uniform import tilt_and_yaw
from bcppl.inference.population import Population
from bcppl.inference.resampling import seeded, systematic
from bcppl.rendering.part_renderer import PartRenderer
from bcppl.traces import Trace
from bcppl.traces.series import SeriesTrace

DECISIVE = -math.log(THRESHOLD)  # nats: a gain worth a warning
# Strong and very strong evidence, 20 and 150 to 1 (Kass and Raftery, Bayes factors, JASA 90, 1995, section
# 3.2). Strong is enough for one of a few shapes that are given beforehand: nothing is searched, so that
# chance needs less room. Of 30 right parts none had more than 1 nat, of 17 mirrored ones 16 more than 3.
STRONG, VERY_STRONG = math.log(20.0), math.log(150.0)
EDGE = 0.1  # of a limit: so near to it a particle counts as at the edge
PILED = 0.2  # of the weight at one edge; of a uniform distribution there are 0.05 to 0.27
PARTICLES = 4
# Distances beyond the limit that are tried, in limits: from a quarter of a millimetre in a box of 20 mm.
BEYOND = tuple(0.0125 * 1.35**k for k in range(15))

# Where a displaced part may be: metres along, and radians about, its axes.
DISPLACEMENT = torch.tensor([0.02] * 3 + [math.radians(5.0)] * 3, dtype=torch.float64)
DRAWS, ROUNDS, BEST = 200, 4, 10  # of the search for it


class Edge(NamedTuple):
    """A limit of the prior against which a belief is piled up.

    Attributes:
        axis: "x", "y" or "z" of the world, "tilt", "yaw" or "angle".
        limit: metres or radians from the prior's centre, signed.
        mass: the share of the weight within 10 % of the limit, or beyond it.
        outside: the share of the weight beyond it.
        beyond: the distance beyond the limit at which the measurements fit best, metres or radians.
        gain: the log-likelihood ratio of the best place beyond to the best particle, nats.
    """

    axis: str
    limit: float
    mass: float
    outside: float
    beyond: float
    gain: float

    @property
    def decisive(self) -> bool:
        """Whether the belief is beyond the limit, or the measurements fit decisively better there."""
        return self.outside > 0.5 or self.gain > DECISIVE


def edges(population: Population, address: str) -> list[Edge]:
    """The limits of a uniform prior at which a belief has a fifth of its weight; empty for any other prior.

    The particles there are moved outwards, by steps up to the whole width, and all that depends on the pose
    is evaluated again. Other latent values keep theirs.
    """
    trace = population.trace
    prior = None if isinstance(trace, SeriesTrace) else trace.distributions.get(address)
    if not isinstance(prior, UniformPose | SwingTwistPose):
        return []
    weights, pose = torch.softmax(population.log_weights, dim=0), trace[address]
    piled: list[Edge] = []
    best = None
    for axis, limit, place, outwards in _limits(prior, pose):
        for sign in (1.0, -1.0):
            near = sign * place > (1.0 - EDGE) * limit
            mass = float(weights[near].sum())
            if mass < PILED:
                continue
            best = float(_of_others(trace, address).max()) if best is None else best
            beyond, gain = _beyond(population, address, near, sign * limit * outwards, limit, best)
            outside = float(weights[sign * place > limit].sum())
            piled.append(Edge(axis, sign * limit, mass, outside, beyond, gain))
    return piled


def _limits(prior: Any, pose: Tensor) -> Iterator[tuple[str, float, Tensor, Tensor]]:
    """Each limited coordinate: name, limit, values (N,), and the tangent (N, 6) that increases it by 1."""
    tangent = poses.local(prior.center, pose)
    eye = torch.eye(6, dtype=torch.float64)
    for k, axis in enumerate("xyz"):
        if float(prior.widths[k]) > 0.0:
            yield axis, float(prior.widths[k]), tangent[:, k], eye[k].expand(len(pose), 6)
    if isinstance(prior, UniformPose):
        if 0.0 < prior.angle < math.pi:
            angle = tangent[:, 3:].norm(dim=1)
            turn = tangent[:, 3:] / angle.clamp_min(1e-9)[:, None]
            yield "angle", prior.angle, angle, torch.cat([torch.zeros_like(turn), turn], dim=1)
        return
    tilt, yaw = tilt_and_yaw(prior.center, pose)
    if 0.0 < prior.tilt < math.pi:
        # The pose swings about a level axis after it has twisted: in its own frame that axis is turned back
        # by the whole yaw, and the rotation vector lies half of it on the way.
        turned = torch.atan2(tangent[:, 4], tangent[:, 3]) - 0.5 * yaw
        still = torch.zeros(len(pose), 3, dtype=torch.float64)
        swing = torch.stack([turned.cos(), turned.sin(), still[:, 0]], dim=1)
        yield "tilt", prior.tilt, tilt, torch.cat([still, swing], dim=1)
    if 0.0 < prior.yaw < math.pi:
        yield "yaw", prior.yaw, yaw, eye[5].expand(len(pose), 6)


def _of_others(trace: Trace, address: str) -> Tensor:
    """The log-probability (N,) of all sites but that of the pose itself."""
    return trace.log_prob(*(a for a in trace.addresses if a != address))


def _beyond(
    population: Population, address: str, near: Tensor, step: Tensor, limit: float, best: float
) -> tuple[float, float]:
    """The best distance beyond a limit, and its log-likelihood ratio to the best particle."""
    chosen = systematic(torch.where(near, population.log_weights, -torch.inf), PARTICLES)
    few = population.trace.chosen(chosen.repeat_interleave(len(BEYOND)))
    share = torch.tensor(BEYOND, dtype=torch.float64).repeat(PARTICLES)
    start = step[chosen].repeat_interleave(len(BEYOND), dim=0)
    moved = few.at({address: poses.retract(few[address], share[:, None] * start)})
    reached = _of_others(moved, address)
    highest = int(reached.nan_to_num(nan=-torch.inf).argmax())
    return float(share[highest]) * limit, float(reached[highest]) - best


class Alternative(NamedTuple):
    """Another part, or another orientation, under which images are more probable.

    Attributes:
        name: such as "mirrored along x" or "turned by 180° about its z", of the part's axes.
        gain: the log-likelihood ratio to the belief, nats.
    """

    name: str
    gain: float


def alternatives(population: Population, particles: int = PARTICLES) -> list[Alternative]:
    """Mirrored or turned parts for which the depth images are strong evidence, the best first.

    The part is mirrored, or turned by a half or a quarter, about the middle of its bounding box, where it is
    believed to be; nothing is searched. A part that is symmetric has the same likelihood so, and is not
    named.
    """
    with seeded(0):
        few = _drawn(population, particles)
    sites = [(few.distributions[address], few[address]) for address in _images(few)]
    images = [(site, image) for site, image in sites if isinstance(site.renderer, PartRenderer)]
    parts = {id(site.renderer.part): site.renderer for site, _ in images}
    if len(parts) != 1:
        return []
    believed = torch.stack([site.log_prob(image) for site, image in images]).sum(dim=0)
    (stated,) = parts.values()
    part = stated.part
    middle = 0.5 * (part.vertices.min(axis=0) + part.vertices.max(axis=0))
    results = []
    for name, other, turn in _hypotheses(part, middle):
        renderer = None if other is None else type(stated)(other)
        log_likelihood: Any = 0.0
        for site, image in images:
            pose = poses.compose(site.pose, turn)
            there = replace(site, pose=pose, renderer=renderer or site.renderer)
            log_likelihood = log_likelihood + there.log_prob(image)
        results.append(Alternative(name, float(log_likelihood.max() - believed.max())))
    return sorted((r for r in results if r.gain > STRONG), key=lambda each: -each.gain)


def _hypotheses(part: Any, middle: Array) -> Iterator[tuple[str, Any, Tensor]]:
    """Each hypothesis: its name, the other part (None for the same), its turn (7,) in the part's frame."""
    for k, axis in enumerate("xyz"):
        sign = np.ones(3)
        sign[k] = -1.0
        vertices = np.ascontiguousarray(middle + sign * (part.vertices - middle))
        mirrored = replace(part, vertices=vertices, faces=part.faces[:, ::-1].copy(), pieces=())
        yield f"mirrored along {axis}", mirrored, poses.identity()
    center = torch.tensor([*middle, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    for axis, degrees in (("x", 180), ("y", 180), ("z", 180), ("z", 90), ("z", -90)):
        turn = torch.zeros(6, dtype=torch.float64)
        turn[3 + "xyz".index(axis)] = math.radians(degrees)
        about = poses.compose(poses.retract(center, turn), poses.inverse(center))
        yield f"turned by {degrees}° about its {axis}", None, about


def _drawn(population: Population, particles: int) -> Any:
    """The trace of some particles, drawn by weight."""
    return population.trace.chosen(systematic(population.log_weights, particles))


def _images(trace: Any) -> list[str]:
    """The addresses of a trace's depth images; of a series none."""
    if isinstance(trace, SeriesTrace):
        return []
    images = DepthDistribution | ClutteredDepth
    return [address for address, site in trace.distributions.items() if isinstance(site, images)]


class Displaced(NamedTuple):
    """A depth image that sees the part elsewhere than the belief, and than its camera's errors, allow.

    Attributes:
        address: of the image.
        distance: from where it is believed to be seen to where it fits best, metres.
        gain: the log Bayes factor of a displaced part, N(0, (20 mm)^2, (5 degrees)^2), to the belief, nats.
    """

    address: str
    distance: float
    gain: float


def displaced(population: Population, particles: int = PARTICLES, seed: int = 0) -> list[Displaced]:
    """The depth images that are decisively more probable where the part is displaced from the belief.

    A check of all pixels together hardly sees that a part has moved along its table, for most pixels stay as
    they were; the evidence of a displaced part does. It is estimated for each image by importance sampling,
    from a normal that is fitted to the best of the draws of each round before (the cross-entropy method,
    Rubinstein, Methodology and Computing in Applied Probability 1, 1999).
    """
    with seeded(seed), torch.no_grad():
        few = _drawn(population, particles)
        every = [_displaced(few, address) for address in _images(few)]
    return [each for each in every if each.gain > DECISIVE]


def _displaced(few: Trace, address: str) -> Displaced:
    believed, image = few.log_prob(address), few[address]
    site = few.chosen(believed.argmax().expand(DRAWS)).distributions[address]
    start = site.pose
    center, scale = torch.zeros_like(DISPLACEMENT), DISPLACEMENT
    for _ in range(ROUNDS):
        away = center + scale * torch.randn(DRAWS, 6, dtype=torch.float64)
        seen = poses.retract(start, away)
        log_likelihood = replace(site, pose=seen).log_prob(image)
        log_ratio = _log_normal(away / DISPLACEMENT, DISPLACEMENT) - _log_normal(
            (away - center) / scale, scale
        )
        best = away[log_likelihood.topk(BEST).indices]
        center, scale = best.mean(dim=0), best.std(dim=0).clamp_min(1e-6)
    evidence = torch.logsumexp(log_likelihood + log_ratio, dim=0) - math.log(DRAWS)
    gain = evidence - (torch.logsumexp(believed, dim=0) - math.log(len(believed)))
    distance = (seen[log_likelihood.argmax(), :3] - start[0, :3]).norm()
    return Displaced(address, float(distance), float(gain))


def _log_normal(whitened: Tensor, scale: Tensor) -> Tensor:
    """The log-density (N,), up to a constant, of normal numbers (N, 6) that are divided by their scale."""
    return -0.5 * whitened.square().sum(dim=1) - scale.log().sum()


def likeliest(others: Sequence[Alternative]) -> str:
    """The names of the alternatives that are as probable as the first, short of very strong evidence."""
    return " or ".join(each.name for each in others if each.gain > others[0].gain - VERY_STRONG)
