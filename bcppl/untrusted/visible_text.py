"""Text that came from a file, as a terminal or a figure may show it."""

from __future__ import annotations


def in_figure(text: str) -> str:
    """The text as matplotlib shows it, which would read formulas between two dollar signs."""
    return visible(text).replace("$", r"\$")


def visible(text: str) -> str:
    """The text with all that is not printable spelled out: it can neither colour nor hide words."""
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)
