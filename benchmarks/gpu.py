"""The default model's probe on a GPU: time, memory and belief, rays and gaps a second.

Two images and the 6 s probe of one scene of the accuracy bench are assimilated by `look_and_touch` with
`device="cuda"`: seconds with ever more particles after a run that compiles all kernels, and the belief beside
the processor's with the same particles. Rays are counted beside a bare kernel of Warp's that casts the same
ones; gaps beside the processor's. It needs a GPU and Warp, and is not run where there is none.
"""

from __future__ import annotations

import cProfile
import pstats
import statistics
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from report import Row, cores, finish, options, show
from torch import Tensor

from bcppl import poses, recordings
from bcppl.beliefs import Belief
from bcppl.geometry.gap import PegGap
from bcppl.geometry.simplified import SEEN, simplified
from bcppl.inference.filters.guided_smc import infer
from bcppl.inference.filters.smc import Step
from bcppl.models import look_and_touch
from bcppl.rendering.rasterisation import renderer_for
from bcppl.sensors.measurements import Recording

GOALS = {10_000: 2.0, 100_000: 15.0}  # s, by number of particles
SHARE = 0.8  # of the rays a second of a bare kernel
COMPARED = 3000  # particles of each belief that is compared
MANY = 2000  # poses at which rays are cast and gaps measured
PASSES = 5
model = look_and_touch.model.with_settings(profile="perfect")


class Timed(NamedTuple):
    """A run: its last step, seconds, the most that torch held on the GPU (GB), and each step's time."""

    last: Step
    seconds: float
    memory: float
    steps: list[tuple[str, float]]


def run(recording: Recording, particles: int, seed: int, device: str) -> Timed:
    """One run from the prior to the end of the probe."""
    on_gpu = device != "cpu"
    if on_gpu:
        torch.cuda.reset_peak_memory_stats()
    scene = model.prepare(recording)
    begun, each, last = time.perf_counter(), [], None
    for step in infer(model, recording, particles=particles, seed=seed, device=device, scene=scene):
        each.append((step.info.label, step.info.seconds))
        last = step
    if on_gpu:
        torch.cuda.synchronize()
    assert last is not None
    memory = torch.cuda.max_memory_allocated() / 1e9 if on_gpu else float("nan")
    return Timed(last, time.perf_counter() - begun, memory, each)


def growth(recording: Recording, counts: Sequence[int], seed: int) -> list[Row]:
    """Seconds and memory with ever more particles."""
    rows, lines, points = list[Row](), [], recording.part.surface_points()
    for count in counts:
        run(recording, count, seed + 1, "cuda")
        done = run(recording, count, seed, "cuda")
        vision = sum(seconds for name, seconds in done.steps if name.startswith("view"))
        error = 1e3 * done.last.belief.weighted_add(points, recording.truth)
        lines.append([f"{count}", done.seconds, vision, done.seconds - vision, done.memory, error])
        rows.append(Row(f"N = {count}: wall", done.seconds, "s", GOALS.get(count)))
        rows.append(Row(f"N = {count}: memory of the GPU", done.memory, "GB"))
        rows.append(Row(f"N = {count}: weighted ADD", error, "mm"))
    title = f"growth with the number of particles on a {torch.cuda.get_device_name()}"
    show(title, ["N", "wall s", "vision s", "touch s", "GB", "weighted ADD mm"], lines)
    return rows


def _moments(belief: Belief, about: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviations (6,) in the tangent space at a pose, m and rad."""
    tangent = poses.local(about, belief.world_from_part)
    mean = belief.weights @ tangent
    return mean, (belief.weights @ (tangent - mean).square()).sqrt()


def beliefs(recording: Recording, particles: int, seeds: Sequence[int]) -> list[Row]:
    """The belief at the end on both devices, with each of some seeds."""
    found = {(d, s): run(recording, particles, s, d) for s in seeds for d in ("cpu", "cuda")}
    points, lines = recording.part.surface_points(), []
    about = found["cpu", seeds[0]].last.belief.mean
    moments = {key: _moments(done.last.belief, about) for key, done in found.items()}
    spread = moments["cpu", seeds[0]][1]
    for (device, seed), done in found.items():
        mean, deviation = moments[device, seed]
        belief, info = done.last.belief, done.last.info
        error = 1e3 * belief.weighted_add(points, recording.truth)
        shown = [float(x) for x in (*(mean / spread), *(deviation / spread))]
        lines.append([f"{device} {seed}", done.seconds, error, info.log_evidence, *shown])
    axes = ["x", "y", "z", "rx", "ry", "rz"]
    columns = ["", "wall s", "ADD mm", "log evidence", *axes, *(f"sd {axis}" for axis in axes)]
    show(f"beliefs of {particles} particles; means and deviations in the first's deviations", columns, lines)
    rows = [
        Row(f"{device} seed {seed}: {name}", value, unit)
        for (device, seed), done in found.items()
        for name, value, unit in (
            ("wall", done.seconds, "s"),
            ("weighted ADD", 1e3 * done.last.belief.weighted_add(points, recording.truth), "mm"),
            ("log evidence", done.last.info.log_evidence, "nats"),
        )
    ]

    def apart(one: tuple[str, int], other: tuple[str, int]) -> float:
        return float(((moments[one][0] - moments[other][0]) / spread).abs().max())

    between = max(apart(("cpu", s), ("cuda", s)) for s in seeds)
    within = max(apart((d, seeds[0]), (d, s)) for s in seeds[1:] or seeds for d in ("cpu", "cuda"))
    rows.append(Row("largest difference of means, cuda to cpu", between, "deviations"))
    rows.append(Row("largest difference of means, seed to seed", within, "deviations"))
    return rows


def _median(work: Callable[[], Any]) -> float:
    """Seconds of a call, the median of some after one that compiles."""
    seconds = []
    for k in range(PASSES + 1):
        torch.cuda.synchronize()
        begun = time.perf_counter()
        work()
        torch.cuda.synchronize()
        if k:
            seconds.append(time.perf_counter() - begun)
    return statistics.median(seconds)


def _places(recording: Recording, count: int) -> Tensor:
    """Poses (N, 7) within millimetres of the true one."""
    generator = torch.Generator().manual_seed(0)
    scale = torch.tensor([0.003] * 3 + [0.03] * 3, dtype=torch.float64)
    truth = torch.as_tensor(recording.truth, dtype=torch.float64)
    steps = scale * torch.randn(count, 6, generator=generator, dtype=torch.float64)
    return poses.retract(truth.expand(count, 7), steps)


def rays(recording: Recording, count: int) -> list[Row]:
    """Rays a second of the likelihood and of `hits`, beside a bare kernel that casts the same rays."""
    from bare_rays import cast

    from bcppl.distributions.depth import RobustDepth

    view = next(m for m in recording.measurements if m.kind == "view")
    camera, image = view.action.camera, torch.as_tensor(view.observation.depth, dtype=torch.float64)
    renderer, here = renderer_for(simplified(recording.part, SEEN)), _places(recording, count)
    there, bias = here.cuda(), torch.full((count,), 0.001, dtype=torch.float64, device="cuda")
    caster = renderer.on(there.device)

    def likelihood() -> Tensor:
        # A distribution of its own each time: one caches nothing of another.
        site = RobustDepth(renderer, camera, there, scale=0.002, outlier=0.1, bias=bias)
        return site.log_prob(image)

    few = here[:MANY]
    by_processor = RobustDepth(renderer, camera, few, scale=0.002, outlier=0.1, bias=bias[:MANY].cpu())
    difference = (by_processor.log_prob(image) - likelihood()[:MANY].cpu()).abs()
    valid = int(by_processor.observed(image).valid.sum())
    bare = cast(caster, camera, caster._camera_from_part(camera, there), torch.from_numpy(camera.rays()))
    million = 1e-6 * count
    speeds = {
        "a bare kernel of Warp's": million * camera.width * camera.height / _median(bare),
        "the likelihood of an image": million * valid / _median(likelihood),
        "hits, copied to the processor": million
        * camera.width
        * camera.height
        / _median(lambda: caster.hits(camera, there[:MANY]))
        * MANY
        / count,
    }
    show(f"million rays a second, {count} poses", ["", "M/s"], [[k, v] for k, v in speeds.items()])
    first, second, third = speeds.values()
    return [
        Row("rays of a bare kernel", first, "M/s"),
        Row("rays of the likelihood, of a bare kernel's", second / first, "", SHARE, "min"),
        Row("rays of hits, of a bare kernel's", third / first, ""),
        Row("log-likelihood of an image, median difference", float(difference.median()), "nats"),
        Row("log-likelihood of an image, largest difference", float(difference.max()), "nats"),
    ]


def gaps(recording: Recording, count: int) -> list[Row]:
    """Gaps a second and their difference to the processor's."""
    assert recording.peg is not None
    windows = [m for m in recording.measurements if m.kind == "window"]
    pegs = torch.cat([torch.as_tensor(m.observation.world_from_peg)[::10] for m in windows])
    here = _places(recording, count)
    there, gap = here.cuda(), PegGap(simplified(recording.part), simplified(recording.peg))
    by_processor, found = gap(here, pegs).distance, gap(there, pegs).distance.cpu()
    near = by_processor.abs() < 0.003
    pairs = 1e-6 * count * len(pegs)
    on_gpu, on_processor = _median(lambda: gap(there, pegs)), _median(lambda: gap(here, pegs))
    apart = 1e9 * float((by_processor - found)[near].abs().max())
    lines = [["GPU", pairs / on_gpu], ["processor", pairs / on_processor]]
    show(
        f"million gaps a second, {cores()} cores; within 3 mm they differ by {apart:.3g} nm",
        ["", "M/s"],
        lines,
    )
    return [
        Row("gaps on the GPU", pairs / on_gpu, "M/s"),
        Row("gaps on the processor", pairs / on_processor, "M/s"),
        Row("gaps within 3 mm of contact: largest difference", apart, "nm", 500.0),
    ]


def profile(recording: Recording, particles: int, seed: int) -> None:
    """Prints where the processor's time goes in one run on the GPU, and the GPU's own by kernel."""
    run(recording, particles, seed, "cuda")
    profiler = cProfile.Profile()
    profiler.enable()
    run(recording, particles, seed, "cuda")
    profiler.disable()
    pstats.Stats(profiler, stream=sys.stdout).sort_stats("tottime").print_stats(25)
    activities = [torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as traced:
        run(recording, particles, seed, "cuda")
    print(traced.key_averages().table(sort_by="self_cuda_time_total", row_limit=20, max_name_column_width=60))


def recorded(file: Path | None, seed: int) -> Recording:
    """A recording from a file, or that of a scene of the accuracy bench, its probe planned as there."""
    if file is not None:
        return recordings.load(file)
    from scenes import PARTICLES, followed

    found, _, recording = followed(seed, PARTICLES)
    if recording is None:
        raise RuntimeError(found.missed)
    return recording


def main() -> None:
    parser = options(__doc__ or "")
    parser.set_defaults(seed=20003)
    parser.add_argument("--recording", type=Path, metavar="FILE", help="instead of that of scene --seed")
    parser.add_argument("--profile", type=int, metavar="N", help="print where the time of N particles goes")
    given = parser.parse_args()
    if not torch.cuda.is_available():
        print("no scene was run: torch reaches no GPU.")
        return
    recording = recorded(given.recording, given.seed)
    if given.profile:
        profile(recording, given.profile, given.seed)
        return
    counts = [1000] if given.quick else [*GOALS]
    rows = growth(recording, counts, given.seed)
    rows += beliefs(recording, 300 if given.quick else COMPARED, [1] if given.quick else [1, 2])
    rows += rays(recording, MANY // 10 if given.quick else 10 * MANY)
    rows += gaps(recording, MANY // 10 if given.quick else MANY)
    finish(rows, given.json)


if __name__ == "__main__":
    warnings.simplefilter("ignore", RuntimeWarning)
    main()
