"""A part is seen by depth cameras that are not quite where they say, then felt with a peg.

The pose of the part is drawn from the prior; each camera's error and the bias of its range as in
`bcppl.models.camera_error`. A touch is explained by where the peg got to: robots know that to hundredths of a
millimetre. Where the wrench says that the peg felt the part it has no gap to it, elsewhere it has one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl.contact.god_object import GodObject
from bcppl.contact.sensing.felt import accelerations
from bcppl.contact.touch import Touch
from bcppl.contact.wrench import Sensing
from bcppl.distributions.poses import NormalPose, prior_from_guess
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera, bin_depth
from bcppl.geometry.gap import PegGap
from bcppl.models.camera_error import Look, farther
from bcppl.models.look_and_touch_proposals import all_along, left_out, part_anew, taken_in
from bcppl.models.look_and_touch_scene import Scene, Settings, image_of, touch_of
from bcppl.rendering.region import region_of
from bcppl.rendering.renderer import DepthRenderer
from bcppl.rendering.stated_cameras import apparent_covariance, seen_elsewhere
from bcppl.robot.motion import ProbeWindow
from bcppl.sensors import DepthImage, Measurement, Recording, View
from bcppl.traces import Model


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
    proposals=(part_anew, all_along),
    arrival=(taken_in, left_out),
)
