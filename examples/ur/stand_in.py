"""A simulated arm that speaks RTDE as a UR controller with `impedance.script` does: for trying programs.

    python stand_in.py --seed 31000 --look look.h5

serves at 127.0.0.1:30004, and writes what its two cameras see. `--pace client` moves the clock on with each
command, so that a slow machine loses nothing.
"""

from __future__ import annotations

import argparse
import socket
import socketserver
import struct
import threading
import time
from typing import Any

import mujoco
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bcppl import poses, save
from bcppl.arrays import Array
from bcppl.contact.mujoco_model import build_model
from bcppl.geometry.parts import Part
from bcppl.models.worlds import bench_scene
from bcppl.models.worlds.bench.scene import BenchScene

PORT = 30004
VERSION, URCONTROL, OUTPUTS, INPUTS, START, PAUSE, DATA = 86, 118, 79, 73, 83, 80, 85
TICK = 0.002  # s
CONTROLLER = (5, 12, 0, 0)
FORMATS = {"DOUBLE": "d", "VECTOR6D": "6d", "INT32": "i", "UINT32": "I", "UINT8": "B"}
KINDS = {"timestamp": "DOUBLE", "actual_TCP_pose": "VECTOR6D", "actual_TCP_force": "VECTOR6D"}
POSE = [f"input_double_register_{k}" for k in (18, 19, 20, 21, 22, 42)]
ACROSS, ALONG, ABOUT = (f"input_double_register_{k}" for k in (43, 44, 45))
NUMBER = "input_int_register_18"
DAMPED = 0.06, 0.016  # s: damping over stiffness, along and about
PATIENCE = 0.5  # s that the clock waits for a command, at the client's pace
NOISE = np.array([0.15] * 3 + [0.005] * 3)  # N, N m


class SimulatedArm:
    """A peg on a spring to a commanded pose, beside a part, in MuJoCo."""

    def __init__(self, scene: BenchScene, start: Array, seed: int) -> None:
        self.model = build_model(scene.part, scene.peg, scene.contact)
        self.model.opt.timestep = 0.0005
        self.data = mujoco.MjData(self.model)
        self._noise = np.random.default_rng([seed, 77])
        self.data.qpos[:7] = start
        self._place(1, scene.truth)
        self.command(start, np.full(6, 2500.0))

    def command(self, world_from_peg: Array, stiffness: Array) -> None:
        """Follow a pose (7,)."""
        self._place(0, world_from_peg)
        damping = stiffness * np.repeat(DAMPED, 3)
        self.model.actuator_biasprm[:, 1] = -stiffness
        self.model.actuator_biasprm[:, 2] = -damping

    def advance(self) -> tuple[Array, Array]:
        """The pose (7,) and the wrench (6,) in the peg's frame, one tick later."""
        for _ in range(round(TICK / self.model.opt.timestep)):
            mujoco.mj_step(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        sensed = self.data.sensordata
        return sensed[:7].copy(), -sensed[7:13] + NOISE * self._noise.normal(size=6)

    def _place(self, number: int, pose: Array) -> None:
        self.data.mocap_pos[number], self.data.mocap_quat[number] = pose[:3], pose[3:]


class Controller:
    """The registers, and the newest reading, that all connections share."""

    def __init__(self, arm: SimulatedArm, pace: str) -> None:
        self.arm, self.pace = arm, pace
        self.registers: dict[str, float] = {}
        self.reading: dict[str, Any] = {}
        self.ticked = threading.Condition()
        self.commanded = threading.Event()
        self.running = True
        self._stamp = 0.0

    def run(self) -> None:
        """Move the clock on until `running` is false."""
        begun = time.monotonic()
        while self.running:
            self._tick()
            if self.pace == "client" and self.registers.get(NUMBER, 0):
                self.commanded.wait(PATIENCE)
                self.commanded.clear()
            elif (left := begun + self._stamp - time.monotonic()) > 0.0:
                time.sleep(left)

    def write(self, values: dict[str, float]) -> None:
        """Registers from a client; a new number makes the command in them count."""
        new = values.get(NUMBER, 0) != self.registers.get(NUMBER, 0)
        self.registers.update(values)
        if NUMBER in values and new:
            place = np.array([self.registers.get(name, 0.0) for name in POSE])
            turn = Rotation.from_rotvec(place[3:]).as_quat()[[3, 0, 1, 2]]
            across, along, about = (self.registers.get(name, 1000.0) for name in (ACROSS, ALONG, ABOUT))
            stiffness = np.array([across, across, along, about, about, about])
            self.arm.command(np.concatenate([place[:3], turn]), stiffness)
            self.commanded.set()

    def _tick(self) -> None:
        pose, wrench = self.arm.advance()
        turn = Rotation.from_quat(pose[[4, 5, 6, 3]])
        self._stamp += TICK
        with self.ticked:
            self.reading = {
                "timestamp": [self._stamp],
                "actual_TCP_pose": [*pose[:3], *turn.as_rotvec()],
                "actual_TCP_force": [*turn.apply(wrench[:3]), *turn.apply(wrench[3:])],
            }
            self.ticked.notify_all()


class Connection(socketserver.BaseRequestHandler):
    """One client, by the Real-Time Data Exchange guide, protocol version 2."""

    server: Any

    def handle(self) -> None:
        """Answer until the client has gone."""
        self.request.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._recipes: list[tuple[list[str], list[str]]] = []
        self._outputs: list[str] = []
        try:
            while header := self._received(3):
                size, kind = struct.unpack(">HB", header)
                self._answer(kind, self._received(size - 3))
        except OSError:
            return

    def _answer(self, kind: int, body: bytes) -> None:
        if kind in (VERSION, PAUSE):
            self._send(kind, b"\x01")
        elif kind == URCONTROL:
            self._send(kind, struct.pack(">4I", *CONTROLLER))
        elif kind == OUTPUTS:
            self._outputs = [name for name in body[8:].decode().split(",") if name]
            self._send(kind, b"\x01" + ",".join(KINDS.get(n, "NOT_FOUND") for n in self._outputs).encode())
        elif kind == INPUTS:
            names = [name for name in body.decode().split(",") if name]
            kinds = [_kind_of(name) for name in names]
            self._recipes.append((names, kinds))
            self._send(kind, bytes([len(self._recipes)]) + ",".join(kinds).encode())
        elif kind == START:
            self._send(kind, b"\x01")
            if self._outputs:
                threading.Thread(target=self._stream, daemon=True).start()
        elif kind == DATA:
            names, kinds = self._recipes[body[0] - 1]
            values = struct.unpack(">" + "".join(FORMATS[k] for k in kinds), body[1:])
            self.server.controller.write(dict(zip(names, values, strict=True)))

    def _stream(self) -> None:
        controller = self.server.controller
        try:
            while controller.running:
                with controller.ticked:
                    controller.ticked.wait(1.0)
                    values = [controller.reading[name] for name in self._outputs]
                packed = [struct.pack(f">{len(each)}d", *each) for each in values]
                self._send(DATA, b"\x01" + b"".join(packed))
        except OSError:
            return

    def _send(self, kind: int, body: bytes) -> None:
        self.request.sendall(struct.pack(">HB", len(body) + 3, kind) + body)

    def _received(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            if not (more := self.request.recv(count - len(data))):
                return b""
            data += more
        return data


def _kind_of(register: str) -> str:
    if (
        "double" in register
        or "fraction" in register
        or (register.startswith("standard_analog_output_") and (register[-1] in "01"))
    ):
        return "DOUBLE"
    if "int_register" in register:
        return "INT32"
    return "UINT32" if register == "speed_slider_mask" else "UINT8"


class Server(socketserver.ThreadingTCPServer):
    """A controller that listens."""

    allow_reuse_address = daemon_threads = True

    def __init__(self, controller: Controller, port: int = PORT) -> None:
        super().__init__(("127.0.0.1", port), Connection)
        self.controller = controller


def start_of(scene: BenchScene, peg: Part) -> Array:
    """A pose (7,) of the peg, upright, its tip 60 mm above the middle of the guess."""
    guess = torch.from_numpy(scene.guess.world_from_part)
    upright = poses.identity().numpy().copy()
    upright[:3] = guess[:3].numpy()
    upright[2] += 0.06 - float(peg.vertices[:, 2].min())
    return np.asarray(upright)


def main() -> None:
    """Serve until interrupted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=31000, help="of the bench")
    parser.add_argument("--look", default="look.h5", help="file for what the cameras see")
    parser.add_argument("--pace", choices=["clock", "client"], default="clock")
    parser.add_argument("--port", type=int, default=PORT)
    arguments = parser.parse_args()
    scene = bench_scene(arguments.seed)
    save(scene.look(), arguments.look)
    controller = Controller(SimulatedArm(scene, start_of(scene, scene.peg), arguments.seed), arguments.pace)
    threading.Thread(target=controller.run, daemon=True).start()
    with Server(controller, arguments.port) as server:
        print(
            f"listening at 127.0.0.1:{arguments.port}; the cameras' view is in {arguments.look}", flush=True
        )
        server.serve_forever()


if __name__ == "__main__":
    main()
