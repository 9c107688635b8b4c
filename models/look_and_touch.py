"""A part is seen by depth cameras that are not quite where they say, then felt with a peg.

The pose of the part is drawn from the prior; each camera's error and the bias of its range as in
`bcppl.models.camera_error`. A touch is explained by where the peg got to: robots know that to hundredths of a
millimetre. Where the wrench says that the peg felt the part it has no gap to it, elsewhere it has one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arguments import number_within, whole_number
from bcppl.distributions.depth import RobustDepth
from bcppl.distributions.fitted import FittedNormal, fitted_normal
from bcppl.distributions.manifold import ContactManifold, MeasuresGap
from bcppl.distributions.manifold_fit import Normal, Told, Window, told_by
from bcppl.distributions.mixture import MixturePose
from bcppl.distributions.pose_normals import allowed, normal_like, product, widened, within
from bcppl.distributions.poses import NormalPose, prior_from_guess
from bcppl.errors import InputError
from bcppl.models import camera_error
from bcppl.models.camera_error import Look, farther
from bcppl.recordings.measurements import DepthImage, Measurement, ProbeWindow, Recording, Touch, View
from bcppl.simulators.camera import Camera, bin_depth
from bcppl.simulators.effort import Effort
from bcppl.simulators.gap import PegGap
from bcppl.simulators.god_object import GodObject, WindowMotion
from bcppl.simulators.region import region_of
from bcppl.simulators.renderer import DepthRenderer
from bcppl.simulators.sensing.felt import Felt, accelerations
from bcppl.simulators.stated_cameras import apparent_covariance, seen_elsewhere
from bcppl.simulators.wrench import Sensing
from bcppl.traces import Model, Trace

# What an image says is taken for no surer than this: metres, radians, metres of bias.
SHARPEST = torch.tensor([5e-5] * 3 + [1e-3] * 3 + [1e-4], dtype=torch.float64)
NEAR = 0.02  # m: a window in which the peg stays farther off says nothing


@dataclass(frozen=True)
class Settings(camera_error.Settings):
    """What is known of the cameras (`camera_error.Settings`) and of the arm.

    Attributes:
        temperature: how much less a pixel is worth than it seems; the errors hold what all have in common.
        gap_noise: m, of where the peg's surface is at one stamp.
        gap_shared: m, common to all stamps of a window: stiffness and geometry are known to so much.
        sink: m that the peg sinks into the part at the forces of a probe.
        gap_outlier: the probability that a stamp, or a window's contacts, are something else.
        every: so many stamps apart the peg's pose counts.
        felt: from which force on there is a contact.
        free_space: whether it counts that the part is not where the peg moved freely.
    """

    bins: int = 1
    temperature: float = 6.0
    gap_noise: float = 0.00007
    gap_shared: float = 0.00003
    sink: float = 0.00002
    gap_outlier: float = 0.001
    every: int = 5
    felt: Felt = field(default_factory=Felt)
    free_space: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        number_within("look_and_touch is given gap_noise {}", self.gap_noise, above=0.0)
        whole_number("look_and_touch is given every {}", self.every)


@dataclass(frozen=True, eq=False)
class Scene:
    """What stays the same over a run: the prior, the renderer, and what is looked at, by camera.

    Attributes:
        fits: by address, what an image alone says of where its camera sees the part, in the tangent space at
            the guess, and of the camera's bias.
        near: by address, whether a window's peg came near where images place the part.
        told: by the number of actions, what all of their touches say to second order.
    """

    prior: Any
    renderer: DepthRenderer
    looks: Mapping[str, Look]
    gap: PegGap | None
    proxy: GodObject | None
    sensing: Sensing | None
    settings: Settings
    fits: dict[str, FittedNormal] = field(default_factory=dict)
    told: dict[int, Told] = field(default_factory=dict)
    near: dict[str, bool] = field(default_factory=dict)

    @property
    def efforts(self) -> Mapping[str, Effort]:
        """What each simulator has done so far."""
        efforts = {"rendering": self.renderer.effort}
        return efforts if self.gap is None else {**efforts, "gap": self.gap.effort}


def look_and_touch(scene: Scene, actions: Sequence[View | ProbeWindow]) -> None:
    """The program: the part, each camera's bias, where it sees the part, images, and where the peg got to."""
    settings = scene.settings
    part = pyro.sample("part", scene.prior)
    known: dict[str, tuple[Camera, Tensor, Tensor]] = {}
    for k, action in enumerate(actions):
        if isinstance(action, View):
            name, camera = action.camera.instrument, scene.looks[action.camera.name].camera
            if name not in known:  # one error for all views of one camera, also of one on a wrist
                bias = pyro.sample(
                    f"bias_{name}", dist.Normal(torch.zeros((), dtype=torch.float64), settings.bias)
                )
                covariance = apparent_covariance(camera, part, settings.camera_shift, settings.camera_turn)
                seen = pyro.sample(f"seen_by_{name}", NormalPose(farther(camera, part, bias), covariance))
                known[name] = camera, farther(camera, seen, -bias), bias
            first, there, bias = known[name]
            if camera.name != first.name:
                there = seen_elsewhere(first, camera, part, there)
            pyro.sample(f"depth_{k}", image_of(scene, camera, there, bias))
        else:
            assert scene.gap is not None
            pyro.sample(f"touch_{k}", touch_of(scene, action, part))


def image_of(scene: Scene, camera: Camera, there: Tensor, bias: Tensor | float) -> RobustDepth:
    """What a camera with a bias (N,) makes of a part at `there` (N, 7), taken by its word."""
    settings = scene.settings
    return RobustDepth(
        scene.renderer,
        camera,
        there,
        scale=settings.scale,
        outlier=settings.outlier,
        temperature=settings.temperature,
        bias=bias,
    )


def touch_of(
    scene: Scene, window: ProbeWindow, part: Tensor, blur: float = 0.0, gap: MeasuresGap | None = None
) -> ContactManifold:
    """What a window says of parts at poses (N, 7), or would with errors `blur` metres wider."""
    settings, measures = scene.settings, scene.gap if gap is None else gap
    assert measures is not None
    return ContactManifold(
        measures,
        part,
        len(range(window.first, window.last, settings.every)),
        math.hypot(settings.gap_noise, blur),
        math.hypot(settings.gap_shared, blur),
        settings.sink,
        settings.gap_outlier,
        None if scene.proxy is None else WindowMotion(scene.proxy, window, settings.every),
    )


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
    else:
        center, precision = seen.center, torch.linalg.inv(seen.covariance)
    covariance = torch.linalg.inv(precision + told.information)
    pull = (precision @ poses.local(told.around, center)[..., None])[..., 0] - told.slope
    pose = poses.retract(told.around, (covariance @ pull[..., None])[..., 0])
    return widened(pose, 0.5 * (covariance + covariance.transpose(-1, -2)))


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
    before = None if latest is None else scene.told[latest].around[None]
    scene.told[len(actions)] = told_by(scene.gap, windows, known, before)
    return scene.told[len(actions)]


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
    """The way there: what comes with the newest measurement, and the part to match (see `Model.arrival`)."""
    scene, actions = trace.args
    newest, k = actions[-1], len(actions) - 1
    values: dict[str, Tensor] = {}
    if isinstance(newest, View):
        name = newest.camera.instrument
        if f"seen_by_{name}" not in trace:
            fit = seen_in(scene, newest.camera, f"depth_{k}", trace.observations[f"depth_{k}"])
            own, both = fit.covariance[6, 6], fit.covariance[:6, 6]
            bias = pyro.sample(f"bias_{name}", dist.Normal(fit.mean[6], 1.3 * own.sqrt()))
            center = poses.retract(
                scene.prior.center, fit.mean[:6] + (bias - fit.mean[6])[:, None] * both / own
            )
            seen = NormalPose(center, fit.covariance[:6, :6] - torch.outer(both, both) / own)
            expected = seen_before(trace, newest.camera, bias)
            values[f"bias_{name}"] = bias
            around = seen if expected is None else product(seen, expected)
            values[f"seen_by_{name}"] = pyro.sample(
                f"seen_by_{name}", widened(around.center, around.covariance.expand(len(bias), 6, 6))
            )
    pyro.sample("part", part_given(trace, actions, values))


def seen_before(trace: Trace, view: Camera, bias: Tensor) -> NormalPose | None:
    """Where a camera with a bias (N,) should see the part, after all before; None where nothing is known."""
    scene, actions = trace.args
    before = part_given(trace, actions[:-1])
    if before is scene.prior:
        return None
    settings, camera = scene.settings, scene.looks[view.name].camera
    if isinstance(before, MixturePose):
        center, covariance = before.components.center[:, 0], before.components.covariance[:, 0]
    else:
        center, covariance = before.center, before.covariance
    error = apparent_covariance(camera, center, settings.camera_shift, settings.camera_turn)
    return NormalPose(farther(camera, center, bias), covariance + error)


def left_out(trace: Trace) -> None:
    """The way back: the part as it was likely to be before the newest measurement."""
    pyro.sample("part", part_given(trace, trace.args[1][:-1]))


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


def prepare(recording: Recording, **settings: Any) -> Scene:
    """The scene of a recording; `settings` are fields of `Settings`.

    Raises:
        InputError: a spread is not positive, a camera cannot see the part near its guess, or there are probe
            windows and no peg.
    """
    chosen = Settings(**settings)
    guess = recording.guess
    within = float(np.linalg.norm(guess.translation))
    looks: dict[str, Look] = {}
    windows = []
    for action in (m.action for m in recording.measurements):
        if isinstance(action, ProbeWindow):
            windows.append(action)
        elif isinstance(action, View) and action.camera.name not in looks:
            camera = action.camera
            region = region_of(camera, recording.part, guess.world_from_part, within, chosen.bins)
            looks[camera.name] = Look(region, camera.cropped(*region).binned(chosen.bins))
    gap = proxy = sensing = None
    if recording.peg is not None:
        gap = PegGap(recording.part, recording.peg)
        proxy = GodObject(gap)
    if windows:
        if recording.peg is None:
            raise InputError("the recording has probe windows but no peg; add the peg that was held.")
        sensing = Sensing(recording.peg, rate=1.0 / float(np.median(np.diff(windows[0].probe.stamps))))
    renderer = DepthRenderer(recording.part)
    return Scene(prior_from_guess(guess), renderer, looks, gap, proxy, sensing, chosen)


def observe(scene: Scene, measurements: Sequence[Measurement]) -> Mapping[str, Tensor]:
    """The depth images; where the peg got to, and whether it felt the part.

    Raises:
        InputError: a measurement is neither a view nor a probe window.
    """
    values: dict[str, Tensor] = {}
    touches: dict[str, list[tuple[int, ProbeWindow, Touch]]] = {}
    for k, measurement in enumerate(measurements):
        action, seen = measurement.action, measurement.observation
        if isinstance(action, View) and isinstance(seen, DepthImage):
            camera = action.camera
            left, top, width, height = scene.looks[camera.name].region
            region = seen.depth[top : top + height, left : left + width]
            binned = bin_depth(region, scene.settings.bins, near=camera.near, far=camera.far)
            values[f"depth_{k}"] = torch.from_numpy(binned)
        elif isinstance(action, ProbeWindow) and isinstance(seen, Touch):
            touches.setdefault(action.probe.name, []).append((k, action, seen))
        else:
            raise InputError(
                f"measurement {k} is a {measurement.kind}, which look_and_touch does not explain; "
                "choose another model."
            )
    for windows in touches.values():
        assert scene.sensing is not None
        tared = scene.sensing.tared([touch for *_, touch in windows])
        asked = accelerations([window for _, window, _ in windows])
        flags = scene.settings.felt(torch.cat(tared)[:, :3], asked)
        if not scene.settings.free_space:
            flags = torch.where(flags == 0.0, torch.nan, flags)
        begin = 0
        for (k, _, touch), wrench in zip(windows, tared, strict=True):
            mine = flags[begin : begin + len(wrench), None]
            begin += len(wrench)
            rows = torch.cat([torch.from_numpy(np.array(touch.world_from_peg)), mine], dim=1)
            values[f"touch_{k}"] = rows[:: scene.settings.every]
    return values


def invent(seed: int, **options: Any) -> Recording:
    """A part on a bench, seen by two cameras and not yet touched: see `bcppl.models.worlds.bench`."""
    from bcppl.models.worlds.bench import bench_scene

    return bench_scene(seed, **options).look()


model = Model(
    program=look_and_touch,
    prepare=prepare,
    observe=observe,
    pose="part",
    invent=invent,
    proposals=(part_anew,),
    arrival=(taken_in, left_out),
)
