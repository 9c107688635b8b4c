"""A camera finds where it stands from depth images of the arm itself: calibration without a target.

The camera's pose in the arm's base frame is drawn from the prior, and what the sensor adds to every range.
Each view is a depth image of the arm at other joint angles: its links are drawn where its joints put them.
No mask is needed: what stands still behind the arm (table, floor, room) is what the other views show there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pyro
import pyro.distributions as dist
import torch
import trimesh
from torch import Tensor

from bcppl import poses
from bcppl.distributions.depth import RobustDepth
from bcppl.distributions.poses import NormalPose
from bcppl.errors import InputError
from bcppl.parts import Part
from bcppl.simulators.camera import Camera, bin_depth
from bcppl.simulators.effort import Effort
from bcppl.simulators.renderer import DepthRenderer
from bcppl.simulators.robot import Robot
from bcppl.traces import Trace

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Settings:
    """What is known of the camera.

    Attributes:
        scale: of the Laplace noise, metres: stereo smears shapes of a centimetre.
        outlier: the probability that a pixel on the arm shows something else.
        bias: standard deviation of what the sensor adds to every range, metres.
        widening: how far the arm seems to reach beyond its outline, metres. A stereo sensor matches windows,
            and the nearer surface wins half a window: 4 pixels are 5.5 mm at 1.25 m. Without it the arm looks
            too near, the more so the sharper the likelihood.
        effective_pixels: how many independent pixels a whole image is worth, those beside the arm included.
        bins: so many pixels in each direction are read as one, the median of them.
    """

    scale: float = 0.02
    outlier: float = 0.1
    bias: float = 0.005
    widening: float = 0.0055
    effective_pixels: float | None = 200.0
    bins: int = 8


@dataclass(frozen=True, eq=False)
class Scene:
    """What stays the same over a run.

    Attributes:
        camera: its optics, binned; its stated pose is not used.
        prior: over `base_from_camera`.
        renderers: of the arm at each view's joint angles, one rigid part each.
        backgrounds: (H, W) metres, what stands behind the arm in each view, NaN where unknown.
        settings: of the likelihood.
    """

    camera: Camera
    prior: Any
    renderers: Sequence[DepthRenderer]
    backgrounds: Sequence[Array]
    settings: Settings

    @property
    def efforts(self) -> Mapping[str, Effort]:
        """What each simulator has done so far."""
        return {f"rendering {k}": renderer.effort for k, renderer in enumerate(self.renderers)}


def arm_in_view(scene: Scene, views: int) -> None:
    """The program: where the camera stands, its bias, and a depth image for each of the first views."""
    settings = scene.settings
    camera = pyro.sample("camera", scene.prior)
    bias = pyro.sample("bias", dist.Normal(torch.zeros(()).double(), settings.bias))
    camera_from_base = poses.inverse(camera)
    for k, (renderer, behind) in enumerate(zip(scene.renderers[:views], scene.backgrounds, strict=False)):
        depth = RobustDepth(
            renderer,
            scene.camera,
            camera_from_base,
            scale=settings.scale,
            outlier=settings.outlier,
            effective_pixels=settings.effective_pixels,
            background=behind,
            background_is_measured=True,
            bias=bias + settings.widening,  # the drawn surface is nearer by that much
        )
        pyro.sample(f"depth_{k}", depth)


def prepare(
    robot: Robot,
    camera: Camera,
    prior: Any,
    angles: Sequence[Array],
    images: Sequence[Array],
    **settings: Any,
) -> Scene:
    """The scene of some views by a camera that stands still.

    Args:
        robot: the arm; its meshes are needed.
        camera: its optics.
        prior: over `base_from_camera`, such as `prior_from_guess` gives.
        angles: (J,) joint angles of each view, radians.
        images: (H, W) depth image of each view, metres, NaN or 0 where missing.
        settings: fields of `Settings`.

    Raises:
        InputError: as `Robot.drawn`, or there is not one image for each view.
    """
    if len(images) != len(angles):
        raise InputError(
            f"{len(angles)} views of the arm are given {len(images)} depth images; give one for each."
        )
    chosen = Settings(**settings)
    still = replace(camera, world_from_camera=poses.identity().numpy())
    renderers = [DepthRenderer(widened(robot.drawn(q), chosen.widening)) for q in angles]
    binned = _binned(images, still, chosen.bins)
    backgrounds = [still_behind(binned, view) for view in range(len(binned))]
    return Scene(still.binned(chosen.bins), prior, renderers, backgrounds, chosen)


def _binned(images: Sequence[Array], camera: Camera, bins: int) -> list[Array]:
    return [bin_depth(image, bins, near=camera.near, far=camera.far) for image in images]


def still_behind(images: Sequence[Array], view: int) -> Array:
    """What stands behind the arm in a view, (H, W) metres, NaN where unknown.

    The second farthest reading of the other views: the arm may hide it in some of them, and the farthest is
    often a reading that is wrong. Of two views it is the farther. The view itself has no say.
    """
    others = np.stack(
        [image for k, image in enumerate(images) if k != view] or [np.full_like(images[0], np.nan)]
    )
    farthest = np.sort(np.where(others > 0.0, others, -np.inf), axis=0)[::-1]
    second = farthest[min(1, len(others) - 1)]
    found = np.where(np.isfinite(second), second, farthest[0])
    return np.where(np.isfinite(found), found, np.nan)


def widened(part: Part, by: float) -> Part:
    """The part with every vertex moved outwards along its normal, metres."""
    mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
    mesh.merge_vertices()  # or faces would part at their edges
    vertices = np.asarray(mesh.vertices + by * mesh.vertex_normals, dtype=np.float64)
    return replace(part, vertices=vertices, faces=np.asarray(mesh.faces, dtype=np.int64))


def observations(scene: Scene, images: Sequence[Array]) -> Mapping[str, Tensor]:
    """The depth images (H, W) of the views, metres, NaN or 0 where missing, by address."""
    binned = _binned(images, scene.camera, scene.settings.bins)
    return {f"depth_{k}": torch.from_numpy(image) for k, image in enumerate(binned)}


def along_the_view(trace: Trace) -> None:
    """A proposal: the sensor reads farther and the camera stands nearer, or the other way round.

    The two are hardly told apart, so that neither moves far alone.
    """
    bias = pyro.sample("bias", dist.Normal(trace["bias"], 0.005))
    camera = trace["camera"]
    forward = poses.rotation_matrix(camera)[..., 2]
    moved = camera[..., :3] + forward * (bias - trace["bias"])[..., None]
    around = torch.tensor([0.0005] * 6, dtype=torch.float64)
    pyro.sample("camera", NormalPose(torch.cat([moved, camera[..., 3:]], dim=-1), around))
