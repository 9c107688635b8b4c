"""Doubts about views: the mistake under whose repair images show the part where the guess has it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bcppl.errors import InputError
from bcppl.geometry.parts import Guess, Part
from bcppl.sensors import checks
from bcppl.sensors.depth import View
from bcppl.sensors.measurements import Measurement
from bcppl.sensors.plausibility.images import Fit, Images, Repair, Seen, repairs, thinned
from bcppl.sensors.plausibility.search import Found, is_narrow
from bcppl.sensors.plausibility.wording import listed

MOST = 4  # views that are looked at, evenly chosen
# Shares of 30 right scenes of the bench: 0.45 to 0.77; no repair had more than 0.98 times their score.
POOR = 0.25  # a share below which the part is not where it should be
SEEN = 0.05  # a share above which one image among several may show the part: a thin one has 0.09
REPAIRED = 0.4  # a share from which on a repair explains the images
SMALLEST = 5.0  # pixels across the part, below which an image decides nothing
BETTER = 1.3  # times the score that a repair has to reach


def view_doubts(
    measurements: Sequence[Measurement], part: Part, guess: Guess
) -> tuple[list[str], Found | None]:
    """Doubts about views, and the pose of the part that they show: None where they show none."""
    readable = [m for m in measurements if isinstance(m.action, View) and _is_readable(m, part, guess)]
    chosen = (
        [readable[k] for k in np.unique(np.linspace(0, len(readable) - 1, MOST).astype(int))]
        if readable
        else []
    )
    if not chosen or not is_narrow(guess):
        return [], None
    several = [thinned(m.action.camera, np.asarray(m.observation.depth)) for m in chosen]
    try:
        return _doubts(Images(part, guess), several, len(readable) == len(chosen))
    except InputError:  # of a camera that has a problem, which a check of the recording names
        return [], None


def _is_readable(measurement: Measurement, part: Part, guess: Guess) -> bool:
    camera, depth = measurement.action.camera, measurement.observation.depth
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    if np.shape(depth) != (camera.height, camera.width) or list(checks.pose("", camera.world_from_camera)):
        return False
    if not (np.isfinite(intrinsics).all() and (intrinsics[:2] > 0.0).all()):
        return False
    away = np.linalg.norm(np.asarray(camera.world_from_camera)[:3] - np.asarray(guess.world_from_part)[:3])
    across = float(np.median(part.extent)) * min(camera.fx, camera.fy) / max(float(away), 1e-3)
    return across > SMALLEST and bool((np.isfinite(depth) & (np.asarray(depth) > 0.0)).any())


def _doubts(images: Images, several: Sequence[Seen], all_of_them: bool) -> tuple[list[str], Found | None]:
    stated = images.fit(several)
    if min(images.shares(several, stated.found)) < REPAIRED:
        stated = max(stated, images.fit(several, thorough=True), key=lambda fit: fit.score)
    whole = _repaired(images, several, stated)
    if whole is not None and stated.share >= REPAIRED:
        stated = max(stated, images.fit(several, thorough=True), key=lambda fit: fit.score)
        whole = whole if whole[1].score > BETTER * stated.score else None
    if whole is not None:
        who = "the views" if all_of_them else f"the {len(several)} views that were looked at"
        seen_as = "the part poorly" if whole[0].factor == 1.0 else "the part at another size"
        seen_as = "no part where the guess has one" if stated.share < POOR else seen_as
        return [f"{who} show {seen_as}, but would fit it if {whole[0].words}."], whole[1].found
    if min(images.shares(several, stated.found)) >= POOR:
        return [], stated.found
    # One view may be wrong and another right.
    by_cause: dict[str, list[str]] = {}
    right: list[Seen] = []
    for seen in several:
        alone = max(images.fit([seen]), images.fit([seen], stated.found), key=lambda fit: fit.score)
        better = _repaired(images, [seen], alone, one_of_several=True)
        mended = seen if better is None else better[0].made(seen)
        if better is not None:
            by_cause.setdefault(better[0].words, []).append(seen.camera.name)
        elif alone.share < POOR:
            by_cause.setdefault("", []).append(seen.camera.name)
            continue
        right += [] if mended is None else [mended]
    lines = [_of_some(names, cause) for cause, names in by_cause.items()]
    together = images.fit(right) if right else None
    if together is None or together.share < POOR:
        return lines, None  # cameras whose errors are larger than a thin part may each be right
    return lines, together.found


def _repaired(
    images: Images, several: Sequence[Seen], stated: Fit, one_of_several: bool = False
) -> tuple[Repair, Fit] | None:
    """The repair under which each image shows the part, and all clearly better than as stated.

    One image alone leaves room for another focal length where the part is beside the guess.
    """
    best: tuple[Repair, Fit] | None = None
    for repair in repairs():
        if (stated.share >= REPAIRED and repair.factor <= 1.0) or (one_of_several and repair.factor != 1.0):
            continue
        made = [repair.made(seen) for seen in several]
        mended = [seen for seen in made if seen is not None]
        if len(mended) < len(made):
            continue
        fit = images.fit(mended, stated.found if stated.share >= REPAIRED else None)
        shown = fit.share >= REPAIRED and min(images.shares(mended, fit.found)) > SEEN
        if shown and fit.score > (max(BETTER * stated.score, 0.0) if best is None else best[1].score):
            best = repair, fit
    return best


def _of_some(names: Sequence[str], cause: str) -> str:
    several = len(names) > 1
    who, s = f"the view{'s' if several else ''} of {listed(names)}", "" if several else "s"
    if cause:
        return f"{who} show{s} no part where the guess has one, but would fit it if {cause}."
    return (
        f"{who} show{s} no part anywhere within the guess: draw the part at the guess over the image; "
        "probably a frame of the camera's pose, or the guess, is wrong."
    )
