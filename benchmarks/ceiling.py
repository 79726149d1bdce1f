"""A C loop on the header that `bilprov spec emit c` writes, compiled on the spot: the ceiling."""

from __future__ import annotations

import ctypes
import subprocess
from pathlib import Path
from typing import NamedTuple

from bilprov.captures.topics import CAR_STATE
from bilprov.spec.emit.c import c_header
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol

MOTIONS = tuple(Motion)
_SOURCE = Path(__file__).with_name("ceiling.c")


class Judged(NamedTuple):
    """What a decoder made of a buffer: the response code due to each frame, and the last state."""

    codes: bytes
    state: tuple[str | int, ...]

    def summary(self) -> list[object]:
        """How many frames each response is due to, and the last state, as values of JSON."""
        counts = {str(code): self.codes.count(code) for code in sorted(set(self.codes))}
        return [counts, list(self.state)]


class Ceiling:
    """The compiled loop, with room for a buffer of `most` bytes."""

    def __init__(self, protocol: Protocol, folder: Path, most: int) -> None:
        motions = ", ".join(motion.name for motion in MOTIONS)
        (folder / "motions.h").write_text(f"enum {{{motions}}};\n", encoding="utf-8")
        (folder / "protocol.h").write_text(c_header(protocol), encoding="utf-8")
        library = folder / "ceiling.so"
        subprocess.run(
            ["cc", "-O2", "-shared", "-fPIC", f"-I{folder}", "-o", library, _SOURCE], check=True
        )
        self._library = ctypes.CDLL(str(library))
        self._library.decode.restype = ctypes.c_size_t
        self._library.prepare()
        self._codes = (ctypes.c_uint8 * most)()
        self._states = (ctypes.c_uint64 * most)()
        self._state = ctypes.c_uint64()

    def reset(self) -> None:
        """Begin again from power-on, at which everything is 0."""
        self._state.value = 0

    def decode(self, data: bytes) -> tuple[int, int]:
        """Judge the whole frames of data; returns how many there are, and their bytes."""
        used = ctypes.c_size_t()
        count = self._library.decode(
            *(data, ctypes.c_size_t(len(data)), self._codes, self._states),
            *(ctypes.byref(self._state), ctypes.byref(used)),
        )
        return int(count), used.value

    def judged(self, data: bytes) -> Judged:
        """The result for data from power-on on."""
        self.reset()
        count, _ = self.decode(data)
        values = (ctypes.c_int16 * len(CAR_STATE.variables)).from_buffer_copy(self._state)
        named = dict(zip(CAR_STATE.variables, values, strict=True))
        state = tuple(MOTIONS[v] if n == "motion" else v for n, v in named.items())
        return Judged(bytes(memoryview(self._codes)[:count]), state)
