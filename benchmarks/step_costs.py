"""What one step of contact physics costs, by part: free and in contact, by how many contacts.

Scenes of the accuracy bench, each with another part, are stepped by bare MuJoCo through the probe that
`accuracy.py` plans, with the part at its true pose and with the contact that inference assumes. A part's
pieces are convex, so that a round wall has as many as it has sides, and each that is touched gives up to four
contacts.
"""

from __future__ import annotations

import time

import mujoco
import numpy as np
from double_contacts import PLANS, USUAL, recorded_scene
from report import Row, finish, options, show

from bcppl.arrays import Array
from bcppl.contact.mujoco_model import build_model, pieces_of, rollout_controls, set_controller
from bcppl.models.worlds.bench.scene import BenchScene
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.sensors.likelihoods.simulated_probe import CONTACT

NOISE = 0.00005  # m, of the peg's measured position
COLUMNS = ("us", "contacts", "iterations")


def stepped(scene: BenchScene, probe: Probe) -> Array:
    """Time (us), contacts and iterations of the solver (S, 3) of each step of a probe."""
    model = build_model(scene.part, scene.peg, CONTACT)
    set_controller(model, probe)
    lasts = probe.stamps[-1] - probe.command_times[0]
    times = probe.command_times[0] + CONTACT.time_step * np.arange(round(lasts / CONTACT.time_step))
    control, data = rollout_controls(probe, times), mujoco.MjData(model)
    data.qpos[:] = control[0, 6:]
    data.mocap_pos[1], data.mocap_quat[1] = scene.truth[:3], scene.truth[3:]
    rows = np.empty((len(times), len(COLUMNS)))
    for row, now in zip(rows, control, strict=True):
        data.ctrl[:], data.mocap_pos[0], data.mocap_quat[0] = now[:6], now[6:9], now[9:]
        begun = time.perf_counter()
        mujoco.mj_step(model, data)
        row[:] = 1e6 * (time.perf_counter() - begun), data.ncon, data.solver_niter[0]
    return rows


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--scenes", type=int, default=10, help="how many, from the seed on")
    parser.add_argument("--probe", choices=[USUAL, *PLANS], default=USUAL)
    arguments = parser.parse_args()
    lines, rows = [], []
    for seed in range(arguments.seed, arguments.seed + (2 if arguments.quick else arguments.scenes)):
        scene, recording = recorded_scene(seed, NOISE, arguments.probe)
        probe = next(m.action.probe for m in recording.measurements if isinstance(m.action, ProbeWindow))
        each = np.stack([stepped(scene, probe) for _ in range(3)])
        each[..., 0] = np.median(each[..., 0], axis=0)
        steps = each[0]
        touching = steps[:, 1] > 0
        mean, free = float(steps[:, 0].mean()), float(np.median(steps[~touching, 0]))
        in_contact, contacts = steps[touching].mean(axis=0), np.quantile(steps[touching, 1], [0.5, 0.9])
        costs = mean, free, 100.0 * touching.mean(), in_contact[0], in_contact[2]
        lines.append([seed, scene.part.name, len(pieces_of(scene.part)), *costs, *contacts])
        rows.append(Row(f"{seed}, {scene.part.name}: a step", mean, "us"))
    columns = ["seed", "part", "pieces", "us a step", "free us", "touching %", "touching us", "iterations"]
    show("bare MuJoCo at the true pose", [*columns, "contacts", "90 %"], lines)
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()
