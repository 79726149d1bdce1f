"""The seal of a finished capture: a sha256 over all that stands before it, the end's own checksums.

It tells damage, not forgery: whoever changes a file on purpose can write a new seal too.
"""

from __future__ import annotations

import hashlib
from io import BufferedWriter
from typing import Final

SEAL_NAME: Final = "bilprov.seal"
SEAL_HASH: Final = "sha256"
SEAL_BYTES: Final = "bytes"


class HashedFile:
    """A new file that hashes what it is given, in order; nothing is ever written twice."""

    def __init__(self, file: BufferedWriter) -> None:
        self._file = file
        self._hash = hashlib.sha256()

    def write(self, data: bytes | memoryview) -> int:
        """Write and hash. Raises OSError."""
        self._hash.update(data)
        return self._file.write(data)

    def tell(self) -> int:
        """How many bytes were written."""
        return self._file.tell()

    def flush(self) -> None:
        """Hand what was written to the operating system. Raises OSError."""
        self._file.flush()

    def seal(self) -> dict[str, str]:
        """The pairs of the metadata record that vouches for everything written so far."""
        return {SEAL_HASH: self._hash.hexdigest(), SEAL_BYTES: str(self.tell())}
