from bcppl.models.worlds.bench import (
    BenchParameters as BenchParameters,
    BenchScene as BenchScene,
    bench_scene as bench_scene,
)
from bcppl.models.worlds.bench_arm import BenchArm as BenchArm
from bcppl.models.worlds.bench_errors import BenchErrors as BenchErrors
