"""The whole loop on a simulated arm that speaks RTDE: look, choose, touch, update, insert, by `examples/`.

Each scene has a process for the arm and one for the program, which talk through ur_rtde. With `--pace clock`
the arm moves in real time; with `client` its clock goes on with each command, so that a slow machine loses
nothing and times mean little.
"""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from report import Row, finish, options, show
from scipy.stats import binomtest

EXAMPLES = Path(__file__).parents[1] / "examples"
LONGEST = 300.0  # s of a scene


def attempted(seed: int, probes: int, pace: str, folder: str) -> tuple[bool, float, float, str]:
    """Whether the peg went in, how deep (mm), the seconds of it all, and what the program printed last."""
    look = f"{folder}/look.h5"
    words = [sys.executable, "-m", "ur.stand_in", "--seed", seed, "--look", look, "--pace", pace]
    with subprocess.Popen(
        [str(each) for each in words], stdout=subprocess.PIPE, text=True, cwd=EXAMPLES
    ) as arm:
        try:
            assert arm.stdout is not None
            arm.stdout.readline()
            program = [sys.executable, EXAMPLES / "touch_and_insert.py", look, "--probes", probes]
            begun = time.perf_counter()
            ran = subprocess.run(
                [str(each) for each in program], capture_output=True, text=True, timeout=LONGEST
            )
            seconds = time.perf_counter() - begun
        except subprocess.TimeoutExpired:
            return False, float("nan"), LONGEST, "it took too long"
        finally:
            arm.kill()
    last = (ran.stdout + ran.stderr).strip().splitlines()[-1:] or [""]
    deep = re.search(r"the tip is (-?[\d.]+) mm deep", ran.stdout)
    return "\ninserted" in ran.stdout, float(deep[1]) if deep else float("nan"), seconds, last[0]


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--probes", type=int, default=2, help="before the insertion")
    parser.add_argument("--pace", choices=["clock", "client"], default="clock")
    arguments = parser.parse_args()
    count = 1 if arguments.quick else arguments.scenes
    lines, went = [], []
    with TemporaryDirectory() as folder:
        for seed in range(arguments.seed, arguments.seed + count):
            inserted, depth, seconds, printed = attempted(seed, arguments.probes, arguments.pace, folder)
            went.append(inserted)
            lines.append([str(seed), "in" if inserted else "NOT in", depth, seconds, printed[:60]])
            print(*lines[-1], flush=True)
    show("look, choose, touch, update, insert", ["scene", "ended", "depth mm", "s", "last words"], lines)
    interval = binomtest(sum(went), count).proportion_ci(0.95)
    rows = [
        Row("inserted", 100.0 * sum(went) / count, "%", None, "min"),
        Row("inserted, lower end", 100.0 * interval.low, "%", None, "min"),
    ]
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()
