"""Damages real files by seeds, loads each in a process of its own under limits, and classifies what happened.

`python -m tests.recordings.damaged_files --count 2800` prints a table: rows are the kinds of files, columns
what happened. Every process is forked from one that has imported everything, so that a case costs what its
loader costs. Of what is read, a digest is compared with that of the undamaged file.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import os
import random
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bcppl.errors import InputError
from tests.recordings.damage import damaged
from tests.recordings.whole_files import LOADERS, whole_files

SECONDS = 5.0  # of one core, after which a loader hangs
PATIENCE = 60.0  # s on the clock: a machine may be busy
ALLOWANCE = 256 << 20  # bytes that a loader may take beyond ten times the file
ADDRESSES = 3 << 30  # bytes of addresses beyond those of the process that is forked
OUTCOMES = (
    *("equal", "refused", "edited"),
    *("traceback", "hang", "crash", "memory", "accepted", "unnoticed", "sentence"),
)
BAD = OUTCOMES[3:]


@dataclasses.dataclass(frozen=True)
class Result:
    """What happened to one file.

    Attributes:
        kind: of the file.
        seed: of the damage.
        damage: in words.
        outcome: one of `OUTCOMES`: "edited" is a file without a checksum whose content differs, which
            nobody can notice; "accepted" one that must not be read; "unnoticed" a changed content that a
            checksum covers; "sentence" a refusal of more than one line, or without the file's name.
        message: of the refusal, or the traceback's last line.
        seconds: of the processor.
        memory: bytes beyond what the undamaged file takes.
    """

    kind: str
    seed: int
    damage: str
    outcome: str
    message: str = ""
    seconds: float = 0.0
    memory: int = 0


def content(value: Any) -> str:
    """A digest of what was read, all the way down."""
    total = hashlib.sha256()

    def add(each: Any) -> None:
        if dataclasses.is_dataclass(each) and not isinstance(each, type):
            each = {f.name: getattr(each, f.name) for f in dataclasses.fields(each)}
        if isinstance(each, torch.Tensor):
            each = each.detach().numpy()
        if isinstance(each, np.ndarray):
            total.update(f"{each.dtype} {each.shape}".encode() + np.ascontiguousarray(each).tobytes())
        elif isinstance(each, Mapping):
            for key, held in each.items():
                add(key)
                add(held)
        elif isinstance(each, list | tuple):
            total.update(f"list {len(each)}".encode())
            for held in each:
                add(held)
        else:
            total.update(f"{type(each).__name__} {each!r}".encode())

    add(value)
    return total.hexdigest()


def _loaded(load: Callable[[Path], Any], path: Path, results: int) -> None:
    """Load in this process, write what came of it to a pipe, and end."""
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + ADDRESSES,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter("ignore")
    try:
        said = ["read", content(load(path))]
    except InputError as error:
        said = ["refused", str(error)]
    except BaseException as error:
        said = ["traceback", f"{type(error).__name__}: {error}"[:300]]
    os.write(results, json.dumps(said).encode()[:60000])
    os._exit(0)


def watched(load: Callable[[Path], Any], path: Path) -> tuple[str, str, float, int]:
    """The outcome of loading a file in a fork: what it said, the detail, seconds, and most bytes."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 1)
            os.dup2(nowhere.fileno(), 2)
            os.close(reading)
            _loaded(load, path, writing)
    os.close(writing)
    end = time.monotonic() + PATIENCE
    while True:
        done, status, usage = os.wait4(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.002)
    with os.fdopen(reading, "rb") as results:
        text = results.read()
    seconds, memory = usage.ru_utime + usage.ru_stime, 1024 * usage.ru_maxrss
    if seconds > SECONDS or time.monotonic() > end:
        return "hang", "", seconds, memory
    if not text:
        return "crash", f"status {status}", seconds, memory
    said, detail = json.loads(text)
    return said, detail, seconds, memory


def _classified(
    said: str, detail: str, whole: str, paths: list[Path], size: int, memory: int, rule: str
) -> str:
    if said in ("hang", "crash"):
        return said
    if memory > ALLOWANCE + 10 * size or "MemoryError" in detail:
        return "memory"
    if said == "traceback":
        return "traceback"
    if said == "refused":
        names = any(each.name in detail for each in paths)
        return "refused" if names and detail.isprintable() and len(detail) < 700 else "sentence"
    if rule == "refuse":
        return "accepted"
    if detail == whole:
        return "equal"
    return "unnoticed" if rule == "notice" else "edited"


def campaign(count: int, seed: int, kinds: list[str] | None = None) -> Iterator[Result]:
    """Damage files of all kinds in turn, `count` in all, and load each.

    Yields:
        Result: of one file each.
    """
    with tempfile.TemporaryDirectory() as folder:
        files = whole_files(Path(folder))
        files = [each for each in files if kinds is None or each.kind in kinds]
        wholes: dict[str, tuple[str, int]] = {}
        for each in files:
            said, detail, _, memory = watched(LOADERS[each.loader], each.path)
            assert said == "read", (each.kind, detail)
            wholes[each.kind] = detail, memory
        for number in range(count):
            each = files[number % len(files)]
            case = seed * 1_000_003 + number
            original = each.damaged_path.read_bytes()
            what, rule = damaged(each, random.Random(case))
            size, (whole, usual) = each.damaged_path.stat().st_size, wholes[each.kind]
            said, detail, seconds, memory = watched(LOADERS[each.loader], each.path)
            memory -= usual
            outcome = _classified(said, detail, whole, [each.path, each.damaged_path], size, memory, rule)
            yield Result(each.kind, case, what, outcome, detail, seconds, memory)
            each.damaged_path.unlink()
            each.damaged_path.write_bytes(original)


def table(results: list[Result]) -> str:
    """Counts by kind and outcome."""
    counts = Counter((each.kind, each.outcome) for each in results)
    rows = ["kind".ljust(18) + "".join(word.rjust(11) for word in OUTCOMES)]
    for kind in dict.fromkeys(each.kind for each in results):
        rows.append(kind.ljust(18) + "".join(str(counts[kind, word]).rjust(11) for word in OUTCOMES))
    total = Counter(each.outcome for each in results)
    rows.append("all".ljust(18) + "".join(str(total[word]).rjust(11) for word in OUTCOMES))
    return "\n".join(rows)


def main() -> None:
    """Run a campaign, print its table, and write what must not happen as lines of JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="*")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    start = time.monotonic()
    results = []
    for each in campaign(given.count, given.seed, given.kinds):
        results.append(each)
        if given.json is not None:
            with given.json.open("a") as lines:
                lines.write(json.dumps(dataclasses.asdict(each)) + "\n")
    print(table(results))
    print(
        f"{len(results)} files, {time.monotonic() - start:.0f} s, "
        f"slowest {max(each.seconds for each in results):.1f} s, "
        f"most memory {max(each.memory for each in results) >> 20} MB"
    )
    sys.exit(any(each.outcome in BAD for each in results))


if __name__ == "__main__":
    main()
