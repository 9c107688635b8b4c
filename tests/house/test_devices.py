"""A run on a GPU is that of the processor: on a stand-in with the same random numbers, and on one if any."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from bcppl import devices, poses
from bcppl.errors import InputError
from bcppl.inference import guided_smc
from bcppl.models import load_recording
from bcppl.models.look_and_touch import model
from bcppl.recordings import save
from tests.command_line import Ran

if not find_spec("warp"):  # an optional group
    pytest.skip("Warp is not installed", allow_module_level=True)

from bcppl.distributions.depth import LaplaceDepth, RobustDepth
from bcppl.rendering.rasterisation import Rasteriser
from tests.house.stand_in_device import GPU, There, stand_in

NEEDS_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch reaches no GPU")


@pytest.mark.long
@pytest.mark.parametrize("profile", ["perfect", "ur5e"])
def test_a_run_of_the_stand_in_has_the_processors_evidence(
    profile: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording, program = load_recording("peg_probe"), model.with_settings(profile=profile)

    def run(device: str | None) -> list[Any]:
        steps = guided_smc.infer(program, recording, particles=12, seed=1, device=device)
        return list(islice(steps, 11))  # two views, and the probe until contacts are felt

    theirs = run(None)
    with stand_in(monkeypatch):
        mine = run("cuda")
        assert isinstance(mine[-1].population.trace["part"], There)
        assert not isinstance(mine[-1].belief.world_from_part, There)
    for one, other in zip(mine, theirs, strict=True):
        # Depths differ by single precision, and so do all that is drawn.
        assert one.info.log_evidence == pytest.approx(other.info.log_evidence, abs=0.01)
    assert mine[-1].info.log_evidence != mine[0].info.log_evidence


def test_the_stand_in_refuses_what_a_gpu_does(monkeypatch: pytest.MonkeyPatch) -> None:
    here = torch.zeros(3)
    with stand_in(monkeypatch):
        there = here.to(GPU)
        with pytest.raises(RuntimeError, match="both devices"):
            there + here
        with pytest.raises(TypeError):
            there.numpy()
        with devices.on_device(GPU):
            assert torch.zeros(2).device == GPU
            with devices.on_host():
                assert torch.zeros(2).device == devices.HOST
        assert torch.zeros(2).device == devices.HOST
        assert float((there + 1.0).sum()) == 3.0


@pytest.mark.parametrize("name", ["retract", "exp", "local", "log", "compose", "inverse", "rotation_matrix"])
def test_poses_in_one_launch_are_those_of_the_processor(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    first, other = (poses.exp(poses.identity(50), torch.randn(50, 6, dtype=torch.float64)) for _ in range(2))
    steps = torch.randn(50, 6, dtype=torch.float64)
    steps[0], steps[1] = 0.0, 1e-6 * steps[1]
    second = {"retract": [steps], "exp": [steps], "inverse": [], "rotation_matrix": []}.get(name, [other])
    function: Callable[..., Tensor] = getattr(poses, name)
    for given in ([first, *second], [first[:1], *second], [first[:0], *(each[:0] for each in second)]):
        expected = function(*given)
        with stand_in(monkeypatch):
            found = function(*(each.to(GPU) for each in given)).cpu()
        torch.testing.assert_close(found, expected, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("background", [False, True])
def test_the_likelihood_of_an_image_is_that_of_the_processor(
    background: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = load_recording("peg_probe")
    view = recording.measurements[0]
    camera, image = view.action.camera, torch.as_tensor(view.observation.depth, dtype=torch.float64)
    assert recording.truth is not None
    torch.manual_seed(0)
    scale = torch.tensor([2e-3] * 3 + [2e-2] * 3, dtype=torch.float64)
    pose = poses.retract(torch.as_tensor(recording.truth), scale * torch.randn(40, 6, dtype=torch.float64))
    bias, renderer = 1e-3 * torch.randn(40, dtype=torch.float64), Rasteriser(recording.part)
    behind = torch.full(image.shape, 0.7, dtype=torch.float64) if background else None
    given = {"scale": 0.002, "background": behind, "temperature": 6.0}
    expected = RobustDepth(renderer, camera, pose, bias=bias, **given).log_prob(image)
    with stand_in(monkeypatch):
        found = RobustDepth(renderer, camera, pose.to(GPU), bias=bias.to(GPU), **given).log_prob(image).cpu()
    # A ray along the outline may hit or miss: that is worth up to a nat of a thousand.
    apart = (found - expected).abs()
    assert float(apart.median()) < 0.01 and float(apart.max()) < 2.0
    assert float(expected.std()) > 10.0


def test_one_image_is_compared_at_the_rays_of_each_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = load_recording("peg_probe")
    view = recording.measurements[0]
    camera, image = view.action.camera, torch.as_tensor(view.observation.depth, dtype=torch.float64)
    pose, renderer = torch.as_tensor(recording.truth)[None], Rasteriser(recording.part)
    cameras = [camera, replace(camera, fx=1.05 * camera.fx), camera]
    host = [LaplaceDepth(renderer, each, pose, scale=0.002).log_prob(image) for each in cameras]
    with stand_in(monkeypatch):
        there = [LaplaceDepth(renderer, each, pose.to(GPU), scale=0.002) for each in cameras]
        found = [each.log_prob(image).cpu() for each in there]
    assert found[0] == found[2] and abs(float(host[1] - host[0])) > 100.0
    torch.testing.assert_close(found[1] - found[0], host[1] - host[0], rtol=0.02, atol=0.0)


@pytest.mark.long
def test_the_command_runs_on_the_device_and_keeps_which(
    bcppl: Callable[..., Ran], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("--particles", 8, "--set", "profile=perfect", "--device", "cuda", "--out", "run")
    recording = load_recording("peg_probe")
    save(replace(recording, measurements=recording.measurements[:2]), tmp_path / "short.h5")
    with stand_in(monkeypatch):
        ran = bcppl("run", "short.h5", *words)
    assert ran.code == 0, ran.err
    record = json.loads((tmp_path / "run/run.json").read_text())
    assert record["device"] == "cuda" and record["complete"]


@pytest.mark.long
def test_a_run_goes_on_with_particles_that_were_kept_on_the_host(monkeypatch: pytest.MonkeyPatch) -> None:
    recording, program = load_recording("peg_probe"), model.with_settings(profile="perfect")

    def run(start: Any = None) -> Any:
        return guided_smc.infer(program, recording, particles=8, seed=1, device="cuda", start=start)

    with stand_in(monkeypatch):
        _, first, second = islice(run(), 3)
        kept = first.population.on(devices.HOST)
        assert not isinstance(kept.trace["part"], There)
        again = next(run(replace(first, population=kept)))
        assert isinstance(again.population.trace["part"], There)
    assert again.info.label == second.info.label
    assert torch.equal(again.belief.world_from_part, second.belief.world_from_part)
    assert torch.equal(again.belief.log_weights, second.belief.log_weights)


def test_a_device_that_is_not_there_is_refused() -> None:
    with pytest.raises(InputError, match=r"names no device|not on"):
        devices.device_named("mps:0" if torch.cuda.is_available() else "abacus")
    if not torch.cuda.is_available():
        with pytest.raises(InputError, match="reaches no GPU"):
            next(guided_smc.infer(model, load_recording("peg_probe"), particles=2, device="cuda"))


@NEEDS_GPU
def test_a_run_on_a_gpu_has_the_same_bits_again_and_others_with_another_seed() -> None:
    recording, program = load_recording("peg_probe"), model.with_settings(profile="perfect")

    def end(seed: int) -> Any:
        *_, last = guided_smc.infer(program, recording, particles=50, seed=seed, device="cuda")
        return last

    one, again, other = end(1), end(1), end(2)
    assert torch.equal(one.belief.world_from_part, again.belief.world_from_part)
    assert not torch.equal(one.belief.world_from_part, other.belief.world_from_part)
    *_, host = guided_smc.infer(program, recording, particles=50, seed=1)
    spread = host.belief.covariance.diagonal().sqrt()
    assert bool((poses.local(host.belief.mean, one.belief.mean).abs() < 2.0 * spread).all())
