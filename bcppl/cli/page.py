"""The page of a run: one file of HTML with the table, the result in words, the warnings and figures."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bcppl.beliefs import Belief
from bcppl.cli.report import WIDTHS, relative_to_peg
from bcppl.inference.criticism.nuisances import shared_errors
from bcppl.inference.population import Population
from bcppl.recordings import Recording
from bcppl.sensors.protocol import by_sensor
from bcppl.untrusted.visible_text import visible

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESOLUTION = 90  # dots per inch
STYLE = """
body { font: 15px/1.45 sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #222 }
table { border-collapse: collapse; font: 13px/1.5 monospace } td, th { padding: 0 .55rem; text-align: right }
td:first-child, th:first-child { text-align: left } tr:nth-child(odd) td { background: #f4f4f4 }
img { max-width: 100% } figcaption { color: #555; font-size: 14px } figure { margin: 1.5rem 0 }
.warning { color: #a04000 } .result { font-size: 17px; font-weight: bold }
"""

Captioned = tuple[str, "Figure"]


def page(
    record: Mapping[str, Any],
    conclusion: str,
    rows: Sequence[Mapping[str, str]],
    pictures: Sequence[Captioned],
) -> str:
    """The page's text; nothing in it refers to another file or host.

    Args:
        record: the content of run.json.
        conclusion: the result in words.
        rows: of the table.
        pictures: each with its caption.
    """

    def safe(value: object) -> str:
        return html.escape(visible(str(value)))

    shown = {name: record.get(name) for name in ("recording", "model", "inference", "particles", "seed")}
    settings = ", ".join(f"{name} {safe(value)}" for name, value in shown.items())
    state = "" if record.get("complete") else "<p class='warning'>The run was stopped before its end.</p>"
    worries = [*record.get("doubts", []), *record.get("warnings", [])]
    warned = "".join(f"<p class='warning'>{safe(each)}</p>" for each in worries)
    header = "".join(f"<th>{safe(name)}</th>" for name in WIDTHS)
    lines = "".join(
        f"<tr>{''.join(f'<td>{safe(row.get(name, str()))}</td>' for name in WIDTHS)}</tr>" for row in rows
    )
    drawn = "".join(
        f"<figure><img alt='{safe(caption)}' src='data:image/png;base64,{_encoded(figure)}'>"
        f"<figcaption>{safe(caption)}</figcaption></figure>"
        for caption, figure in pictures
    )
    return (
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>bcppl: {safe(shown['recording'])}"
        f"</title><style>{STYLE}</style></head><body><h1>{safe(shown['recording'])}</h1><p>{settings}, "
        f"bcppl {safe(record.get('version'))}</p>{state}<p class='result'>{safe(conclusion)}</p>{warned}"
        f"<table><thead><tr>{header}</tr></thead><tbody>{lines}</tbody></table>{drawn}</body></html>\n"
    )


def figures(
    recording: Recording, history: Sequence[tuple[str, Belief]], rows: Sequence[Mapping[str, str]], last: Any
) -> Iterator[Captioned]:
    """What there is to be seen of a run.

    Args:
        recording: that was run.
        history: by step its label and belief.
        rows: of the table, one for each step.
        last: the last step.
    """
    from matplotlib.figure import Figure

    from bcppl.figures import column_over_time, marginals, pictures, shared_error_bars, spread_over_time

    labels, belief = [label for label, _ in history], history[-1][1]
    taken = recording.measurements[: len(history) - 1]
    spread, relative = (
        np.array([float(row.get(name) or "nan") for row in rows]) for name in ("± mm", "rel. mm")
    )
    figure = Figure(figsize=(10.0, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    spread_over_time(left, labels, spread, relative)
    column_over_time(right, labels, [each.effective_sample_size for _, each in history], "ESS (particles)")
    yield (
        "How far the particles are from their mean after each measurement, and how many they are worth.",
        figure,
    )
    for _, measurements in by_sensor(taken):
        yield from pictures(measurements[0][1].action, [each for _, each in measurements], recording, belief)
    yield (
        "The pose axis by axis, from its mean.",
        marginals(belief, recording.truth, relative_to_peg(belief, recording, len(taken))),
    )
    population = getattr(last, "population", None)
    errors = shared_errors(population) if isinstance(population, Population) else []
    if errors:
        count = sum(len(error.mean) for error in errors)
        figure = Figure(figsize=(7.0, 0.8 + 0.2 * count), layout="constrained")
        shared_error_bars(figure.add_subplot(), errors)
        yield "What the touches tell of the errors that they share.", figure


def _encoded(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=RESOLUTION, format="png")
    return base64.b64encode(buffer.getvalue()).decode("ascii")
