"""Notebooks run from top to bottom, with smaller numbers where asked, beside the outputs that are kept."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest

nbformat = pytest.importorskip("nbformat", reason="notebooks are tested with nbformat and nbclient")
nbclient = pytest.importorskip(
    "nbclient", reason="notebooks are run with nbclient: pip install 'bcppl[notebook]'"
)
jupyter_client = pytest.importorskip("jupyter_client", reason="nbclient brings it")

NOTEBOOKS = Path(__file__).resolve().parents[2] / "notebooks"
AGAIN = "execute it again: make notebooks"


class Ran(NamedTuple):
    """What the cells of a notebook printed, and which of them drew a picture."""

    printed: dict[str, str]
    drawn: set[str]


def shown_by(notebook: Any) -> Ran:
    """The output of all code cells, by name."""
    outputs = {cell.id: cell.outputs for cell in notebook.cells if cell.cell_type == "code"}
    printed = {
        name: "".join(o.text for o in all_of if o.output_type == "stream" and o.name == "stdout")
        for name, all_of in outputs.items()
    }
    drawn = {
        name for name, all_of in outputs.items() if any("image/png" in o.get("data", {}) for o in all_of)
    }
    return Ran(printed, drawn)


@pytest.fixture(scope="module")
def kernel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """One for all notebooks, so that torch is imported once; what one has defined, `run` removes.

    It starts in an empty folder: only what is installed can be read.
    """
    manager = jupyter_client.KernelManager(kernel_name="python3")
    manager.start_kernel(cwd=str(tmp_path_factory.mktemp("empty")))
    yield manager
    manager.shutdown_kernel(now=True)


RESET = "%reset -f\nimport torch\ntorch.set_default_dtype(torch.float32)"

# Names of cells, and what is replaced in each.
Smaller = Mapping[str, Sequence[tuple[str, str]]]


def run(name: str, kernel: Any, smaller: Smaller) -> Ran:
    """Runs a notebook from top to bottom, some of its numbers replaced by smaller ones.

    Its cells print and draw where those that are kept did.
    """
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    kept = shown_by(notebook)
    cells = {cell.id: cell for cell in notebook.cells}
    for cell, replacements in smaller.items():
        for shipped, few in replacements:
            assert cells[cell].source.count(shipped) == 1, f"{name}, cell {cell}: {shipped}"
            cells[cell].source = cells[cell].source.replace(shipped, few)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(RESET, id="reset"))
    client = nbclient.NotebookClient(notebook, timeout=480, km=kernel)
    client.execute()
    ran = shown_by(notebook)
    assert "Traceback" not in "".join(ran.printed.values())
    assert ran.drawn == kept.drawn, f"{name}: {AGAIN}"
    printing = [{cell for cell, text in each.printed.items() if text} for each in (ran, kept)]
    assert printing[0] == printing[1], f"{name}: {AGAIN}"
    return ran


# The part is known to millimetres before the first image, so that few particles find it.
NEAR = (
    'recording = load(files("bcppl.models") / "recordings/peg_probe.h5")',
    """import dataclasses
import torch
from bcppl import poses

recording = load(files("bcppl.models") / "recordings/peg_probe.h5")
off = torch.tensor([4e-3, -3e-3, 2e-3, 0.02, -0.02, 0.1], dtype=torch.float64)
near = poses.retract(torch.from_numpy(recording.truth), off).numpy()
guess = dataclasses.replace(
    recording.guess, world_from_part=near, translation=np.full(3, 0.006), tilt=0.05, yaw=0.2
)
recording = dataclasses.replace(recording, guess=guess)""",
)


def shipped_or(smaller: Smaller) -> pytest.MarkDecorator:
    """With fewer particles, moves and candidates in the ordinary tests, as shipped in the long ones."""
    return pytest.mark.parametrize(
        "smaller",
        [pytest.param({}, id="shipped", marks=pytest.mark.long), pytest.param(smaller, id="smaller")],
    )
