"""Settings of a model that are fields of its sensors' settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from bcppl.errors import InputError


def chosen(model: str, given: Mapping[str, Any], *defaults: Any) -> list[Any]:
    """The default settings, each with those of the given values that are its fields.

    Args:
        model: its name, for messages.
        given: values by name.
        defaults: dataclasses.

    Raises:
        InputError: no default has a field of a given name, or a value is out of range.
    """
    names = [{field.name for field in fields(each)} for each in defaults]
    unknown = sorted(set(given).difference(*names))
    if unknown:
        known = ", ".join(sorted(set().union(*names)))
        raise InputError(f"{model} has no setting {unknown[0]!r}; its settings are {known}.")
    return [
        replace(each, **{name: value for name, value in given.items() if name in own})
        for each, own in zip(defaults, names, strict=True)
    ]
