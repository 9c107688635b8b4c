"""What depth images by one camera, which errs, tell together about a part's pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from bcppl.geometry.camera import Camera
from bcppl.rendering.information import pixel_information
from bcppl.rendering.part_renderer import PartRenderer
from bcppl.sensors.likelihoods.camera_settings import CameraSettings
from bcppl.sensors.likelihoods.viewpoints import InstrumentError, place_of


def information_of_images(
    renderer: PartRenderer,
    cameras: Sequence[Camera],
    part: Tensor,
    settings: CameraSettings,
    error: InstrumentError,
    valid: Callable[[Camera], int],
) -> Tensor:
    """The information (N, 6, 6) of images about a part at poses (N, 7); range bias and errors integrated out.

    `cameras` are the viewpoints of one instrument, one for each image; `error` is that of its pose, and
    `valid` the number of pixels of an image that count.
    """
    if not cameras:
        return torch.zeros(len(part), 6, 6, dtype=torch.float64)
    places = {place_of(camera): camera for camera in cameras}
    count = len(places)
    seen = torch.zeros(len(part), 6 * count, 6 * count, dtype=torch.float64)
    both = torch.zeros(len(part), 6 * count, count, dtype=torch.float64)
    own = torch.linalg.inv(settings.bias_covariance(count)).repeat(len(part), 1, 1)
    for camera in cameras:
        place = list(places).index(place_of(camera))
        rows = slice(6 * place, 6 * place + 6)
        pixels = settings.pixel_weight(valid(camera)) * pixel_information(
            renderer, camera, part, settings.bins
        )
        seen[:, rows, rows] += pixels[:, :6, :6]
        both[:, rows, place] += pixels[:, :6, 6]
        own[:, place, place] += pixels[:, 6, 6]
    seen = seen - both @ torch.linalg.solve(own, both.transpose(-1, -2))
    covariance = error.covariance(list(places.values()), part)
    # (seen^-1 + covariance)^-1, also where an image leaves an axis open.
    left = torch.linalg.solve(torch.eye(6 * count, dtype=torch.float64) + seen @ covariance, seen)
    left = left.unflatten(1, (-1, 6)).sum(dim=1).unflatten(2, (-1, 6)).sum(dim=2)
    return 0.5 * (left + left.transpose(-1, -2))
