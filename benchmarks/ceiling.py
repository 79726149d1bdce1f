"""A C loop on the header that `bilprov spec emit c` writes, compiled on the spot: the ceiling."""

from __future__ import annotations

import ctypes
import subprocess
from pathlib import Path

from bilprov.spec.emit.c import c_header
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol

_SOURCE = Path(__file__).with_name("ceiling.c")


class Ceiling:
    """The compiled loop, with room for a buffer of `most` bytes."""

    def __init__(self, protocol: Protocol, folder: Path, most: int) -> None:
        motions = ", ".join(motion.name for motion in Motion)
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

    def decode(self, data: bytes) -> int:
        """Judge the whole frames of data; returns how many there are."""
        count = self._library.decode(
            *(data, ctypes.c_size_t(len(data)), self._codes, self._states),
            *(ctypes.byref(self._state), ctypes.byref(ctypes.c_size_t())),
        )
        return int(count)

    def judged(self, data: bytes) -> bytes:
        """The code of the response that is due to each frame."""
        return bytes(memoryview(self._codes)[: self.decode(data)])
