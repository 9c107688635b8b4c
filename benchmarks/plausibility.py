"""Whether `bcppl check` doubts recordings that are wrong, with the right cause, and leaves right ones alone.

Scenes of the accuracy bench are seen and touched by a probe that rocks, planned for a belief a millimetre
wide about the truth, so nothing is inferred. Right recordings are of a bench without errors, and of one with
all those of a real bench; they are also given with one view or none, with a guess that is wider or beside the
truth. Then each usual mistake is made in each recording. A mistake is named if a doubt has its words and
there is no other doubt. Some mistakes cannot be distinguished from what a right recording may hold; their
rows have no goal.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from mistakes import at_flange, clock_off, forces_reversed, peg_turned, touches_changed
from report import Row, finish, options, show
from scipy.spatial.transform import Rotation

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.inference.planning.metrology import three_two_one
from bcppl.inference.planning.metrology_parameters import ROCKED
from bcppl.models import load_recording
from bcppl.models.worlds.bench.parameters import BenchParameters
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.sensors.depth import DepthImage, View
from bcppl.sensors.measurements import Measurement, Recording
from bcppl.sensors.plausibility import doubts
from bcppl.sensors.probe import ProbeWindow

Array = np.ndarray
NAMED, SILENT, SECONDS = 90.0, 0.0, 1.0  # %, %, s
SHIPPED = ("peg_probe", "point_probe_10_pushes")


class Mistake(NamedTuple):
    """How a right recording is made a wrong one, and words by which a doubt names it.

    Without words it cannot be named; a doubt with another cause is wrong then too.
    """

    made: Callable[[Recording], Recording]
    words: str


def viewed(change: Callable[[Any, Array], tuple[dict[str, Any], Array]], only: int | None = None) -> Any:
    """A mistake in all views, or in one: a camera and its depth are changed to wrong ones."""

    def made(recording: Recording) -> Recording:
        measurements: list[Measurement] = []
        views = 0
        for m in recording.measurements:
            if isinstance(m.action, View):
                if only in (None, views):
                    fields, depth = change(m.action.camera, np.asarray(m.observation.depth))
                    m = Measurement(View(replace(m.action.camera, **fields)), DepthImage(depth))
                views += 1
            measurements.append(m)
        return replace(recording, measurements=measurements)

    return made


def posed(change: Callable[[Rotation, Array], tuple[Rotation, Array]], only: int | None = None) -> Any:
    """A mistake in the cameras' poses, of their rotations and places."""

    def wrong(camera: Any, depth: Array) -> tuple[dict[str, Any], Array]:
        pose = np.asarray(camera.world_from_camera)
        turn, place = change(Rotation.from_quat(pose[3:], scalar_first=True), pose[:3])
        return {"world_from_camera": np.array([*place, *turn.as_quat(scalar_first=True)])}, depth

    return viewed(wrong, only)


def scaled(factor: float) -> Any:
    return viewed(lambda _, depth: ({}, factor * depth))


def focal(factor: float) -> Any:
    return viewed(lambda camera, depth: ({"fx": factor * camera.fx, "fy": factor * camera.fy}, depth))


def misread(turn: Rotation) -> Rotation:
    """The rotation of which the numbers x y z w are read as w x y z."""
    return Rotation.from_quat(turn.as_quat(), scalar_first=True)


def hand_eye_inverted(recording: Recording) -> Recording:
    """Views of a camera at a wrist, whose pose is composed with the inverse of its hand-eye calibration."""
    wrist_from_camera = np.array(
        [0.06, 0.01, 0.04, *Rotation.from_rotvec([0.3, 0.1, 0.2]).as_quat(scalar_first=True)]
    )
    calibration = torch.from_numpy(wrist_from_camera)
    back = poses.inverse(calibration)

    def wrong(camera: Any, depth: Array) -> tuple[dict[str, Any], Array]:
        world_from_wrist = poses.compose(torch.as_tensor(camera.world_from_camera), back)
        there = poses.compose(world_from_wrist, back).numpy()
        return {"world_from_camera": there, "wrist_from_camera": back.numpy()}, depth

    return viewed(wrong)(recording)


def opengl(turn: Rotation, place: Array) -> tuple[Rotation, Array]:
    return turn * Rotation.from_euler("x", 180.0, degrees=True), place


def inverted(turn: Rotation, place: Array) -> tuple[Rotation, Array]:
    return turn.inv(), -turn.inv().apply(place)


def pegs_misread(recording: Recording) -> Recording:
    def wrong(wrench: Array, pose: Array) -> tuple[Array, Array]:
        turn = misread(Rotation.from_quat(pose[:, 3:], scalar_first=True))
        return wrench, np.hstack([pose[:, :3], turn.as_quat(scalar_first=True)])

    return touches_changed(recording, wrong)


def wrench_scaled(force: float, torque: float) -> Callable[[Recording], Recording]:
    scale = np.array([force] * 3 + [torque] * 3)
    return lambda recording: touches_changed(recording, lambda wrench, pose: (wrench * scale, pose))


def about_sensor(recording: Recording) -> Recording:
    """The torques are about an origin 60 mm above the peg's."""

    def wrong(wrench: Array, pose: Array) -> tuple[Array, Array]:
        moved = wrench[:, 3:] - np.cross([0.0, 0.0, 0.06], wrench[:, :3])
        return np.hstack([wrench[:, :3], moved]), pose

    return touches_changed(recording, wrong)


def displaced(recording: Recording) -> Recording:
    """The peg's poses are those of another world, a decimetre beside."""
    beside = np.array([0.1, 0.05, 0.0, 0.0, 0.0, 0.0, 0.0])
    return touches_changed(recording, lambda wrench, pose: (wrench, pose + beside))


def yaw_of_poses(degrees: float) -> Callable[[Recording], Recording]:
    """The measured poses lack the peg's yaw; the wrench is in the frame of the peg as it was."""

    def wrong(wrench: Array, pose: Array) -> tuple[Array, Array]:
        turn = Rotation.from_quat(pose[:, 3:], scalar_first=True)
        turned = turn * Rotation.from_euler("z", degrees, degrees=True)
        return wrench, np.hstack([pose[:, :3], turned.as_quat(scalar_first=True)])

    return lambda recording: touches_changed(recording, wrong)


def peg_longer(metres: float) -> Callable[[Recording], Recording]:
    """The stated peg is longer than the one that was held."""

    def made(recording: Recording) -> Recording:
        assert recording.peg is not None
        vertices = np.array(recording.peg.vertices)
        vertices[vertices[:, 2] < vertices[:, 2].min() + 1e-6, 2] -= metres
        return replace(recording, peg=replace(recording.peg, vertices=vertices))

    return made


def command_still(recording: Recording) -> Recording:
    measurements: list[Measurement] = []
    for m in recording.measurements:
        if isinstance(m.action, ProbeWindow):
            probe = m.action.probe
            still = replace(probe, command=np.repeat(probe.command[:1], len(probe.command), axis=0))
            m = replace(m, action=replace(m.action, probe=still))
        measurements.append(m)
    return replace(recording, measurements=measurements)


QUATERNION = "written x y z w"
MISTAKES: Mapping[str, Mistake] = {
    "depth in millimetres": Mistake(scaled(1000.0), "depth is in millimetres"),
    "depth scaled twice": Mistake(scaled(0.001), "scaled to metres twice"),
    "camera quaternions x y z w": Mistake(
        posed(lambda turn, place: (misread(turn), place)), f"world_from_camera is {QUATERNION}"
    ),
    "cameras of OpenGL": Mistake(posed(opengl), "OpenGL"),
    "one camera of OpenGL": Mistake(posed(opengl, 0), "'camera_0' shows no part where the guess has one"),
    "camera poses inverted": Mistake(posed(inverted), "world_from_camera is inverted"),
    "hand-eye inverted": Mistake(hand_eye_inverted, "hand-eye calibration is inverted"),
    "images upside down": Mistake(viewed(lambda _, depth: ({}, depth[::-1, ::-1])), "upside down"),
    "focal length halved": Mistake(focal(0.5), "about 2 times the stated"),
    "focal length doubled": Mistake(focal(2.0), "about 0.5 times the stated"),
    "focal length times 1.3": Mistake(focal(1.3), "about 0.8 times the stated"),
    "peg quaternions x y z w": Mistake(pegs_misread, f"world_from_peg is {QUATERNION}"),
    **{
        f"peg pose {1e3 * d:.0f} mm along": Mistake(
            lambda recording, d=d: at_flange(recording, d), "of the flange or of another tool frame"
        )
        for d in (-0.3, -0.12, -0.05, 0.05, 0.12, 0.3)
    },
    "torques in N mm": Mistake(wrench_scaled(1.0, 1e3), "torques are in N mm"),
    "forces in kN": Mistake(wrench_scaled(1e-3, 1.0), "kilonewtons"),
    "forces in mN": Mistake(wrench_scaled(1e3, 1.0), "millinewtons"),
    "forces and torques in mN": Mistake(
        wrench_scaled(1e3, 1e3), "millinewtons, scale them by 0.001, and torques"
    ),
    "torques of the wrong sign": Mistake(wrench_scaled(1.0, -1.0), "take -torque"),
    "torques of zero": Mistake(wrench_scaled(1.0, 0.0), "torques that are all zero"),
    "torques about the sensor": Mistake(about_sensor, "about the sensor's origin"),
    "forces of the wrong sign": Mistake(forces_reversed, "take -wrench"),
    "peg 100 mm beside": Mistake(displaced, "wherever that is within the guess"),
    "command never changes": Mistake(command_still, "a command that never changes"),
    "wrench 0.2 s late": Mistake(lambda r: clock_off(r, 0.2), "s late"),
    "yaw of poses off by 90°": Mistake(yaw_of_poses(90.0), "its yaw in the hand"),
    "yaw of poses off by 45°": Mistake(yaw_of_poses(45.0), "its yaw in the hand"),
    "yaw of poses and wrench off by 45°": Mistake(lambda r: peg_turned(r, 45.0), ""),
    "peg stated 3 mm longer": Mistake(peg_longer(0.003), ""),
    "peg stated 3 mm shorter": Mistake(peg_longer(-0.003), ""),
}


def views_kept(count: int) -> Callable[[Recording], Recording]:
    def made(recording: Recording) -> Recording:
        views = [m for m in recording.measurements if isinstance(m.action, View)]
        others = [m for m in recording.measurements if not isinstance(m.action, View)]
        return replace(recording, measurements=[*views[:count], *others])

    return made


def windows_left_out(recording: Recording) -> Recording:
    """The recording's views alone."""
    return replace(recording, measurements=[m for m in recording.measurements if isinstance(m.action, View)])


def guessed(**fields: Any) -> Callable[[Recording], Recording]:
    return lambda recording: replace(recording, guess=replace(recording.guess, **fields))


def beside(metres: float) -> Callable[[Recording], Recording]:
    """The guess's centre is so far from the truth along x; its limit is 20 mm."""

    def made(recording: Recording) -> Recording:
        center = np.array(recording.guess.world_from_part)
        center[:3] = np.asarray(recording.truth)[:3] - [metres, 0.0, 0.0]
        return guessed(world_from_part=center)(recording)

    return made


RIGHT: Mapping[str, Callable[[Recording], Recording]] = {
    "as it is": lambda recording: recording,
    "one view": views_kept(1),
    "no view": views_kept(0),
    "any yaw": guessed(yaw=np.pi),
    "guess of ±50 mm": guessed(translation=np.full(3, 0.05)),
    "truth at the edge": beside(0.0199),
    "truth 10 mm outside": beside(0.03),
}


def recorded(scene: BenchScene) -> Recording:
    """The views of a scene, and a probe that is planned for about where the part is."""
    generator = torch.Generator().manual_seed(scene.seed)
    spread = torch.tensor([0.001] * 3 + [0.01] * 3, dtype=torch.float64)
    draws = spread * torch.randn(60, 6, dtype=torch.float64, generator=generator)
    belief = Belief(poses.retract(torch.as_tensor(scene.truth).expand(60, 7), draws), torch.zeros(60))
    return scene.probe(three_two_one(belief, scene.part, scene.peg, ROCKED))


def outcome(recording: Recording, mistake: Mistake) -> tuple[bool, bool, list[str]] | None:
    """Whether a mistake is named alone, whether any is, and the doubts; None if it is no mistake."""
    try:
        wrong = mistake.made(recording)
    except InputError:
        return None  # a round peg has no yaw
    found = doubts(wrong)
    return len(found) == 1 and bool(mistake.words) and mistake.words in found[0], bool(found), found


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument(
        "--scenes", type=int, default=20, help="of each mistake; half as many again are right"
    )
    parser.add_argument("--only", nargs="+", default=list(MISTAKES), choices=list(MISTAKES))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    count = 2 if arguments.quick else arguments.scenes
    seeds = range(arguments.seed, arguments.seed + count * 3 // 2)
    benches = {"no errors": None, "a real bench": BenchParameters.real()}
    good = {name: [recorded(bench_scene(s, bench)) for s in seeds] for name, bench in benches.items()}
    rows: list[Row] = []
    lines: list[Sequence[Any]] = []
    seconds = []
    for bench, recordings in good.items():
        for name, made in RIGHT.items():
            alarms = []
            for recording in recordings:
                begin = time.process_time()
                alarms += doubts(made(recording))[:1]
                seconds.append(time.process_time() - begin)
            rate = 100.0 * len(alarms) / len(recordings)
            rows.append(Row(f"right, {bench}, {name}: doubted", rate, f"% of {len(recordings)}", SILENT))
            print(rows[-1].name, f"{rate:.0f} %", alarms[:2], flush=True)
    shipped = sum(len(doubts(load_recording(name))) for name in SHIPPED)
    rows.append(Row("shipped recordings: doubts", shipped, "", 0.0))
    rows.append(Row("time of a right recording, median", float(np.median(seconds)), "s of a core", SECONDS))
    for name in arguments.only:
        mistake, line = MISTAKES[name], [name]
        for bench, recordings in good.items():
            tried = [outcome(recording, mistake) for recording in recordings[:count]]
            several = [one for one in tried if one is not None]
            named = 100.0 * float(np.mean([one[0] for one in several]))
            doubted = 100.0 * float(np.mean([one[1] for one in several]))
            line += [len(several), named, doubted]
            goal = NAMED if mistake.words else None
            rows.append(Row(f"{name}, {bench}: named", named, f"% of {len(several)}", goal, "min"))
            rows.append(Row(f"{name}, {bench}: doubted", doubted, f"% of {len(several)}"))
            missed = [one[2] for one in several if not one[0]]
            print(f"{name}, {bench}: named {named:.0f} %, doubted {doubted:.0f} %", missed[:2], flush=True)
        lines.append(line)
    columns = [f"{word}, {bench}" for bench in benches for word in ("of", "named %", "doubted %")]
    show("mistakes", ["", *columns], lines)
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()
