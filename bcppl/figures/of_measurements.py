"""What a report shows of measurements of one kind, beside a belief; another kind registers its own.

@pictures.register
def _(action: Beam, measurements, recording, belief):
yield "Distances.", figure
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import singledispatch

from matplotlib.figure import Figure

from bcppl.beliefs import Belief
from bcppl.figures.images import depth_residual, outlines_on_depth
from bcppl.figures.touches import gap_over_time, touches_on_part, wrench_over_time
from bcppl.rendering.rasterisation import renderer_for
from bcppl.sensors import Measurement, ProbeWindow, Recording, View

IMAGES, PROBES = 4, 3  # that are shown
OUTLINED = 8  # particles

Pictures = Iterator[tuple[str, Figure]]


@singledispatch
def pictures(
    action: object, measurements: Sequence[Measurement], recording: Recording, belief: Belief
) -> Pictures:
    """Captions and figures of measurements of one kind; none of a kind that has registered none.

    Args:
        action: of one of them, whose type decides.
        measurements: of a recording, all of that kind.
        recording: with the part, the peg and the truth, where known.
        belief: given them.
    """
    yield from ()


@pictures.register
def _(_: View, measurements: Sequence[Measurement], recording: Recording, belief: Belief) -> Pictures:
    renderer, mean = renderer_for(recording.part), belief.mean.numpy()
    heaviest = belief.world_from_part[belief.log_weights.argsort(descending=True)[:OUTLINED]].numpy()
    for each in measurements[:IMAGES]:
        figure = Figure(figsize=(10.0, 3.6), layout="constrained")
        left, right = figure.subplots(1, 2)
        outlines_on_depth(left, each.action, each.observation, renderer, mean, heaviest, recording.truth)
        depth_residual(right, each.action, each.observation, renderer, mean)
        yield (
            "Measured depth with the part's outline at the mean (orange), at particles (grey) and at the "
            "truth (light blue, where known); measured minus rendered depth.",
            figure,
        )


@pictures.register
def _(_: ProbeWindow, measurements: Sequence[Measurement], recording: Recording, belief: Belief) -> Pictures:
    probes: dict[str, list[Measurement]] = {}
    for each in measurements:
        probes.setdefault(each.action.probe.name, []).append(each)
    for name, windows in list(probes.items())[:PROBES]:
        figure = Figure(figsize=(10.0, 5.0), layout="constrained")
        if recording.peg is None:
            wrench_over_time(figure.add_subplot(), windows)
            yield f"Probe {name}: the force.", figure
            continue
        wrench_over_time(figure.add_subplot(2, 2, 1), windows)
        gap_over_time(figure.add_subplot(2, 2, 3), windows, recording.part, recording.peg, belief)
        pose = belief.mean.numpy()
        touches_on_part(figure, (1, 2, 2), windows, recording.part, recording.peg, pose)
        yield (
            f"Probe {name}: the force, the gap that the belief takes to have been between peg and part, and "
            "where the peg was, as seen from the part.",
            figure,
        )
