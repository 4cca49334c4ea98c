"""Messages between a run and its workers over a socket, in frames that nothing else writes by accident.

Each frame starts with a token that only the two ends know. A plugin that writes into every descriptor it finds is so
noticed, and costs its own cell. The run's end never waits: what does not fit into the pipe is kept here and goes on its
way when there is room, so a worker that reads nothing cannot hold up the others or the clock.
"""

from __future__ import annotations

import socket
import struct

LENGTH = struct.Struct(">Q")
TOKEN = 16
"""Bytes of a token."""
CHUNK = 1 << 18
"""Bytes read at once."""
BOUND = 1 << 16
"""Bytes that may wait to be sent before a worker gets no more items ahead."""
LARGEST = 1 << 30
"""Bytes of the largest message that is believed."""


class Broken(Exception):
    """Raised when the other end has gone, or sent what is no message."""


class Channel:
    """One end of the socket. ``blocking`` is for the worker, which has nothing else to do than wait."""

    def __init__(self, connection: socket.socket, token: bytes, blocking: bool = False) -> None:
        self._connection, self._token = connection, token
        connection.setblocking(blocking)
        self._arrived = bytearray()
        self._leaving = bytearray()
        self._fault = ""

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._connection.fileno()

    @property
    def waiting(self) -> int:
        """Bytes that are still to be sent."""
        return len(self._leaving)

    def send(self, message: bytes) -> None:
        """Send a message, or as much of it as fits: :meth:`flush` sends the rest."""
        self._leaving += self._token + LENGTH.pack(len(message)) + message
        self.flush()

    def flush(self) -> None:
        """Send what waits; all of it where the socket blocks."""
        while self._leaving:
            try:
                sent = self._connection.send(self._leaving)
            except BlockingIOError:
                return
            except OSError as error:
                raise Broken("it has closed its connection") from error
            del self._leaving[:sent]

    def receive(self) -> list[bytes]:
        """Return the messages that have come: none or more, or one or more where the socket blocks.

        Raises :class:`Broken` at the end, and where the bytes are no message.
        """
        messages: list[bytes] = []
        while not messages:
            if self._fault:
                raise Broken(self._fault)
            try:
                chunk = self._connection.recv(CHUNK)
            except BlockingIOError:
                return messages
            except OSError as error:
                raise Broken("it has closed its connection") from error
            if not chunk:
                raise Broken("it has closed its connection")
            self._arrived += chunk
            try:
                while (message := self._message()) is not None:
                    messages.append(message)
            except Broken as error:
                self._fault = str(error)  # the messages before it still count
        return messages

    def _message(self) -> bytes | None:
        start = TOKEN + LENGTH.size
        if not self._arrived:
            return None
        if self._arrived[:TOKEN] != self._token[: len(self._arrived)]:
            raise Broken("it wrote into the descriptors of the harness")
        if len(self._arrived) < start:
            return None
        size = LENGTH.unpack(self._arrived[TOKEN:start])[0]
        if size > LARGEST:
            raise Broken("it wrote into the descriptors of the harness")
        if len(self._arrived) < start + size:
            return None
        message = bytes(self._arrived[start : start + size])
        del self._arrived[: start + size]
        return message

    def close(self) -> None:
        """Close this end."""
        self._connection.close()
