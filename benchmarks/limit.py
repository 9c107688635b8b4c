"""The least time that a scene of the accuracy bench could take here, and where the time goes beside it.

A scene is seen, touched by the usual probe, and explained (N = 75). Counted are the rays that are within the
part's outline, the pairs of poses whose gap is measured, and the rows that the filter of contact episodes
goes through for each particle. Then each kernel does as much alone: Embree, called directly, rays in one
batch; the gap's kernel pairs in one batch; the filter its calls once more. Their sum is the least time. The
kernels take as many threads as OMP_NUM_THREADS says, or as there are cores; Embree takes one.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from report import Row, finish, options, show
from scenes import PARTICLES, default_run

from bcppl import poses
from bcppl.distributions.episodes import filtered as episodes
from bcppl.effort import Effort
from bcppl.inference.planning.metrology import three_two_one
from bcppl.models.look_and_touch import model
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.rendering.ray_casting import RayCaster
from bcppl.sensors.measurements import Recording

REPEATS = 5
RAYS = 1 << 20  # in one call of Embree


class Spent(NamedTuple):
    """Of one kernel in one scene: how much it did, how long it took there, and how long it takes alone."""

    amount: float
    seconds: float
    least: float


def explained(recording: Recording, **settings: Any) -> tuple[float, Any, dict[str, Effort]]:
    """Seconds of the default inference, the scene that it was given, and its simulators' efforts."""
    prepared = model.prepare(recording, **settings)
    before = {name: effort.copy() for name, effort in prepared.efforts.items()}
    begun = time.perf_counter()
    for _ in default_run(recording, PARTICLES, 0, scene=prepared):
        pass
    seconds = time.perf_counter() - begun
    return seconds, prepared, {n: effort.since(before[n]) for n, effort in prepared.efforts.items()}


def best(work: Callable[[], Any]) -> float:
    """Seconds of the fastest of a few calls."""
    seconds = []
    for _ in range(REPEATS):
        begun = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - begun)
    return min(seconds)


def rays(scene: BenchScene, recording: Recording, spent: Effort) -> Spent:
    """Rays within the part's outline, of a run that casts them, and Embree's own time for as many."""
    _, casting, efforts = explained(recording, renderer=RayCaster)
    count = efforts["rendering"].amount
    part = scene.part
    embree = EmbreeScene(robust=True)
    TriangleMesh(embree, np.ascontiguousarray(part.vertices[part.faces], dtype=np.float32))
    camera = next(iter(casting.likelihoods["view"].looks.values())).camera
    pose = poses.compose(poses.inverse(torch.from_numpy(scene.truth)), camera.stated_pose())
    turn, eye = poses.rotation_matrix(pose).numpy(), pose[:3].numpy()
    # Those within the outline: of all, the ones that hit it.
    directions = (camera.rays() @ turn.T).astype(np.float32)
    origins = np.broadcast_to(eye.astype(np.float32), directions.shape).copy()
    hit = embree.run(origins, directions, query="DISTANCE") < 1e30
    chosen = np.resize(np.flatnonzero(hit), RAYS)
    batch = origins[chosen], directions[chosen]
    second = RAYS / best(lambda: embree.run(*batch, query="DISTANCE"))
    return Spent(count, spent.seconds, count / second)


def gaps(scene: BenchScene, recording: Recording, prepared: Any, spent: Effort) -> Spent:
    """Pairs of poses whose gap is measured, and the kernel's own time for as many."""
    measured = prepared.likelihoods["window"].gap
    touched = [m.observation.world_from_peg for m in recording.measurements if hasattr(m.action, "probe")]
    peg = torch.from_numpy(np.concatenate(touched)[::5].copy())
    generator = torch.Generator().manual_seed(0)
    spread = torch.tensor([3e-4] * 3 + [3e-3] * 3, dtype=torch.float64)
    step = spread * torch.randn(500, 6, dtype=torch.float64, generator=generator)
    part = poses.retract(torch.from_numpy(scene.truth), step)
    second = len(part) * len(peg) / best(lambda: measured(part, peg))
    return Spent(spent.items, spent.seconds, spent.items / second)


def episodes_of(recording: Recording, **settings: Any) -> tuple[float, Any, dict[str, Effort], Spent]:
    """A run in which the filter's calls are noted, and the time of these calls alone."""
    calls, spent, kernel = list[tuple[Any, ...]](), list[float](), episodes.filtered

    def noted(*arguments: Any) -> Any:
        begun = time.perf_counter()
        result = kernel(*arguments)
        spent.append(time.perf_counter() - begun)
        calls.append(arguments)
        return result

    episodes.filtered = noted  # type: ignore[assignment]
    try:
        seconds, prepared, efforts = explained(recording, **settings)
    finally:
        episodes.filtered = kernel
    rows = sum(len(arguments[0].number) * len(arguments[4]) for arguments in calls)
    least = best(lambda: [kernel(*arguments) for arguments in calls])
    return seconds, prepared, efforts, Spent(rows, sum(spent), least)


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--scenes", type=int, default=5)
    parser.add_argument("--profile", default="perfect")
    arguments = parser.parse_args()
    count = 1 if arguments.quick else arguments.scenes
    lines: list[list[Any]] = []
    multiples: list[float] = []
    for seed in range(arguments.seed, arguments.seed + count):
        scene = bench_scene(seed)
        *_, seen = default_run(scene.look(), PARTICLES, seed)
        recording = scene.probe(three_two_one(seen.belief, scene.part, scene.peg))
        explained(recording, profile=arguments.profile)  # compiles and loads what is compiled
        whole, prepared, efforts, filter_ = episodes_of(recording, profile=arguments.profile)
        kernels = {
            "rays": rays(scene, recording, efforts["rendering"]),
            "gaps": gaps(scene, recording, prepared, efforts["gap"]),
            "rows of the filter": filter_,
        }
        least = sum(one.least for one in kernels.values())
        for name, one in kernels.items():
            share = f"{one.seconds / max(one.least, 1e-9):.1f}"
            lines.append([f"{seed}, {name}", int(one.amount), one.least, one.seconds, share])
        others = whole - sum(one.seconds for one in kernels.values())
        multiples.append(whole / least)
        lines.append([f"{seed}, all else", "", 0.0, others, ""])
        lines.append([f"{seed}, whole", "", least, whole, f"{multiples[-1]:.1f}"])
    columns = ["scene", "how many", "least s", "spent s", "multiple"]
    show("kernels in a scene, and the same alone", columns, lines)
    rows = [Row("time over the least, median", statistics.median(multiples), "1")]
    rows.append(Row("time over the least, worst", max(multiples), "1"))
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()
