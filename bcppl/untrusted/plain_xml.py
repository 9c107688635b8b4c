"""XML as robots and meshes need it: elements and attributes, without a document type and its entities."""

from __future__ import annotations

from typing import Any, NoReturn
from xml.parsers import expat

DEEPEST = 100  # elements within elements


def refuse_entities(data: bytes) -> None:
    """Refuse XML that a parser would expand, or follow to other files, or nest without end.

    Raises:
        ValueError: it has a document type, is nested too deeply, or is no XML.
    """
    parser, depth = expat.ParserCreate(), 0

    def refuse(*declaration: Any) -> NoReturn:
        raise ValueError("it has a document type (<!DOCTYPE>), whose entities are not read; remove it")

    def enter(*element: Any) -> None:
        nonlocal depth
        depth += 1
        if depth > DEEPEST:
            raise ValueError(f"its elements are nested more than {DEEPEST} deep")

    def leave(name: str) -> None:
        nonlocal depth
        depth -= 1

    parser.StartDoctypeDeclHandler, parser.StartElementHandler, parser.EndElementHandler = (
        refuse,
        enter,
        leave,
    )
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise ValueError(f"it is no XML: {error}") from error
