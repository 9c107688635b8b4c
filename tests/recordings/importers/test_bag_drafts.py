"""Configurations that are drafted from a bag: its own names, and nothing that a name could add."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml

from bcppl.recordings.importers import bag
from bcppl.recordings.importers.bench.configuration.drafts import spelled
from tests.recordings.importers import bag_logs

pytest.importorskip("rosbags", reason="bags need rosbags: pip install 'bcppl[bag]'")


def test_a_draft_names_the_frames_that_a_bag_has(tmp_path: Path) -> None:
    def rows(types: bag_logs.Types) -> Any:
        still = types("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0)
        moved = types("geometry_msgs/Transform", types("geometry_msgs/Vector3", 0.1, 0.0, 0.0), still)
        for k in range(50):
            each = types("geometry_msgs/TransformStamped", types.header(0.01 * k, "base_link"), "tip", moved)
            yield 0.01 * k, "/tf", "tf2_msgs/TFMessage", types("tf2_msgs/TFMessage", [each])

    new = tmp_path / "new.yaml"
    with pytest.raises(typer.Exit):
        bag.command(bag_logs.write(tmp_path / "two", "sqlite3", rows), write=new)
    text = new.read_text()
    assert "parent: base_link  # a guess" in text and "child: tip" in text


def test_a_name_in_a_bag_is_no_line_of_the_drafted_configuration(tmp_path: Path) -> None:
    frame = "base\nsource: 'injected'\n#"

    def rows(types: bag_logs.Types) -> Iterator[bag_logs.Row]:
        zero = types("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
        for stamp in (0.0, 0.1):
            wrench = types("geometry_msgs/Wrench", zero, zero)
            stamped = types("geometry_msgs/WrenchStamped", types.header(stamp, frame), wrench)
            yield stamp, "/wrench", "geometry_msgs/WrenchStamped", stamped

    path, new = bag_logs.write(tmp_path / "bag", "mcap", rows), tmp_path / "new.yaml"
    with pytest.raises(typer.Exit):
        bag.command(path, write=new)
    text = new.read_text()
    assert "source" not in yaml.safe_load(text)
    assert r'in the frame "base\nsource' in text


@pytest.mark.parametrize(
    "name",
    [
        "/wrench",
        "side 1",
        "a: b",
        "x\ny",
        "2025-31-01",
        "1.5",
        "",
        "~",
        "it's",
        "é",
        "\u202ex",
        "a,b]",
        "&a",
        "'",
    ],
)
def test_a_name_is_spelled_so_that_yaml_reads_it(name: str) -> None:
    text = spelled(name)
    assert text.isprintable() and (text == name or not re.fullmatch("[a-z/_]+", name))
    assert yaml.safe_load(f"{{topic: {text}, every: 2}}  # a guess, {text}") == {"topic": name, "every": 2}
    assert yaml.safe_load(f"camera:\n  {text}:  # a guess\n    1") == {"camera": {name: 1}}
