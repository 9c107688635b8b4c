"""Draws `docs/belief.png`: the belief before contact and after it, of the shipped simulated probe."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

import bcppl

PICTURE = Path(__file__).with_name("belief.png")

recording = bcppl.models.load_recording("peg_probe")
model = bcppl.models.look_and_touch.model.with_settings(profile="perfect")  # of this simulated bench
steps = list(bcppl.infer(model, recording, particles=75, seed=0))
shown = {"prior": steps[0], "after two depth images": steps[2], "after 6 s of contact": steps[-1]}
beliefs = [
    (title, step.belief.world_from_part.numpy(), step.belief.log_weights.numpy())
    for title, step in shown.items()
]
bcppl.figures.belief_in_3d(recording.part, beliefs, truth=recording.truth).savefig(PICTURE, dpi=110)
with Image.open(PICTURE) as picture:
    picture.convert("RGB").quantize(64).save(PICTURE, optimize=True)
