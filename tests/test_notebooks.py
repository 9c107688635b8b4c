"""The notebooks run from top to bottom on what is shipped, and are kept without outputs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat", reason="notebooks are tested with nbformat and nbclient")
nbclient = pytest.importorskip(
    "nbclient", reason="notebooks are run with nbclient: pip install 'bcppl[notebook]'"
)

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_notebook_is_kept_without_outputs(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert code
    assert [cell.id for cell in code if cell.outputs or cell.execution_count is not None] == []
    assert set(notebook.metadata) == {"kernelspec", "language_info"}


def test_first_belief_runs_and_finds_the_part(tmp_path: Path) -> None:
    notebook = nbformat.read(NOTEBOOKS / "first_belief.ipynb", as_version=4)
    # The kernel starts in an empty folder: only what is installed can be read.
    client = nbclient.NotebookClient(
        notebook, timeout=480, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    outputs = {cell.id: cell.outputs for cell in notebook.cells if cell.cell_type == "code"}
    said = {
        name: "".join(o.text for o in all_of if o.output_type == "stream") for name, all_of in outputs.items()
    }
    drawn = {
        name for name, all_of in outputs.items() if any("image/png" in o.get("data", {}) for o in all_of)
    }
    assert drawn == {"views", "wrench", "prior", "forward", "vision-figure", "felt", "add", "final"}
    assert "Traceback" not in "".join(said.values())

    # A row for the prior and one for each of the fourteen measurements, ADD in its column.
    rows = re.findall(
        r"^(prior|view \d+|window \d+) .*° +([\d.]+) mm +(\S+) ",
        said["vision"] + said["touch"] + said["rest"],
        flags=re.MULTILINE,
    )
    adds = {label: float(add) for label, add, _ in rows}
    assert len(rows) == len(adds) == 15
    assert adds["window 14"] < adds["view 2"] < adds["prior"]
    assert adds["window 14"] < 2.0
    (final,) = re.findall(r"^ADD ([\d.]+) mm$", said["answer"], flags=re.MULTILINE)
    assert float(final) == adds["window 14"]
