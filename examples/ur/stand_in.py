"""A simulated arm that speaks RTDE as a UR controller with `impedance.script` does: for trying programs.

    python -m ur.stand_in --seed 31000 --look look.h5

from the folder above serves at 127.0.0.1:30004, and writes what its two cameras see. `--pace client` moves
the clock on with each command, so that a slow machine loses nothing.
"""

from __future__ import annotations

import socket
import socketserver
import struct
import threading
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from simulated_arm import Clock, Pace, SimulatedArm, options

from bcppl import save
from bcppl.models.worlds import bench_scene

PORT = 30004
VERSION, URCONTROL, OUTPUTS, INPUTS, START, PAUSE, DATA = 86, 118, 79, 73, 83, 80, 85
TICK = 0.002  # s
CONTROLLER = (5, 12, 0, 0)
FORMATS = {"DOUBLE": "d", "VECTOR6D": "6d", "INT32": "i", "UINT32": "I", "UINT8": "B"}
KINDS = {"timestamp": "DOUBLE", "actual_TCP_pose": "VECTOR6D", "actual_TCP_force": "VECTOR6D"}
POSE = [f"input_double_register_{k}" for k in (18, 19, 20, 21, 22, 42)]
ACROSS, ALONG, ABOUT = (f"input_double_register_{k}" for k in (43, 44, 45))
NUMBER = "input_int_register_18"


class Controller:
    """The registers, and the newest reading, that all connections share."""

    def __init__(self, arm: SimulatedArm, pace: Pace) -> None:
        self.arm, self.clock = arm, Clock(pace)
        self.registers: dict[str, float] = {}
        self.reading: dict[str, Any] = {}
        self.ticked = threading.Condition()
        self.running = True
        self._stamp = 0.0

    def run(self) -> None:
        """Move the clock on until `running` is false."""
        while self.running:
            self._tick()
            self.clock.wait(self._stamp)

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
            self.clock.command()

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


def main() -> None:
    """Serve until interrupted."""
    parser = options(__doc__)
    parser.add_argument("--pace", choices=["clock", "client"], default="clock")
    parser.add_argument("--port", type=int, default=PORT)
    arguments = parser.parse_args()
    scene = bench_scene(arguments.seed)
    save(scene.look(), arguments.look)
    controller = Controller(SimulatedArm(scene, TICK), arguments.pace)
    threading.Thread(target=controller.run, daemon=True).start()
    with Server(controller, arguments.port) as server:
        print(
            f"listening at 127.0.0.1:{arguments.port}; the cameras' view is in {arguments.look}", flush=True
        )
        server.serve_forever()


if __name__ == "__main__":
    main()
