"""The distributions of a trace that hides some of its sites from the proposal that reads it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from bcppl.errors import InputError


def refused(address: str) -> InputError:
    """The error of a proposal that asks for a hidden site."""
    return InputError(
        f"site {address!r} is hidden from a proposal, which asked for its distribution or log-probability; "
        "let the proposal read earlier sites only."
    )


@dataclass(frozen=True, eq=False)
class Hiding(Mapping[str, Any]):
    """The distributions of a trace, those at `hidden` addresses named but not given."""

    distributions: Mapping[str, Any]
    hidden: frozenset[str]

    def __getitem__(self, address: str) -> Any:
        if address in self.hidden:
            raise refused(address)
        return self.distributions[address]

    def __iter__(self) -> Iterator[str]:
        return iter(self.distributions)

    def __len__(self) -> int:
        return len(self.distributions)
