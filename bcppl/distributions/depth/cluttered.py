"""A depth image of a part among things that nobody has modelled."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from bcppl.arguments import number_within, whole_number
from bcppl.distributions.depth.observed import Observed
from bcppl.distributions.depth.rendering import Array, Mask, RendersDepth
from bcppl.distributions.depth.robust import RobustDepth
from bcppl.distributions.depth.scanlines import Chances, Line, Lines, draw, gains, read
from bcppl.distributions.lazy import LazyDistribution
from bcppl.errors import InputError

if TYPE_CHECKING:
    from bcppl.geometry.camera import Camera


class _Read(NamedTuple):
    """What an image alone says: a copy of it, with what it was read, its pixels, and its lines' densities."""

    image: Array
    chances: Chances
    spacing: int
    depth: Array
    valid: Mask
    rows: Lines
    columns: Lines
    of_rows: float
    of_columns: float


class ClutteredDepth(LazyDistribution):
    """A depth image in which most is unknown, but goes on from one pixel to the next.

    `RobustDepth` takes the pixels around a part and before it as uniform and independent. Then any smooth
    surface that is large enough explains itself better as the part than as something unknown, and a part of
    which a fifth is in view is found in a table or in a tool beside it. Here what is unknown is smooth too,
    so a part gains by its edges and its shape: where the image jumps and the part does, and where depth
    changes as the part's surface does. And what stands before it may hide it for many pixels at one price.

    Along a line of the image each pixel shows the part or something unknown (a hidden Markov chain, see
    `bcppl.distributions.depth.scanlines`):

    - unknown after unknown: the same depth with a Laplace error of scale `step`, or, with probability `jump`,
      any depth in the sensor's range;
    - unknown after the part: any depth, or with probability `abut` the same: things touch;
    - unknown where the part is rendered: nearer than the part, but for a share `through`. Within `rim` pixels
      of the part's outline it may be farther as well: outlines are off by a pixel or two;
    - the part: Laplace error of the given `scale`, which after a pixel of the part goes on by an
      autoregression, or, with probability `rough`, starts anew.

    The defaults are about what a Kinect's image of a table at 1.1 m shows: jumps at one pixel of a hundred,
    steps of 1.3 mm on average between them, errors on parts in full view of 4 to 6.4 mm with a correlation of
    0.81 to 0.89 from pixel to pixel. `step` is three times as wide: what stands about is not all that flat.

    The log-density is the mean of that of the rows and that of the columns, of every `lines`-th of each. That
    is no density of the image: evidence that contains it is a surrogate's. `sample` draws the rows alone.

    Args:
        renderer: renders one part.
        camera: where the image is taken; its range says which pixels are missing.
        pose: (N, 7) `world_from_part`.
        scale: of the Laplace error of a pixel that shows the part, metres.
        lines: every so many rows and columns are looked at; neighbouring ones tell the same.
        temperature: what the log-likelihood is divided by.
        correlation: of the error from one pixel of the part to the next, from 0 up to below 1.
        rough: the probability that the error starts anew.
        step: of unknown depth from pixel to pixel, metres.
        jump: the probability that a pixel shows another unknown thing than the one before.
        visible: the probability that a part is in view where a line comes upon it.
        switch: the probability at each pixel that something begins or ceases to hide the part.
        enter, leave: the same at each pixel of the rim.
        abut: the probability that what follows on the part touches it.
        through: the share of pixels that look through the part.
        rim: pixels.

    Raises:
        InputError: a shape does not fit, a length is not positive, or a probability not between 0 and 1.
    """

    cost = 1

    def __init__(
        self,
        renderer: RendersDepth,
        camera: Camera,
        pose: Tensor,
        scale: float,
        *,
        lines: int = 4,
        temperature: float = 1.0,
        correlation: float = 0.85,
        rough: float = 0.1,
        step: float = 0.004,
        jump: float = 0.01,
        visible: float = 0.8,
        switch: float = 0.03,
        enter: float = 0.4,
        leave: float = 0.2,
        abut: float = 0.05,
        through: float = 0.02,
        rim: int = 3,
    ) -> None:
        if pose.ndim != 2 or pose.shape[1] != 7:
            raise InputError(
                f"the pose of a depth image has shape {tuple(pose.shape)}; "
                "give (N, 7), one world_from_part per particle."
            )
        if not camera.far > camera.near >= 0.0:
            raise InputError(
                f"camera {camera.name!r} has the range {camera.near} to {camera.far} m; give 0 <= near < far."
            )
        for name, length in (("scale", scale), ("step", step), ("temperature", temperature)):
            number_within(f"a cluttered depth image has the {name} {{}}", length, above=0.0)
        number_within("a cluttered depth image has the correlation {}", correlation, least=0.0, below=1.0)
        shares = {"rough": rough, "jump": jump, "visible": visible, "switch": switch, "enter": enter}
        for name, share in {**shares, "leave": leave, "abut": abut, "through": through}.items():
            number_within(
                f"a cluttered depth image has the probability {name} of {{}}", share, above=0.0, below=1.0
            )
        self.lines = whole_number("a cluttered depth image is looked at in every {}th line", lines)
        rim = whole_number("a cluttered depth image has a rim of {} pixels", rim, least=0)
        super().__init__(len(pose), (camera.height, camera.width))
        self.renderer, self.camera, self.pose = renderer, camera, pose
        self.scale, self.temperature = float(scale), float(temperature)
        wander = self.scale * math.sqrt(1.0 - correlation**2)
        self.chances = Chances(
            camera.near, camera.far, self.scale, correlation, wander, rough, step, jump,
            visible, switch, enter, leave, abut, through, rim,
        )  # fmt: skip

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability (N,) of a depth image (H, W), or of one for each particle (N, H, W).

        Raises:
            InputError: a pose is not finite, or the image has another shape.
        """
        rows, columns = self._of_lines(value)
        return 0.5 * (rows + columns) / self.temperature

    def row_log_prob(self, value: Tensor) -> Tensor:
        """Log-density (N,) of the rows that are looked at, with arguments as for `log_prob`.

        With every row looked at it is a density of the image, the one that `sample` draws from.
        """
        return self._of_lines(value)[0]

    def observed(self, value: Tensor) -> Observed:
        """What an image (H, W), or one for each particle, says without any pose, where the lines cross.

        It is what alignments read (`bcppl.inference.proposals.depth_alignment`), not `log_prob`.

        Raises:
            InputError: the image has another shape.
        """
        crossings = np.zeros(tuple(self.event_shape), dtype=bool)
        crossings[self.lines // 2 :: self.lines, self.lines // 2 :: self.lines] = True
        alone = RobustDepth(self.renderer, self.camera, self.pose, self.scale, outlier=0.05, region=crossings)
        return alone.observed(value)

    def _of_lines(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """Log-densities (N,) of the rows and of the columns."""
        count = self._checked()
        batch = torch.Size([count, *self.event_shape])
        if value.shape not in (self.event_shape, batch):
            raise InputError(
                f"a depth image of camera {self.camera.name!r} has shape {tuple(value.shape)}; "
                f"give {tuple(self.event_shape)}, or {tuple(batch)} for one image per particle."
            )
        each = [self._read(value)] if value.ndim == 2 else [self._read(image) for image in value]
        height, width = self.event_shape
        looked_at = np.zeros((height, width), dtype=bool)
        looked_at[self.lines // 2 :: self.lines] = True
        looked_at[:, self.lines // 2 :: self.lines] = True
        hits = self.renderer.hits(self.camera, self.pose.detach(), looked_at.reshape(-1))
        ends = np.searchsorted(hits.particle, np.arange(count + 1))
        rendered = np.full(height * width, np.inf)
        found = np.empty((count, 2))
        for k in range(count):
            said = each[k % len(each)]
            own = slice(ends[k], ends[k + 1])
            of_rows, of_columns = gains(
                said.depth, said.valid, (height, width), self.lines, hits.pixel[own], hits.depth[own],
                rendered, self.chances, said.rows, said.columns,
            )  # fmt: skip
            found[k] = said.of_rows + of_rows, said.of_columns + of_columns
        return torch.from_numpy(found[:, 0].copy()), torch.from_numpy(found[:, 1].copy())

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """One depth image for each particle, (N, H, W), metres, its rows drawn one after another.

        Errors may push a pixel out of the sensor's range, where `log_prob` takes it for missing.

        Raises:
            InputError: a pose is not finite, or a sample_shape was asked for.
        """
        if torch.Size(sample_shape) != torch.Size():
            raise InputError(
                f"{type(self).__name__} draws one image for each particle; ask for no sample_shape, "
                "or make it with more particles."
            )
        count = self._checked()
        height, width = self.event_shape
        images = self.renderer.images(self.camera, self.pose.detach()).reshape(count, -1)
        drawn = np.empty((count, height * width))
        for k in range(count):
            chance = torch.rand(height * width, 3, dtype=torch.float64).numpy()
            for v in range(height):
                draw(images[k], Line(v * width, 1, width), self.chances, chance, drawn[k])
        return torch.from_numpy(drawn.reshape(count, height, width))

    def _checked(self) -> int:
        """How many particles there are."""
        bad = torch.nonzero(~torch.isfinite(self.pose).all(dim=-1)).flatten().tolist()
        if bad:
            shown = ", ".join(map(str, bad[:10])) + (", ..." if len(bad) > 10 else "")
            raise InputError(
                f"{len(bad)} of {len(self.pose)} particles have a pose that is not finite "
                f"(particles {shown}) and cannot be seen by camera {self.camera.name!r}; "
                "look at what proposed them."
            )
        return len(self.pose)

    def _read(self, value: Tensor) -> _Read:
        """What an image (H, W) says without any pose; kept with it for as long as it holds the same."""
        image = value.detach().numpy()
        kept: _Read | None = KEPT.get(value)
        read_alike = kept is not None and (kept.chances, kept.spacing) == (self.chances, self.lines)
        if kept is not None and read_alike and np.array_equal(kept.image, image, equal_nan=True):
            return kept
        height, width = self.event_shape
        depth = np.array(image, dtype=np.float64).reshape(-1)
        with np.errstate(invalid="ignore"):
            valid = (depth > 0.0) & (depth >= self.camera.near) & (depth <= self.camera.far)
        across = [Line(v * width, 1, width) for v in range(self.lines // 2, height, self.lines)]
        down = [Line(u, width, height) for u in range(self.lines // 2, width, self.lines)]
        rows, columns = (Lines(np.full(depth.shape, np.nan), np.full(depth.shape, np.nan)) for _ in range(2))
        of_rows = math.fsum(read(depth, valid, line, self.chances, rows) for line in across)
        of_columns = math.fsum(read(depth, valid, line, self.chances, columns) for line in down)
        copy: npt.NDArray[Any] = np.array(image)
        said = _Read(copy, self.chances, self.lines, depth, valid, rows, columns, of_rows, of_columns)
        KEPT[value] = said
        return said


# Every run of a program makes its distributions anew, at other poses: what an image says is kept with it.
KEPT: WeakTensorKeyDictionary = WeakTensorKeyDictionary()
