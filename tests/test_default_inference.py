"""A model's own inference program: chosen in one place, with the model's settings."""

from __future__ import annotations

from functools import partial

import pytest
import torch

import bcppl
from bcppl.cli import loading
from bcppl.errors import InputError
from bcppl.inference.filters import bayes_contact, guided_smc, tempered_smc
from bcppl.inference.filters.default import default_inference
from bcppl.models import look_and_touch, part_in_view, point_probe
from tests.command_line import short


def test_the_model_names_the_program_and_its_settings() -> None:
    name, infer = default_inference(part_in_view.model)
    assert name == "tempered_smc" and isinstance(infer, partial)
    assert infer.func is tempered_smc.infer and infer.keywords == {"climbs": 240}
    assert default_inference(look_and_touch.model)[1].func is guided_smc.infer  # type: ignore[attr-defined]


def test_infer_runs_it_and_settings_given_win() -> None:
    recording = short(1)
    (*_, one), (*_, other) = (
        bcppl.infer(point_probe.model, recording, particles=5, seed=2),
        tempered_smc.infer(point_probe.model, recording, particles=5, seed=2),
    )
    assert torch.equal(one.belief.world_from_part, other.belief.world_from_part)
    with pytest.raises(InputError, match="-1 climbs"):
        bcppl.infer(part_in_view.model, recording, climbs=-1)


def test_the_command_line_keeps_the_settings_of_the_models_own_program_only() -> None:
    for given in (None, "tempered_smc"):
        name, infer = loading.inference(given, part_in_view.model)
        assert name == "tempered_smc" and infer.keywords == {"climbs": 240}  # type: ignore[attr-defined]
    assert loading.inference("bayes_contact", part_in_view.model) == ("bayes_contact", bayes_contact.infer)
