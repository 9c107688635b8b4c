"""A model's own inference program: chosen in one place, with the model's settings."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import islice

import pytest
import torch

import bcppl
from bcppl.cli import loading
from bcppl.errors import InputError
from bcppl.inference import smc, tempered
from bcppl.inference.filters import bayes_contact, guided_smc, tempered_smc
from bcppl.inference.filters.default import default_inference
from bcppl.inference.proposals import drift
from bcppl.models import load_recording, look_and_touch, part_in_view, point_probe
from tests.command_line import short
from tests.made_recordings import assert_one_sentence


def test_the_model_names_the_program_and_its_settings() -> None:
    name, infer = default_inference(part_in_view.model)
    assert name == "tempered_smc" and isinstance(infer, partial)
    assert infer.func is tempered_smc.infer and infer.keywords == part_in_view.model.inference[1]
    assert infer.keywords["climbs"] == 960
    assert default_inference(look_and_touch.model)[1].func is guided_smc.infer  # type: ignore[attr-defined]


def test_infer_runs_it_and_settings_given_win() -> None:
    recording = short(1)
    (*_, one), (*_, other) = (
        bcppl.infer(point_probe.model, recording, particles=5, seed=2),
        tempered_smc.infer(point_probe.model, recording, particles=5, seed=2, always_search=True),
    )
    assert torch.equal(one.belief.world_from_part, other.belief.world_from_part)
    with pytest.raises(InputError, match="-1 climbs"):
        bcppl.infer(part_in_view.model, recording, climbs=-1)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_particles_are_moved_after_every_exponent_but_the_last(seed: int) -> None:
    begun = tempered_smc.infer(
        point_probe.model, short(1), particles=60, seed=seed, sweeps=1, search_climbs=0
    )
    _, (_, info) = islice(begun, 2)
    assert info.step.resampled >= len(info.exponents) - 1 > 2


def test_the_command_line_keeps_the_settings_of_the_models_own_program_only() -> None:
    for given in (None, "tempered_smc"):
        name, infer = loading.inference(given, part_in_view.model)
        assert name == "tempered_smc" and infer.keywords["climbs"] == 960  # type: ignore[attr-defined]
    assert loading.inference("bayes_contact", part_in_view.model) == ("bayes_contact", bayes_contact.infer)


def test_what_cannot_be_run_is_refused_in_one_sentence() -> None:
    recording, model = short(1), point_probe.model
    seen = load_recording("peg_probe")
    held = replace(seen, guess=replace(seen.guess, tilt=0.0), measurements=seen.measurements[:1])
    for message, call in {
        "a module in place of a model": lambda: bcppl.infer(point_probe, recording),  # type: ignore[arg-type]
        "a str in place of a recording": lambda: bcppl.infer(model, "point_probe_10_pushes"),
        r"tempered_smc has no setting 'particle'; .* particles,": lambda: bcppl.infer(
            model, recording, particle=5
        ),
        "smc is given something else than a step": lambda: smc(model, recording, step=drift("x")),  # type: ignore[arg-type]
        "given a str in place of a recording": lambda: smc(model, "own.h5", step=tempered()),
        "names 'guided'": lambda: bcppl.infer(replace(model, inference=("guided", {})), recording),
        "measurement 0 gives no observation": lambda: bcppl.infer(
            replace(model, observe=lambda scene, measurements: {}), recording, particles=5
        ),
        "holds 2 of the part's 6 axes fixed": lambda: bcppl.infer(look_and_touch.model, held, particles=5),
    }.items():
        with pytest.raises(InputError, match=message) as refused:
            list(call())
        assert_one_sentence(str(refused.value))
