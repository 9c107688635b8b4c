"""Depth images and a belief: where the part would be seen, and how far measured depth is from that.

    figure = Figure()
    outlines_on_depth(figure.add_subplot(), view, image, part, belief.mean, belief.world_from_part[:9])

Both draw into axes that they are given.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from bcppl.arrays import Array
from bcppl.figures.palette import PARTICLE, STRONG, TRUTH
from bcppl.geometry.parts import Part
from bcppl.rendering.part_renderer import PartRenderer
from bcppl.rendering.rasterisation import renderer_for
from bcppl.sensors import DepthImage, View
from bcppl.untrusted.visible_text import in_figure

LARGEST = 10.0  # mm of a residual that the colours tell apart


def outlines_on_depth(
    axes: Axes,
    view: View,
    image: DepthImage,
    part: Part | PartRenderer,
    mean: Array,
    particles: Sequence[Array] | Array = (),
    truth: Array | None = None,
) -> Axes:
    """Measured depth, with the outline of the part at a belief's mean, at particles and at the truth.

    A camera whose pose is inverted, or looks backwards, shows at once: the outline is not where the part is.

    Args:
        axes: in which it is drawn.
        view: the camera, where its owner states it to be.
        image: what it measured.
        part: the part, or its renderer.
        mean: (7,) world_from_part.
        particles: (K, 7) of a few particles.
        truth: (7,) where known.
    """
    depth = np.where(np.isfinite(image.depth), image.depth, np.nan)
    known = depth[np.isfinite(depth)]
    low, high = np.percentile(known, [1.0, 99.0]) if len(known) else (0.0, 1.0)
    shown = axes.imshow(depth, cmap="Greys", vmin=low, vmax=high + 1e-6)
    axes.figure.colorbar(shown, ax=axes, label="depth (m)", shrink=0.8)
    drawn = [(pose, PARTICLE, 0.8) for pose in particles] + [(mean, STRONG, 1.6)]
    drawn += [] if truth is None else [(truth, TRUTH, 1.2)]
    renderer = part if isinstance(part, PartRenderer) else renderer_for(part)
    rendered = renderer.images(view.camera, np.stack([np.asarray(pose) for pose, _, _ in drawn]))
    for each, (_, colour, width) in zip(rendered, drawn, strict=True):
        if np.isfinite(each).any():
            axes.contour(np.isfinite(each), [0.5], colors=colour, linewidths=width)
    return _titled(axes, view, "nothing of the part in view" if not np.isfinite(rendered[-1]).any() else "")


def depth_residual(axes: Axes, view: View, image: DepthImage, part: Part | PartRenderer, pose: Array) -> Axes:
    """Measured minus rendered depth, mm, where the part at a pose (7,) is seen; other arguments as above.

    Blue is nearer than rendered, red is farther. An error of the stated camera shows as a slope.
    """
    renderer = part if isinstance(part, PartRenderer) else renderer_for(part)
    rendered = renderer.images(view.camera, np.asarray(pose)[None])[0]
    off = 1e3 * np.where(np.isfinite(rendered), image.depth - rendered, np.nan)
    shown = axes.imshow(off, cmap="RdBu_r", vmin=-LARGEST, vmax=LARGEST)
    axes.figure.colorbar(shown, ax=axes, label="measured - rendered (mm)", shrink=0.8, extend="both")
    rows, columns = np.nonzero(np.isfinite(rendered))
    if len(rows):
        axes.set_xlim(columns.min() - 5, columns.max() + 5)
        axes.set_ylim(rows.max() + 5, rows.min() - 5)
    middle = np.nanmedian(off) if np.isfinite(off).any() else np.nan
    return _titled(axes, view, f"median {middle:.1f} mm" if np.isfinite(middle) else "no pixel in common")


def _titled(axes: Axes, view: View, more: str) -> Axes:
    axes.set_title(", ".join(filter(None, [in_figure(view.camera.name), more])), fontsize=9)
    axes.set_xlabel("column (pixel)", fontsize=8)
    axes.set_ylabel("row (pixel)", fontsize=8)
    axes.tick_params(labelsize=7)
    return axes
