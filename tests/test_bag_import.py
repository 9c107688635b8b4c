"""The same log as files and as bags of three kinds becomes the same recording; damage is one sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bcppl.recordings import problems
from bcppl.recordings.importers import Imported, bag, bench
from tests import bag_logs, bench_logs

pytest.importorskip("rosbags", reason="bags need rosbags: pip install 'bcppl[bag]'")

STATED = {"clock": "{wrench_late: 8, unit: ms}"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("log")
    bench_logs.write(folder, bench_logs.truth(0), bench_logs.Log(more=STATED))
    return folder


@pytest.fixture(scope="module")
def by_files(folder: Path) -> Imported:
    return bench.command(folder / "bench.yaml")


@pytest.fixture(scope="module")
def last(folder: Path) -> float:
    return float(np.loadtxt(folder / "poses.csv", delimiter=",", skiprows=1)[-1, 0])


@pytest.fixture(scope="module")
def config(folder: Path, last: float) -> Path:
    path = folder / "bag.yaml"
    path.write_text(bag_logs.configuration((folder / "bench.yaml").read_text(), last))
    return path


@pytest.fixture(scope="module")
def bags(folder: Path) -> dict[str, Path]:
    return {
        kind: bag_logs.write(folder / kind, kind, lambda types: bag_logs.messages(folder, types))
        for kind in bag_logs.KINDS
    }


def assert_same(imported: Imported, expected: Imported) -> None:
    mine, theirs = bench_logs.touches(imported.recording), bench_logs.touches(expected.recording)
    for each, other in zip(mine, theirs, strict=True):
        np.testing.assert_allclose(each, other, rtol=0, atol=2e-6)
    views = [m for m in imported.recording.measurements if m.kind == "view"]
    others = [m for m in expected.recording.measurements if m.kind == "view"]
    assert len(views) == len(others) == 2
    for view, other in zip(views, others, strict=True):
        np.testing.assert_allclose(view.observation.depth, other.observation.depth, rtol=0, atol=1e-7)
        assert view.action.camera.optics == other.action.camera.optics
        np.testing.assert_array_equal(
            view.action.camera.world_from_camera, other.action.camera.world_from_camera
        )
    assert problems(imported.recording) == []


@pytest.mark.parametrize("kind", bag_logs.KINDS)
def test_a_bag_becomes_what_the_files_of_the_same_log_do(
    kind: str, bags: dict[str, Path], config: Path, by_files: Imported
) -> None:
    assert_same(bag.command(bags[kind], config), by_files)
