"""A camera's extrinsics from depth images of the arm itself: hand-eye calibration without a target.

The camera's pose in the arm's base frame and its range bias are drawn from the prior. Each view is a depth
image of the arm at other joint angles, with its links rendered by the forward kinematics. No mask is needed:
the static background (table, floor, room) is estimated from the other views. Masks of the arm by a
segmentation are measurements too: they inform the outline, and the depth image the distance within it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pyro
import pyro.distributions as dist
import torch
import trimesh
from scipy.ndimage import binary_erosion
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array
from bcppl.distributions.depth import RobustDepth
from bcppl.distributions.fitted import fitted_normal
from bcppl.distributions.parameters import (
    COUNT,
    IF_GIVEN,
    NONNEGATIVE,
    POSITIVE,
    PROBABILITY,
    check_parameters,
    within,
)
from bcppl.distributions.pose_normals import normal_like, truncated
from bcppl.distributions.poses import NormalPose
from bcppl.distributions.silhouette import Silhouette, binned_mask
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera, bin_depth
from bcppl.geometry.parts import Part
from bcppl.rendering.ray_casting import RayCaster
from bcppl.robot.kinematics import Robot
from bcppl.sensors.scene import chosen as chosen_settings

WIDER = 1.3  # than the fit: of the proposal
# Smallest standard deviations of the fit: metres, radians, metres of bias, pixels of rim.
SHARPEST = torch.tensor([5e-4] * 3 + [5e-4] * 3 + [5e-4, 0.05], dtype=torch.float64)


@dataclass(frozen=True)
class Settings:
    """Parameters of the likelihoods.

    Attributes:
        scale: of the Laplace noise, metres: stereo smooths shapes of a centimetre.
        outlier: the probability that a pixel on the arm shows something else.
        bias: standard deviation of the range bias, metres.
        widening: of the arm's outline in images, metres. A stereo sensor matches windows, and the nearer
            surface covers half a window: 4 pixels are 5.5 mm at 1.25 m. Without it the arm is estimated too
            near, the more so the more precise the likelihood.
        effective_pixels: the number of independent pixels of a whole image, those beside the arm included.
        effective_inside: the same of an image with a mask, of which only the inside counts.
        bins: pixels in each direction of a block, which is represented by its median.
        mask_width: standard deviation of the outline of a mask, pixels of the whole image.
        mask_rim: standard deviation of the common displacement of masks' outlines, pixels.
        mask_wrong: the probability that a pixel of a mask is wrong.
        mask_temperature: divisor of the masks' log-likelihood: a segmentation errs in whole patches, and the
            arm differs from its drawing.
        inside: distance from a mask's outline at which depth begins to count, pixels: matching windows do
            not cross it there.
    """

    scale: float = field(default=0.02, metadata=POSITIVE)
    outlier: float = field(default=0.1, metadata=PROBABILITY)
    bias: float = field(default=0.005, metadata=POSITIVE)
    widening: float = field(default=0.0055, metadata=NONNEGATIVE)
    effective_pixels: float | None = field(default=200.0, metadata=IF_GIVEN)
    effective_inside: float | None = field(default=10.0, metadata=IF_GIVEN)
    bins: int = field(default=8, metadata=COUNT)
    mask_width: float = field(default=8.0, metadata=POSITIVE)
    mask_rim: float = field(default=1.5, metadata=POSITIVE)
    mask_wrong: float = field(default=0.05, metadata=PROBABILITY)
    mask_temperature: float = field(default=32.0, metadata=POSITIVE)
    inside: int = field(default=5, metadata=within(least=0, whole=True))

    def __post_init__(self) -> None:
        check_parameters(self)


@dataclass(frozen=True, eq=False)
class Scene:
    """The scene of the views.

    Attributes:
        camera: its optics, binned; its stated pose is not used.
        prior: over `base_from_camera`.
        renderers: of the arm at each view's joint angles, one rigid part each.
        backgrounds: (H, W) depth of the background in each view, metres, NaN where unknown.
        insides: (H, W) the pixels whose depth counts in each view; None without masks.
        settings: of the likelihood.
    """

    camera: Camera
    prior: Any
    renderers: Sequence[RayCaster]
    backgrounds: Sequence[Array]
    insides: Sequence[npt.NDArray[np.bool_]] | None
    settings: Settings

    @property
    def efforts(self) -> Mapping[str, Effort]:
        """The effort of each simulator so far."""
        return {f"rendering {k}": renderer.effort for k, renderer in enumerate(self.renderers)}


def arm_in_view(scene: Scene, views: int) -> None:
    """The program: the camera's pose, its bias, the masks' rim, and the images of the first views."""
    settings = scene.settings
    camera = pyro.sample("camera", scene.prior)
    bias = pyro.sample("bias", dist.Normal(torch.zeros(()).double(), settings.bias))
    rim = None
    if scene.insides is not None:
        rim = pyro.sample("rim", dist.Normal(torch.zeros(()).double(), settings.mask_rim))
    for address, site in sites(scene, views, camera, bias, rim).items():
        pyro.sample(address, site)


def sites(scene: Scene, views: int, camera: Tensor, bias: Tensor, rim: Tensor | None) -> dict[str, Any]:
    """The likelihoods of the first views' images, by address, of cameras at poses (N, 7)."""
    settings, camera_from_base = scene.settings, poses.inverse(camera)
    likelihoods: dict[str, Any] = {}
    for k, (renderer, behind) in enumerate(zip(scene.renderers[:views], scene.backgrounds, strict=False)):
        depth = likelihoods[f"depth_{k}"] = RobustDepth(
            renderer,
            scene.camera,
            camera_from_base,
            scale=settings.scale,
            outlier=settings.outlier,
            effective_pixels=settings.effective_pixels
            if scene.insides is None
            else settings.effective_inside,
            region=None if scene.insides is None else scene.insides[k],
            background=behind if scene.insides is None else None,
            background_is_measured=scene.insides is None,
            # The widened surface is nearer by the widening.
            bias=bias + (settings.widening if scene.insides is None else 0.0),
        )
        if rim is not None:
            likelihoods[f"mask_{k}"] = Silhouette.from_depth(
                depth,
                settings.mask_width / settings.bins,
                settings.mask_wrong,
                rim=rim / settings.bins,
                temperature=settings.mask_temperature,
            )
    return likelihoods


def prepare(
    robot: Robot,
    camera: Camera,
    prior: Any,
    angles: Sequence[Array],
    images: Sequence[Array],
    masks: Sequence[npt.ArrayLike] | None = None,
    **settings: Any,
) -> Scene:
    """The scene of some views by a static camera.

    Args:
        robot: the arm; its meshes are needed.
        camera: its optics.
        prior: over `base_from_camera`, such as `prior_from_guess` gives.
        angles: (J,) joint angles of each view, radians.
        images: (H, W) depth image of each view, metres, NaN or 0 where missing.
        masks: (H, W) the pixels that show the arm in each view, 0 elsewhere; None without masks.
        settings: fields of `Settings`.

    Raises:
        InputError: as `Robot.as_part`, a setting is unknown or out of range, or there is not one image, or
            one mask of its size, for each view.
    """
    if len(images) != len(angles):
        raise InputError(f"{len(angles)} views are given {len(images)} depth images; give one for each.")
    (chosen,) = chosen_settings("arm_in_view", settings, Settings())
    still = replace(camera, world_from_camera=poses.identity().numpy())
    small = still.binned(chosen.bins)
    binned = _binned(images, still, chosen.bins)
    backgrounds = [background_of(binned, view) for view in range(len(binned))]
    drawn = [robot.as_part(q) for q in angles]
    if masks is None:
        # Without masks the outline is informed by depth, which widens it.
        renderers = [RayCaster(widened(part, chosen.widening)) for part in drawn]
        return Scene(small, prior, renderers, backgrounds, None, chosen)
    shown = [np.asarray(mask) != 0 for mask in masks]
    if [mask.shape for mask in shown] != [(camera.height, camera.width)] * len(angles):
        raise InputError(
            f"{len(angles)} views are given masks of shapes {[mask.shape for mask in shown]}; give one for "
            f"each, of the image's own pixels {(camera.height, camera.width)}, or none."
        )
    insides = [_inside(mask, chosen) for mask in shown]
    return Scene(small, prior, [RayCaster(part) for part in drawn], backgrounds, insides, chosen)


def _inside(mask: npt.NDArray[np.bool_], settings: Settings) -> npt.NDArray[np.bool_]:
    """The blocks (H, W) that lie within a mask, off its outline."""
    within = binary_erosion(mask, iterations=settings.inside) if settings.inside else mask
    return np.asarray(binned_mask(~within, settings.bins) == 0.0)


def _binned(images: Sequence[Array], camera: Camera, bins: int) -> list[Array]:
    return [bin_depth(image, bins, near=camera.near, far=camera.far) for image in images]


def background_of(images: Sequence[Array], view: int) -> Array:
    """The depth (H, W) of the background in a view, metres, NaN where unknown.

    It is the second farthest reading of the other views: the arm may hide it in some of them, and the
    farthest reading is often wrong. Of two views it is the farther. The view itself is not used.
    """
    others = np.stack(
        [image for k, image in enumerate(images) if k != view] or [np.full_like(images[0], np.nan)]
    )
    farthest = np.sort(np.where(others > 0.0, others, -np.inf), axis=0)[::-1]
    second = farthest[min(1, len(others) - 1)]
    depth = np.where(np.isfinite(second), second, farthest[0])
    return np.where(np.isfinite(depth), depth, np.nan)


def widened(part: Part, by: float) -> Part:
    """The part with every vertex moved outwards along its normal, metres."""
    mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
    mesh.merge_vertices()  # faces would otherwise separate at their edges
    vertices = np.asarray(mesh.vertices + by * mesh.vertex_normals, dtype=np.float64)
    return replace(part, vertices=vertices, faces=np.asarray(mesh.faces, dtype=np.int64))


def observations(
    scene: Scene, images: Sequence[Array], masks: Sequence[npt.ArrayLike] | None = None
) -> Mapping[str, Tensor]:
    """The depth images and masks (H, W) of the views as `prepare` takes them, by address."""
    bins = scene.settings.bins
    seen = {f"depth_{k}": torch.from_numpy(x) for k, x in enumerate(_binned(images, scene.camera, bins))}
    for k, mask in enumerate(() if masks is None else masks):
        seen[f"mask_{k}"] = torch.from_numpy(binned_mask(mask, bins))
    return seen


def fitted_proposal(
    scene: Scene, observed: Mapping[str, Tensor], draws: int = 100
) -> Callable[[Scene, int], None]:
    """A proposal of the latent values: a normal that is fitted to the likelihood of images and masks.

    Camera pose and range bias are strongly correlated: the camera may be lower and look up, or farther away
    with smaller ranges. A random walk mixes slowly along that ridge; a fitted normal has its shape.

    Args:
        scene: of the views.
        observed: the result of `observations`.
        draws: poses that are evaluated in each round of the fit.

    Returns:
        A program `proposal(scene, views)` for `bcppl.inference.importance.importance_sampling`.
    """
    settings, prior = scene.settings, scene.prior
    views = sum(address.startswith("depth_") for address in observed)
    own = [settings.bias] if scene.insides is None else [settings.bias, settings.mask_rim]
    start = torch.cat([normal_like(prior).covariance.diagonal().sqrt(), torch.tensor(own).double()])

    def log_density(point: Tensor) -> Tensor:
        camera = poses.retract(prior.center, point[:, :6].contiguous())
        likelihoods = sites(scene, views, camera, point[:, 6], point[:, 7] if len(own) > 1 else None)
        log_prob = torch.stack([likelihoods[a].log_prob(value) for a, value in observed.items()])
        return torch.where(prior.log_prob(camera) > -torch.inf, log_prob.sum(dim=0), -torch.inf)

    fit = fitted_normal(log_density, start, SHARPEST[: len(start)], draws=draws, first=3 * draws)
    mean, covariance = fit.mean, fit.covariance

    def proposal(scene: Scene, views: int) -> None:
        away = mean.new_zeros(0)
        for k, address in enumerate(["bias", "rim"][: len(own)]):
            # Each conditional on those before it.
            before, at = slice(6, 6 + k), 6 + k
            gain = torch.linalg.solve(covariance[before, before], covariance[before, at])
            spread = (covariance[at, at] - gain @ covariance[before, at]).sqrt()
            value = pyro.sample(address, dist.Normal(mean[at] + (away @ gain if k else 0.0), WIDER * spread))
            step = (value - mean[at])[..., None]
            away = torch.cat([away, step], dim=-1) if k else step
        gain = torch.linalg.solve(covariance[6:, 6:], covariance[6:, :6])
        left = covariance[:6, :6] - gain.T @ covariance[6:, :6]
        center = poses.retract(prior.center, mean[:6] + away @ gain)
        spread = WIDER**2 * (0.5 * (left + left.T)).expand(len(center), 6, 6)
        pyro.sample("camera", truncated(prior, NormalPose(center, spread)))

    return proposal
