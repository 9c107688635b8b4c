from bcppl.models.worlds.bench.arm import BenchArm as BenchArm
from bcppl.models.worlds.bench.errors import BenchErrors as BenchErrors
from bcppl.models.worlds.bench.parameters import BenchParameters as BenchParameters
from bcppl.models.worlds.bench.scene import (
    BenchScene as BenchScene,
    bench_scene as bench_scene,
    simulate_recording as simulate_recording,
)
