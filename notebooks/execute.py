"""Execute notebooks in place and keep their outputs: `make notebooks`, `python notebooks/execute.py NAME...`.

Each runs from top to bottom in a kernel of its own, in an empty folder. A notebook that fails, warns or
writes to the error stream is left as it was.
"""

from __future__ import annotations

import base64
import io
import os
import sys
import tempfile
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

HERE = Path(__file__).resolve().parent
DPI, COLOURS = 72, 128  # of figures
SECONDS = 1800  # for a cell, on a machine that is busy
METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}


def executed(path: Path) -> nbformat.NotebookNode:
    """A notebook with the outputs of all of its cells, and the least metadata."""
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        style = Path(folder) / "style"
        style.write_text(f"figure.dpi: {DPI}\n", encoding="utf-8")
        empty = Path(folder) / "empty"
        empty.mkdir()
        client = NotebookClient(
            notebook,
            timeout=SECONDS,
            kernel_name="python3",
            record_timing=False,
            coalesce_streams=True,
            resources={"metadata": {"path": str(empty)}},
        )
        client.execute(env={**os.environ, "MATPLOTLIBRC": str(style)})
    notebook.metadata = nbformat.from_dict(METADATA)
    for cell in notebook.cells:
        cell.metadata = nbformat.from_dict({})
        for output in cell.get("outputs", []):
            if output.output_type == "stream" and output.name == "stderr":
                raise RuntimeError(f"{path.name}, cell {cell.id}, writes to the error stream: {output.text}")
            if "metadata" in output:
                output.metadata = nbformat.from_dict({})
            if "image/png" in output.get("data", {}):
                output.data["image/png"] = small(output.data["image/png"])
    return notebook


def small(image: str) -> str:
    """A PNG image, base64, of few colours and without a mark of what wrote it."""
    read = Image.open(io.BytesIO(base64.b64decode(image))).convert("RGB")
    written = io.BytesIO()
    # The median cut would give up the colours of thin lines.
    few = read.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(written, "PNG", optimize=True)
    return base64.b64encode(written.getvalue()).decode("ascii") + "\n"


def main() -> None:
    """Execute the notebooks that are named, or all."""
    named = [HERE / f"{Path(name).stem}.ipynb" for name in sys.argv[1:]]
    for path in named or sorted(HERE.glob("*.ipynb")):
        begun = time.perf_counter()
        notebook = executed(path)
        nbformat.write(notebook, path)
        seconds, size = time.perf_counter() - begun, path.stat().st_size / 1000
        print(f"{path.name:28s} {seconds:6.0f} s {size:6.0f} kB", flush=True)


if __name__ == "__main__":
    main()
