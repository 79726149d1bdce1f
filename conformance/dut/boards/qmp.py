"""QEMU's monitor protocol (QMP): a command per line of JSON, a reply to each, events between."""

from __future__ import annotations

import json
import re
import select
import socket
from typing import Any

from bilprov.conformance.dut.boards import EmulatorError

_PATIENCE = 10.0  # s within which it must reply
_BYTE = re.compile(r"0x([0-9a-f]{2})\b")


class Monitor:
    """A client of QEMU's monitor over a socket. Raises EmulatorError once QEMU has ended."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._held = b""

    def greet(self) -> None:
        """Read QEMU's greeting and enter command mode; the machine runs from then on."""
        self._reply()
        self._send("qmp_capabilities")
        self._reply()

    def dump(self, address: int, count: int) -> bytes:
        """`count` bytes of memory from `address` on."""
        self.ask_dump(address, count)
        while (data := self.take_dump()) is None:
            self._wait()
        return data

    def ask_dump(self, address: int, count: int) -> None:
        """Request `count` bytes of memory; `take_dump` returns them once `fileno` is readable."""
        self._send("human-monitor-command", **{"command-line": f"xp /{count}xb {address:#x}"})

    def take_dump(self) -> bytes | None:
        """The bytes requested, None while the reply is not complete."""
        reply = self._next()
        if reply is None:
            return None
        # Each line of the text is an address, a colon and bytes.
        lines = str(reply.get("return", "")).splitlines()
        found = (_BYTE.findall(line.partition(":")[2]) for line in lines)
        return bytes(int(byte, 16) for bytes_ in found for byte in bytes_)

    def fileno(self) -> int:
        """The file descriptor that is readable when data have come."""
        return self._connection.fileno()

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def _send(self, order: str, **arguments: str) -> None:
        words: dict[str, Any] = {"execute": order}
        if arguments:
            words["arguments"] = arguments
        try:
            self._connection.sendall(json.dumps(words).encode() + b"\n")
        except OSError as error:
            raise EmulatorError("the emulator has ended") from error

    def _reply(self) -> dict[str, Any]:
        while (reply := self._next()) is None:
            self._wait()
        return reply

    def _wait(self) -> None:
        if not select.select([self._connection], [], [], _PATIENCE)[0]:
            raise EmulatorError(f"the emulator has not answered for {_PATIENCE:g} s")

    def _next(self) -> dict[str, Any] | None:
        """The next complete reply, None if there is none yet; events are skipped."""
        if b"\n" not in self._held:
            try:
                data = self._connection.recv(1 << 16)
            except OSError:
                data = b""
            if not data:
                raise EmulatorError("the emulator has ended")
            self._held += data
        while b"\n" in self._held:
            line, _, self._held = self._held.partition(b"\n")
            reply = json.loads(line)
            if "event" not in reply:
                return dict(reply)
        return None
