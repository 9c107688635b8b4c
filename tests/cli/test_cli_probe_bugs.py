"""`bcppl probe` calls a model unsuitable only where it is: a bug is reported as a bug."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bcppl.distributions.manifold import ContactManifold
from bcppl.inference import infer
from bcppl.inference.design import rules
from bcppl.models.look_and_touch import model
from bcppl.models.worlds.bench.parameters import BenchParameters
from bcppl.models.worlds.bench.scene import bench_scene
from bcppl.recordings import save
from bcppl.recordings.beliefs import save_belief
from tests.command_line import Ran

WORDS = "probe", "belief.h5", "--of", "look.h5", "--candidates", "touch:1", "--outer-samples", 2


@functools.cache
def saved() -> dict[str, bytes]:
    """A recording of two small views, and the belief after them, as files hold them."""
    look = bench_scene(5, BenchParameters(width=64, rows=48, focal=64.0), part="square 8 mm").look()
    *_, last = infer(model, look, particles=10, seed=0)
    with tempfile.TemporaryDirectory() as folder:
        save(look, f"{folder}/look.h5")
        save_belief(
            last.belief,
            f"{folder}/belief.h5",
            label=last.info.label,
            log_evidence=last.info.log_evidence,
            random_state=last.random_state,
            latent=dict(last.population.trace.choices),
        )
        return {file.name: file.read_bytes() for file in Path(folder).iterdir()}


@pytest.fixture
def error_of(bcppl: Callable[..., Ran], tmp_path: Path) -> Callable[..., str]:
    """Runs the command where the recording and the belief are; gives its error."""
    for name, content in saved().items():
        (tmp_path / name).write_bytes(content)

    def run(*words: object) -> str:
        ran = bcppl(*WORDS, *words)
        assert ran.code
        return ran.err

    return run


def raising(*_: Any, error: Exception, **__: Any) -> Any:
    raise error


BUGS = [TypeError("a bug"), AttributeError("a bug"), KeyError("a bug")]


def assert_reported_as_a_bug(message: str, error: Exception) -> None:
    assert "something went wrong" in message and type(error).__name__ in message and "a bug" in message


@pytest.mark.long
@pytest.mark.parametrize("error", BUGS, ids=lambda error: type(error).__name__)
def test_a_bug_in_the_ranking_is_no_unsuitable_model(
    error: Exception, error_of: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for way in ("by_linearised_gain", "by_reweighted_gain"):
        monkeypatch.setattr(rules, way, lambda *_, **__: functools.partial(raising, error=error))
    assert_reported_as_a_bug(error_of(), error)


@pytest.mark.long
def test_a_bug_deep_within_the_ranking_is_no_unsuitable_model(
    error_of: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the approximation by which a touch is ranked, which every model of touches has."""
    monkeypatch.setattr(ContactManifold, "_second_order", functools.partialmethod(raising, error=BUGS[0]))
    assert_reported_as_a_bug(error_of(), BUGS[0])
