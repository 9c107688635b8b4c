"""Peers: packages that conflict with bcppl's requirements, each asked in an environment of its own."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SCRIPTS = Path(__file__).parent / "peers"
ENVIRONMENTS = Path(__file__).parent / ".peers"


def ask(
    peer: str, script: str, *arguments: object, environment: Mapping[str, str] | None = None
) -> list[dict[str, Any]] | None:
    """What a peer's script prints, one dictionary for each line.

    Args:
        peer: whose environment, `particles` or `blackjax` (`make peers` makes them).
        script: the name of a file in `benchmarks/peers`.
        arguments: of the script.
        environment: variables that are added to this process's own.

    Returns:
        The results; None where the environment is absent or the script fails: one sentence then reports it.
    """
    python = ENVIRONMENTS / peer / "bin" / "python"
    if not python.is_file():
        print(f"{peer} is left out: it has no environment yet; run `make peers`.")
        return None
    command = [str(python), str(SCRIPTS / script), *map(str, arguments)]
    variables = {**os.environ, **(environment or {})}
    done = subprocess.run(command, env=variables, capture_output=True, text=True, check=False)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["it printed nothing"])[-1]
        print(f"{peer} is left out: {script} ended with status {done.returncode} ({last}).")
        return None
    return [json.loads(line) for line in done.stdout.splitlines()]
