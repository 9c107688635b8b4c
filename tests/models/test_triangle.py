"""Where to push next on the real triangle: one contact leaves it free to slide, the next is against that."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import triangle

LOGS = Path(__file__).parents[3] / "shared/data/point_probe_pushes"


@pytest.mark.long
@pytest.mark.skipif(not LOGS.is_dir(), reason="the push logs are not there")
def test_after_one_contact_the_next_push_is_on_another_edge() -> None:
    by_weights = [triangle.chosen(seed)[0] for seed in range(6)]
    assert sum(one.another for one in by_weights) >= 5
    # What is left of the slide is less than it was, and less than after a push by chance.
    assert sum(one.after for one in by_weights) < 0.5 * sum(one.before for one in by_weights)
