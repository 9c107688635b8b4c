"""A bench's configuration from YAML; a mistake is one sentence that names the field and what to do."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from bcppl.arguments import named
from bcppl.errors import InputError
from bcppl.recordings.hdf5 import one_line
from bcppl.recordings.importers.bench.configuration.fields import BenchFields
from bcppl.recordings.importers.bench.table import is_number
from bcppl.untrusted.visible_text import visible

_TYPES = {
    "float_type": "a number",
    "int_type": "a whole number",
    "string_type": "text",
    "list_type": "a list",
    "dict_type": "fields of its own",
    "model_type": "fields of its own",
    "bool_type": "true or false",
}
_BOUNDS = {
    "greater_than": ("above", "gt"),
    "greater_than_equal": ("of at least", "ge"),
    "less_than": ("below", "lt"),
    "less_than_equal": ("of at most", "le"),
}
_LONGEST = 120  # characters of a name or of a cause that are quoted


class _Loader(yaml.SafeLoader):
    """The safe loader, which makes plain values alone; it refuses a field that stands twice, and aliases."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """A node that is no alias: a few lines of aliases of aliases stand for gigabytes."""
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            problem = f"the alias {named('{}', event.anchor)} has to be written out"
            raise yaml.composer.ComposerError(None, None, problem, event.start_mark)
        return super().compose_node(parent, index)

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """A value; one that is none of the type that YAML reads from its form or tag is refused."""
        try:
            return super().construct_object(node, deep)
        except (yaml.YAMLError, RecursionError):
            raise
        except Exception as error:  # dates and numbers have errors of many types
            kind = node.tag.rpartition(":")[2]
            problem = f"{named('{}', node.value)} is no {kind}, and text needs quotes,"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark) from error

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """A mapping whose keys differ."""
        seen = set()
        for key, _ in node.value:
            name = getattr(key, "value", None)
            if isinstance(name, str) and name in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, named("the field {} stands there twice", name), key.start_mark
                )
            seen.add(name if isinstance(name, str) else id(key))
        return super().construct_mapping(node, deep)


def read_configuration(path: Path) -> BenchFields:
    """The configuration in a YAML file.

    Raises:
        InputError: there is no such file, it is no YAML, or a field is missing, unknown or wrong.
    """
    if not path.is_file():
        raise InputError(f"there is no configuration {path}; write one with `bcppl new bench {path.name}`.")
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=_Loader)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{path} is no valid YAML ({_cause(error)}); correct it there.") from error
    if not isinstance(content, dict):
        raise InputError(f"{path} holds no fields; write a new one with `bcppl new bench`.")
    try:
        return BenchFields.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{path.name}: {_sentence(error, content)}") from None


def _cause(error: BaseException) -> str:
    mark = getattr(error, "problem_mark", None)
    what = _short(getattr(error, "problem", None) or one_line(error))
    return f"{what} in line {mark.line + 1}" if mark is not None else str(what)


def _sentence(error: ValidationError, content: dict[Any, Any]) -> str:
    """The first mistake; one in a field's type stands before what follows from it."""
    first: Any = error.errors(include_url=False)[0]
    kind, given = first["type"], first["input"]
    place = [_short(str(each)) for each in first["loc"]]
    value = named("{}", given)
    where = _dotted(place) or "the configuration"
    if kind == "missing":
        return f"{_dotted(place[:-1]) or 'the configuration'} lacks {place[-1]!r}; add it."
    if kind == "extra_forbidden":
        known = _known(place[:-1])
        close = get_close_matches(place[-1], known, 1)
        meant = f"write {close[0]!r} if that is meant." if close else f"its fields are {', '.join(known)}."
        return f"{_dotted(place[:-1]) or 'the configuration'} has no field {place[-1]!r}; {meant}"
    if kind == "literal_error":
        return f"{where} is {value}; give {first['ctx']['expected']}."
    if kind in _BOUNDS:
        word, name = _BOUNDS[kind]
        return f"{where} is {value}; give a number {word} {first['ctx'][name]:g}."
    if kind in ("too_short", "too_long"):
        bound = first["ctx"].get("min_length", first["ctx"].get("max_length"))
        side = "at least" if kind == "too_short" else "at most"
        return f"{where} has {len(given)} entries; give {side} {bound}."
    if kind == "finite_number":
        return f"{where} is {value}; give a finite number."
    if kind == "float_type" and isinstance(given, str) and is_number(given):
        return f"{where} is {value}, which YAML reads as text; write {float(given)!r}."
    if kind in _TYPES:
        return f"{where} is {value}; give {_TYPES[kind]}."
    message = str(first.get("ctx", {}).get("error", first["msg"])).rstrip(".")
    return f"{where} {message}."


def _short(text: str) -> str:
    """Text of the file in one line, no more of it than one reads."""
    line = " ".join(visible(text).split())
    return line if len(line) <= _LONGEST else f"{line[:_LONGEST]}…"


def _dotted(place: list[str]) -> str:
    """A place as in `cameras.wrist.images[0].file`; what pydantic adds for unions is left out."""
    words = ""
    for each in place:
        if each.isdigit():
            words += f"[{each}]"
        elif "[" not in each and each not in ("str", "int", "float"):
            words += f".{each}" if words else each
    return words


def _known(place: list[str]) -> list[str]:
    """The names of the fields at a place."""
    model: Any = BenchFields
    for name in place:
        if not (isinstance(model, type) and issubclass(model, BaseModel)):
            break
        if name in model.model_fields:
            model = _inner(model.model_fields[name].annotation)
    return list(model.model_fields) if isinstance(model, type) and issubclass(model, BaseModel) else []


def _inner(annotation: Any) -> Any:
    """The model within `X | None`, `list[X]` or `dict[str, X]`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for each in getattr(annotation, "__args__", ()):
        if (found := _inner(each)) is not None:
            return found
    return None
