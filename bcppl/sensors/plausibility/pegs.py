"""A doubt about a held peg, without what it touched: which of its ends is the tip."""

from __future__ import annotations

from collections.abc import Iterator

from bcppl.geometry.parts import Part


def peg_doubt(peg: Part) -> Iterator[str]:
    """The doubt where a peg lies wholly above its origin, as in a frame whose z axis points to the tip."""
    if peg.vertices[:, 2].min() >= 0.0:
        yield (
            f"peg {peg.name!r} lies wholly above its origin, and its lowest end counts as its tip: "
            "probably its z axis points to the tip, as a TCP's; turn the peg (Part.moved), world_from_peg "
            "and the wrench by 180° about x."
        )
