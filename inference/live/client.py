"""A client of a served belief, for a robot's program or a notebook.

    with Client("127.0.0.1", port, token) as belief:
        belief.ask("begin", name="touch 1", begin=stamp, seconds=6.0, rate=100.0)
        belief.ask("samples", wrench=rows_of_stamp_and_wrench, pose=rows_of_stamp_and_pose)
        print(belief.ask("belief")["mean"])

What may be asked is in `bcppl.inference.live.session`.
"""

from __future__ import annotations

import socket
from typing import Any

from bcppl.errors import InputError
from bcppl.inference.live.wire import LENGTH, length_of, packed, unpacked


class Client:
    """A connection to `bcppl serve`.

    Args:
        host: of the server.
        port: of the server.
        token: as the server printed it.
        timeout: seconds for an answer.

    Raises:
        InputError: the server cannot be reached, or refuses the token.
    """

    def __init__(self, host: str, port: int, token: str, timeout: float = 90.0) -> None:
        try:
            self._socket = socket.create_connection((host, port), timeout)
        except OSError as error:
            raise InputError(f"no server at {host}:{port} ({error}); start `bcppl serve` there.") from error
        try:
            self._asked({"token": token})
        except BaseException:
            self.close()
            raise

    def ask(self, what: str, **given: Any) -> dict[str, Any]:
        """The answer to a request (`bcppl.inference.live.session`).

        Where it does not come whole and in time, the connection is closed: what came later would be taken for
        the answer to the next request.

        Raises:
            InputError: the server answers with an error, or no more.
        """
        return self._asked({"ask": what, **given})

    def close(self) -> None:
        """End the connection."""
        self._socket.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _asked(self, message: dict[str, Any]) -> dict[str, Any]:
        if self._socket.fileno() < 0:
            raise InputError("the connection is closed, as after a request without an answer; connect again.")
        request = packed(message)
        try:
            self._socket.sendall(request)
            answer = unpacked(self._read(length_of(self._read(LENGTH.size))))
        except OSError as error:
            self.close()
            raise InputError(f"the server does not answer ({error}); connect again.") from error
        except BaseException:
            self.close()
            raise
        if "error" in answer:
            raise InputError(str(answer["error"]))
        return answer

    def _read(self, count: int) -> bytes:
        read = bytearray()
        while len(read) < count:
            if not (more := self._socket.recv(count - len(read))):
                raise InputError("the server has closed the connection; connect again.")
            read += more
        return bytes(read)
