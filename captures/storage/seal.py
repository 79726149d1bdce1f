"""The seal of a finished capture: a sha256 over all bytes before it.

The parts after it have checksums of their own. A seal detects damage, not forgery: a person who
changes a file on purpose can write a new seal too.
"""

from __future__ import annotations

import hashlib
from io import BufferedWriter
from typing import Final

SEAL_NAME: Final = "bilprov.seal"
SEAL_HASH: Final = "sha256"
SEAL_BYTES: Final = "bytes"


class HashedFile:
    """A new file that hashes the data as they are written; it is only ever appended to."""

    def __init__(self, file: BufferedWriter) -> None:
        self._file = file
        self._hash = hashlib.sha256()

    def write(self, data: bytes | memoryview) -> int:
        """Write and hash. Raises OSError."""
        self._hash.update(data)
        return self._file.write(data)

    def tell(self) -> int:
        """The number of bytes written."""
        return self._file.tell()

    def flush(self) -> None:
        """Pass the written data to the operating system. Raises OSError."""
        self._file.flush()

    def seal(self) -> dict[str, str]:
        """The pairs of the metadata record that seals all data written so far: hash and size."""
        return {SEAL_HASH: self._hash.hexdigest(), SEAL_BYTES: str(self.tell())}
