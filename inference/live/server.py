"""A live belief on a local socket: many clients, one belief, and no client that holds up another."""

from __future__ import annotations

import asyncio
import hmac
import secrets
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

from bcppl.errors import InputError
from bcppl.inference.live.session import Session
from bcppl.inference.live.wire import GREETING, LARGEST, LENGTH, length_of, packed, unpacked

STALLED = 10.0  # s in which a message that has begun has to be complete, and the first one to come
CLIENTS = 64  # at a time


class Server:
    """Serves a session to clients that know a token.

    A client's first message is `{"token": ...}`; each one after it is a request (`session`), and gets one
    answer. A message that is no map, a wrong token or a stalled message ends that connection, and no other.

    Args:
        session: what is served.
        host: the address that is listened at; "127.0.0.1" is reached from this machine alone.
        port: 0 for one that is free.
        token: what clients have to know; by default a new one.

    Attributes:
        address: host and port, once it listens.

    Raises:
        InputError: the token is empty.
    """

    def __init__(
        self, session: Session, host: str = "127.0.0.1", port: int = 0, token: str | None = None
    ) -> None:
        if token == "":
            raise InputError(
                "the token is empty, which anybody guesses; give another, or none for a new one."
            )
        self.session, self.host, self.port = session, host, port
        self.token = secrets.token_urlsafe(16) if token is None else token
        self.address: tuple[str, int] = (host, port)
        self._clients, self._threads = 0, ThreadPoolExecutor(CLIENTS, "bcppl serve")

    async def listen(self) -> asyncio.Server:
        """Begin to listen.

        Raises:
            InputError: the address cannot be listened at.
        """
        try:
            server = await asyncio.start_server(self._serve, self.host, self.port)
        except OSError as error:
            raise InputError(
                f"{self.host}:{self.port} cannot be listened at ({error.strerror}); give another --port."
            ) from error
        self.address = server.sockets[0].getsockname()[:2]
        return server

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._clients += 1
        try:
            await self._converse(reader, writer)
        except InputError as error:
            with suppress(OSError):
                writer.write(packed({"error": str(error)}))
        except (OSError, asyncio.IncompleteReadError, TimeoutError, asyncio.CancelledError):
            pass  # it has gone or has stalled, or the server ends: asyncio would print a cancelled handler
        finally:
            self._clients -= 1
            writer.close()
            with suppress(OSError, asyncio.CancelledError):
                await writer.wait_closed()

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._clients > CLIENTS:
            raise InputError(f"there are {CLIENTS} clients already; close one.")
        hello = unpacked(await asyncio.wait_for(_body(reader, most=GREETING), STALLED))
        given = hello.get("token")
        if not isinstance(given, str) or not hmac.compare_digest(given.encode(), self.token.encode()):
            raise InputError("the token is wrong; send {'token': ...} first, as the server printed it.")
        await _send(writer, {"ok": True})
        while (header := await reader.read(1)) != b"":
            request = await asyncio.wait_for(_body(reader, header), STALLED)
            answering = asyncio.get_running_loop().run_in_executor(self._threads, self._answer, request)
            await _send(writer, await answering)

    def _answer(self, request: bytes) -> dict[str, object]:
        """The answer to a message, which is read in a thread, so that no other client waits for it."""
        return self.session.answer(unpacked(request))


async def _body(reader: asyncio.StreamReader, begun: bytes = b"", most: int = LARGEST) -> bytes:
    header = begun + await reader.readexactly(LENGTH.size - len(begun))
    return await reader.readexactly(length_of(header, most))


async def _send(writer: asyncio.StreamWriter, message: dict[str, object]) -> None:
    """Send a message to a client that reads; one that does not is dropped."""
    writer.write(packed(message))
    await asyncio.wait_for(writer.drain(), STALLED)
