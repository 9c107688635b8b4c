"""The shipped depth frame of an arm is what its README states."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from bcppl.inference import infer
from bcppl.models import load_recording, part_in_view
from bcppl.recordings import problems
from bcppl.rendering.rasterisation import renderer_for
from bcppl.sensors.plausibility import doubts
from tests.recordings import arm_view_recording

XARM = Path(__file__).parents[3] / "shared/data/xarm7_realsense"


def test_it_is_well_formed_small_and_beside_its_licences() -> None:
    recording = load_recording("arm_view")
    assert problems(recording) == [] and doubts(recording) == []
    assert recording.model == "part_in_view" and "roboreg" in recording.source
    folder = files("bcppl.models") / "recordings"
    assert len((folder / "arm_view.h5").read_bytes()) < 300_000
    for name, words in (("LICENSE-arm-view", "Apache License"), ("LICENSE-arm-view-meshes", "UFACTORY")):
        assert words in (folder / name).read_text(encoding="utf-8")


def test_at_the_reference_the_arm_is_where_the_image_is_nearer_than_its_background() -> None:
    recording = load_recording("arm_view")
    (view,) = recording.measurements
    poses = np.stack([recording.truth, recording.guess.world_from_part])
    rendered = renderer_for(recording.part).images(view.action.camera, poses)
    depth = view.observation.depth
    nearer = (recording.background["realsense"] - depth > 0.3) & (depth < 1.5)
    shown = [float(np.isfinite(each[nearer]).mean()) for each in rendered]
    assert shown[0] > 0.85 > shown[1]
    off = (depth - rendered[0])[np.isfinite(rendered[0]) & np.isfinite(depth)]
    assert float((np.abs(off) < 0.03).mean()) > 0.7


@pytest.mark.long
def test_an_image_may_be_taken_to_see_the_part_where_it_is() -> None:
    recording = load_recording("arm_view")
    model = part_in_view.model.with_settings(shift=0.0)
    *_, last = infer(model, recording, particles=20, seed=0)
    assert set(last.population.trace.choices) == {"part"}
    assert 1e3 * float((last.belief.mean[:3] - recording.truth[:3]).norm()) < 30.0


@pytest.mark.skipif(not XARM.is_dir(), reason=f"the xArm's frames are not at {XARM}")
def test_it_is_made_again_from_the_published_frames() -> None:
    shipped, again = load_recording("arm_view"), arm_view_recording.recording(XARM)
    np.testing.assert_allclose(again.part.vertices, shipped.part.vertices, atol=1e-12)
    np.testing.assert_array_equal(again.part.faces, shipped.part.faces)
    np.testing.assert_allclose(
        again.measurements[0].observation.depth, shipped.measurements[0].observation.depth, atol=1e-6
    )
    np.testing.assert_allclose(again.background["realsense"], shipped.background["realsense"], atol=1e-6)
    np.testing.assert_allclose(again.truth, shipped.truth, atol=1e-12)
