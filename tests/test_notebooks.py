"""The notebooks run from top to bottom on what is shipped, and are kept without outputs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

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


class Ran(NamedTuple):
    """What the cells of a notebook printed, and which of them drew a picture."""

    printed: dict[str, str]
    drawn: set[str]


def run(name: str, folder: Path) -> Ran:
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    # The kernel starts in an empty folder: only what is installed can be read.
    client = nbclient.NotebookClient(
        notebook, timeout=480, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    )
    client.execute()
    outputs = {cell.id: cell.outputs for cell in notebook.cells if cell.cell_type == "code"}
    printed = {
        name: "".join(o.text for o in all_of if o.output_type == "stream" and o.name == "stdout")
        for name, all_of in outputs.items()
    }
    drawn = {
        name for name, all_of in outputs.items() if any("image/png" in o.get("data", {}) for o in all_of)
    }
    assert "Traceback" not in "".join(printed.values())
    return Ran(printed, drawn)


def test_first_belief_runs_and_finds_the_part(tmp_path: Path) -> None:
    printed, drawn = run("first_belief", tmp_path)
    assert drawn == {"views", "wrench", "prior", "forward", "vision-figure", "felt", "add", "final"}

    # A row for the prior and one for each of the fourteen measurements, ADD in its column.
    rows = re.findall(
        r"^(prior|view \d+|window \d+) .*° +([\d.]+) mm +(\S+) ",
        printed["vision"] + printed["touch"] + printed["rest"],
        flags=re.MULTILINE,
    )
    adds = {label: float(add) for label, add, _ in rows}
    assert len(rows) == len(adds) == 15
    assert adds["window 14"] < adds["view 2"] < adds["prior"]
    assert adds["window 14"] < 2.0
    (final,) = re.findall(r"^ADD ([\d.]+) mm$", printed["answer"], flags=re.MULTILINE)
    assert float(final) == adds["window 14"]


def test_own_model_names_the_part_and_its_proposal_earns_its_place(tmp_path: Path) -> None:
    printed, drawn = run("own_model", tmp_path)
    assert drawn == {"look", "figure"}
    truth = re.search(r"^truth: (.+) at", printed["infer"], flags=re.MULTILINE)
    assert truth
    above = printed["infer"].split("after the view from above")[1]
    named = re.search(rf"^  {truth[1]}: ([\d.]+)$", above, flags=re.MULTILINE)
    assert named and float(named[1]) > 0.8
    (alone,), (helped,) = (
        re.findall(rf"^{label}: .* deviation ([\d.]+)$", printed["without"], flags=re.MULTILINE)
        for label in ("random walk alone", "with our proposal")
    )
    assert float(helped) < 0.5 * float(alone)


def test_own_model_and_its_proposal_are_short() -> None:
    notebook = nbformat.read(NOTEBOOKS / "own_model.ipynb", as_version=4)
    sources = {cell.id: cell.source for cell in notebook.cells}
    assert len((sources["model"] + "\n" + sources["proposal"]).splitlines()) < 60


def test_swap_kernels_puts_four_programs_side_by_side(tmp_path: Path) -> None:
    printed, drawn = run("swap_kernels", tmp_path)
    assert drawn == {"figure"}
    rows = re.findall(
        r"^(\S.*?) +([\d.]+) +(\d+) +(-?[\d.]+) +([\d.]+) mm ", printed["table"], flags=re.MULTILINE
    )
    table = {name: [float(v) for v in values] for name, *values in rows}
    assert len(table) == 4
    assert all(1 <= ess <= 60 and 1 <= distinct <= 60 for ess, distinct, *_ in table.values())
    assert table["random walk"][3] < 3.0 < table["BayesContact"][3]


def test_where_to_touch_chooses_and_ends_in_the_hole(tmp_path: Path) -> None:
    printed, drawn = run("where_to_touch", tmp_path)
    assert drawn == {"chosen", "beliefs"}
    gains = [
        float(gain) for gain in re.findall(r"([\d.]+)(?: ± [\d.]+)? nats$", printed["ranking"], re.MULTILINE)
    ]
    assert len(gains) == 6 and gains == sorted(gains, reverse=True) and gains[0] > gains[-1] + 0.5
    (before,) = re.findall(r"ADD ([\d.]+) mm", printed["look"])
    after = re.findall(r"ADD ([\d.]+) mm", printed["touch"])
    assert len(after) == 3 and float(after[-1]) < 0.25 * float(before)
    assert "inserted: True" in printed["insert"]
