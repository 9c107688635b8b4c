"""What is known beforehand of where a part that is seen and touched will be: proposals of `look_and_touch`.

An image is resembled by a normal over where its camera sees the part, touches by quadratics around the poses
that explain them. No answer hangs on either.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.fitted import FittedNormal, fitted_normal
from bcppl.distributions.manifold_fit import Normal, Told, Window, told_by
from bcppl.distributions.mixture import MixturePose
from bcppl.distributions.pose_normals import (
    Modes,
    allowed,
    matched,
    normal_like,
    product,
    transport,
    widened,
    widened_modes,
    within,
)
from bcppl.distributions.poses import NormalPose
from bcppl.geometry.camera import Camera
from bcppl.models import camera_error
from bcppl.models.camera_error import farther
from bcppl.models.look_and_touch_scene import Scene, image_of, touch_of
from bcppl.rendering.stated_cameras import apparent_covariance
from bcppl.robot.motion import ProbeWindow
from bcppl.sensors import View
from bcppl.traces import Trace

# What an image says is taken for no surer than this: metres, radians, metres of bias.
SHARPEST = torch.tensor([5e-5] * 3 + [1e-3] * 3 + [1e-4], dtype=torch.float64)
# Correlations of deviations after a proposal with those before: of the part, and of where cameras see it.
MOVED, ARRIVING, WALKING = 0.9, 0.98, 0.9
WALK = torch.tensor([0.1, 1.5], dtype=torch.float64).log()  # of the scale of a walk
NEAR = 0.02  # m: a window in which the peg stays farther off says nothing
UNSURE = 0.0005  # m: a part that is known less well may be touched in other places than it seems
NEARBY = 25.0  # squared deviations: modes that are nearer are the same before and after a measurement
STAYING = 0.8  # of the particles go to such, the others to any


def looks_at(
    trace: Trace, actions: Sequence[View | ProbeWindow], values: Mapping[str, Tensor] | None = None
) -> dict[str, tuple[Camera, Tensor, Tensor]]:
    """Each instrument's first camera among actions, where it sees the part (N, 7), and its bias (N,)."""
    scene, first = trace.args[0], dict[str, Camera]()
    for action in actions:
        if isinstance(action, View):
            first.setdefault(action.camera.instrument, scene.looks[action.camera.name].camera)
    given = {} if values is None else values

    def value(address: str) -> Tensor:
        return given[address] if address in given else trace[address]

    return {name: (c, value(f"seen_by_{name}"), value(f"bias_{name}")) for name, c in first.items()}


def part_given(
    trace: Trace, actions: Sequence[View | ProbeWindow], values: Mapping[str, Tensor] | None = None
) -> Any:
    """Nearly the conditional of the part's pose, given actions' touches and where their cameras see it."""
    scene = trace.args[0]
    looks = looks_at(trace, actions, values)
    seen = camera_error.given_seen(scene, looks) if looks else None
    if not any(isinstance(action, ProbeWindow) for action in actions):
        return scene.prior if seen is None else within(scene.prior, seen)
    told = told_by_touches(scene, actions, trace.observations)
    if seen is None:
        expected = normal_like(scene.prior)
        center, precision = expected.center.expand(trace.particles, 7), torch.linalg.inv(expected.covariance)
        precision = precision.expand(trace.particles, 6, 6)
    else:
        center, precision = seen.center, torch.linalg.inv(seen.covariance)
    return widened_modes(told.given(center, precision))


def told_by_touches(
    scene: Scene, actions: Sequence[View | ProbeWindow], observations: Mapping[str, Tensor]
) -> Told:
    """What touches say around where they and the images place the part: it hangs on no particle."""
    if len(actions) in scene.told:
        return scene.told[len(actions)]
    assert scene.gap is not None
    known, windows = placed_by_images(scene, actions), []
    for k, action in enumerate(actions):
        if isinstance(action, ProbeWindow):
            value = observations[f"touch_{k}"]
            if f"touch_{k}" not in scene.near:
                distance = scene.gap(known.center, value[:, :7]).distance
                scene.near[f"touch_{k}"] = bool((distance < NEAR).any())
            if scene.near[f"touch_{k}"]:
                windows.append(Window(value, partial(touch_of, scene, action)))
    latest = max(scene.told, default=None)
    before = None if latest is None else scene.told[latest]
    everywhere = met_anew(windows, newest=before is not None) and unsure(known, before)
    around = None if before is None else before.around
    scene.told[len(actions)] = told_by(scene.gap, windows, known, around, everywhere)
    return scene.told[len(actions)]


def met_anew(windows: Sequence[Window], newest: bool) -> bool:
    """Whether in one of the windows, or in the newest, the peg met the part, and did not only stay on it."""
    felt = torch.cat([torch.zeros(1, dtype=torch.bool), *(window.value[:, 7] == 1.0 for window in windows)])
    onsets = felt[1:] & ~felt[:-1]
    return bool((onsets[-len(windows[-1].value) :] if newest and windows else onsets).any())


def unsure(known: Normal, told: Told | None) -> bool:
    """Whether what is known so far leaves several places open, or one that is wide."""
    if told is None:
        covariances = torch.linalg.inv(known.precision)
    else:
        covariances = told.given(known.center[0], known.precision[0]).covariances
    wide = torch.linalg.eigvalsh(covariances[:, :3, :3])[:, -1].sqrt()
    return len(wide) > 1 or bool((wide > UNSURE).any())


def placed_by_images(scene: Scene, actions: Sequence[View | ProbeWindow]) -> Normal:
    """Where the images' fits place the part, and how surely; the prior where there is none."""
    looks: dict[str, tuple[Camera, Tensor, Tensor]] = {}
    unsure: dict[str, Tensor] = {}
    for k, action in enumerate(actions):
        if isinstance(action, View) and f"depth_{k}" in scene.fits and action.camera.instrument not in looks:
            name, camera = action.camera.instrument, scene.looks[action.camera.name].camera
            point = scene.fits[f"depth_{k}"].around()
            seen, bias = poses.retract(scene.prior.center, point[:, :6]), point[:, 6]
            looks[name] = camera, seen[:1], bias[:1]
            # Where the image leaves the part's pose open, so does what is known beside the touches.
            part = farther(camera, seen, -bias)
            away = poses.local(part[:1], part[1:])
            unsure[name] = 0.5 * away.T @ away
    if not looks:
        expected = normal_like(scene.prior)
        return Normal(expected.center[None], torch.linalg.inv(expected.covariance)[None])
    said = camera_error.given_seen(scene, looks, unsure)
    return Normal(said.center, torch.linalg.inv(said.covariance))


def taken_in(trace: Trace) -> None:
    """The way there: what comes with the newest measurement, and the rest to match (see `Model.arrival`)."""
    scene, actions = trace.args
    newest, k = actions[-1], len(actions) - 1
    if isinstance(newest, ProbeWindow):
        carried_along(trace, actions, moved_on(trace, actions[:-1], actions))
        return
    values: dict[str, Tensor] = {}
    name = newest.camera.instrument
    if f"seen_by_{name}" not in trace:
        fit = seen_in(scene, newest.camera, f"depth_{k}", trace.observations[f"depth_{k}"])
        bias = pyro.sample(f"bias_{name}", dist.Normal(fit.mean[6], 1.3 * fit.covariance[6, 6].sqrt()))
        seen, expected = seen_with(scene, fit, bias), seen_before(trace, newest.camera, bias)
        around = seen if expected is None else product(seen, expected)
        values[f"bias_{name}"] = bias
        values[f"seen_by_{name}"] = pyro.sample(
            f"seen_by_{name}", widened(around.center, around.covariance.expand(len(bias), 6, 6))
        )
    pyro.sample("part", part_given(trace, actions, values))


def left_out(trace: Trace) -> None:
    """The way back: the part, and after a touch what cameras see, as likely before the newest measurement."""
    actions = trace.args[1]
    if isinstance(actions[-1], ProbeWindow):
        carried_along(trace, actions[:-1], moved_on(trace, actions, actions[:-1]))
    else:
        pyro.sample("part", part_given(trace, actions[:-1]))


def moved_on(
    trace: Trace, before: Sequence[View | ProbeWindow], after: Sequence[View | ProbeWindow]
) -> MixturePose:
    """Where a part that is known by some measurements will be known to be by others.

    Normals resemble both beliefs. What carries the one to the other by the shortest ways carries the
    particles, and some noise is added: a measurement that tells little moves them little.
    """
    start, goal = placed_by_all(trace, before), placed_by_all(trace, after)
    own, passes = start.own(trace["part"]), passing(start, goal)
    away = poses.local(start.centers[own], trace["part"])
    ways = torch.stack(
        [torch.stack([transport(one, other) for other in goal.covariances]) for one in start.covariances]
    )
    moved = (away[:, None, None] @ ways[own])[:, :, 0]
    return widened_modes(
        Modes(
            poses.retract(goal.centers, MOVED * moved),
            ((1.0 - MOVED**2) * goal.covariances).expand(trace.particles, -1, 6, 6),
            passes[own],
        )
    )


def passing(start: Modes, goal: Modes) -> Tensor:
    """Log-chances (M, K) by which particles of each of M modes come to each of K others.

    Mostly they go to where they may be already: to their own mode, as more measurements know it.
    """
    away = poses.local(start.centers[:, None], goal.centers)
    both = start.covariances[:, None] + goal.covariances
    squared = (away * torch.linalg.solve(both, away[..., None])[..., 0]).sum(dim=-1)
    any_mode = goal.log_weights.log_softmax(dim=0).expand(len(start.centers), -1)
    mine = squared < NEARBY
    mine = mine | ~mine.any(dim=1, keepdim=True)
    near = torch.where(mine, any_mode, -torch.inf).log_softmax(dim=1)
    return torch.logaddexp(near + math.log(STAYING), any_mode + math.log1p(-STAYING))


def placed_by_all(trace: Trace, actions: Sequence[View | ProbeWindow]) -> Modes:
    """Where images' fits and touches place the part, whatever the particles hold."""
    scene = trace.args[0]
    if len(actions) not in scene.placed:
        known = placed_by_images(scene, actions)
        center, precision = known.center[0], known.precision[0]
        if any(isinstance(action, ProbeWindow) for action in actions):
            told = told_by_touches(scene, actions, trace.observations)
            scene.placed[len(actions)] = told.given(center, precision)
        else:
            alone = torch.zeros(1, dtype=torch.float64)
            scene.placed[len(actions)] = Modes(center[None], torch.linalg.inv(precision)[None], alone)
    return scene.placed[len(actions)]


def carried_along(
    trace: Trace, actions: Sequence[View | ProbeWindow], proposed: Any, same: float = ARRIVING
) -> None:
    """The part from a proposal, and where cameras see it to match, each as likely there as it was before.

    Touches move the part by more than a camera's error; what its image leaves open has to come along.

    Args:
        trace: of the particles as they are.
        actions: of which the cameras are.
        proposed: distribution of the part.
        same: correlation of a camera's standardised deviation, from what fits there, with that before.
    """
    scene = trace.args[0]
    part, done = pyro.sample("part", proposed), set[str]()
    for k, action in enumerate(actions):
        if not isinstance(action, View) or f"depth_{k}" not in scene.fits:
            continue
        name = action.camera.instrument
        if name in done:
            continue
        done.add(name)
        bias, fit = trace[f"bias_{name}"], scene.fits[f"depth_{k}"]
        seen, camera = seen_with(scene, fit, bias), scene.looks[action.camera.name].camera
        old, new = (product(seen, seen_from(scene, camera, there, bias)) for there in (trace["part"], part))
        away = poses.local(old.center, trace[f"seen_by_{name}"])
        center = poses.retract(new.center, same * away)
        pyro.sample(f"seen_by_{name}", NormalPose(center, (1.0 - same**2) * new.covariance))


def seen_with(scene: Scene, fit: FittedNormal, bias: Tensor) -> NormalPose:
    """Where an image alone says that its camera sees the part, given the camera's bias (N,)."""
    own, both = fit.covariance[6, 6], fit.covariance[:6, 6]
    off = fit.mean[:6] + (bias - fit.mean[6])[:, None] * both / own
    covariance = fit.covariance[:6, :6] - torch.outer(both, both) / own
    return NormalPose(poses.retract(scene.prior.center, off), covariance)


def seen_from(scene: Scene, camera: Camera, part: Tensor, bias: Tensor) -> NormalPose:
    """Where a camera with a bias (N,) may see a part at poses (N, 7)."""
    settings = scene.settings
    error = apparent_covariance(camera, part, settings.camera_shift, settings.camera_turn)
    return NormalPose(farther(camera, part, bias), error)


def seen_before(trace: Trace, view: Camera, bias: Tensor) -> NormalPose | None:
    """Where a camera with a bias (N,) should see the part, after all before; None where nothing is known."""
    scene, actions = trace.args
    before = part_given(trace, actions[:-1])
    if before is scene.prior:
        return None
    if isinstance(before, MixturePose):
        before = matched(before)
    seen = seen_from(scene, scene.looks[view.name].camera, before.center, bias)
    return NormalPose(seen.center, before.covariance + seen.covariance)


def seen_in(scene: Scene, view: Camera, address: str, image: Tensor) -> FittedNormal:
    """What an image alone says of where its camera sees the part, and of its bias."""
    if address not in scene.fits:
        camera, prior = scene.looks[view.name].camera, scene.prior

        def log_density(point: Tensor) -> Tensor:
            seen, bias = poses.retract(prior.center, point[:, :6]), point[:, 6]
            image_here = image_of(scene, camera, farther(camera, seen, -bias), bias).log_prob(image)
            return torch.where(allowed(prior, seen), image_here, -torch.inf)

        spread = normal_like(prior).covariance.diagonal().sqrt()
        bias = torch.tensor([scene.settings.bias], dtype=torch.float64)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)  # a scene that is used again gives the same beliefs
            scene.fits[address] = fitted_normal(log_density, torch.cat([spread, bias]), SHARPEST)
    return scene.fits[address]


def part_anew(trace: Trace) -> None:
    """A proposal: the part from nearly its conditional, given touches and where the cameras see it."""
    pyro.sample("part", part_given(trace, trace.args[1]))


def all_along(trace: Trace) -> None:
    """A proposal: the part walks as far as all is unsure of it, and where cameras see it comes along."""
    actions = trace.args[1]
    size = torch.exp(pyro.sample("walk", dist.Uniform(*WALK)))
    placed = placed_by_all(trace, actions)
    covariance = placed.covariances[placed.own(trace["part"])]
    step = (2.38 * size) ** 2 / 6.0
    carried_along(trace, actions, NormalPose(trace["part"], step[:, None, None] * covariance), WALKING)
