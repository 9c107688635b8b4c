"""The tempered program with few moves: for tests of what is run and written, not of what is inferred."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from bcppl.inference.filters import tempered_smc
from bcppl.inference.filters.smc import Step
from bcppl.traces import Model


def infer(model: Model, recording: Any, **settings: Any) -> Iterator[Step]:
    yield from tempered_smc.infer(model, recording, sweeps=2, share=0.5, **settings)
