"""Decoded batches, packed to about a tenth of the size of their records."""

from __future__ import annotations

import pickle
from io import BytesIO
from typing import Any

import zstandard

from bilprov.analyzer.decode.batch import Batch
from bilprov.analyzer.decode.column_batch import Decoding
from bilprov.spec.protocol import InstructionSpec, ResponseSpec

_LEVEL = 1  # of zstd
_SHARED = (Decoding, InstructionSpec, ResponseSpec)


class PackedBatch:
    """A batch as compressed bytes; what it rests on, its grammar and tables, is left out."""

    def __init__(self, batch: Batch) -> None:
        self._shared: list[Any] = []
        packed = BytesIO()
        with zstandard.ZstdCompressor(_LEVEL).stream_writer(packed, closefd=False) as file:
            _Packer(file, self._shared).dump(batch)
        self._packed = packed.getvalue()

    def batch(self) -> Batch:
        """The batch again."""
        data = zstandard.ZstdDecompressor().decompressobj().decompress(self._packed)
        batch: Batch = _Unpacker(BytesIO(data), self._shared).load()
        return batch

    @property
    def nbytes(self) -> int:
        """How much memory it takes, in bytes."""
        return len(self._packed)


def _shared(place: int) -> Any:
    """The name under which a packed batch asks for what it shares.

    It is only a name: `_Unpacker` looks the place up instead. A persistent id would be simpler, but
    it is asked for each object, which makes packing records twice as slow.
    """
    raise AssertionError(f"place {place} was not looked up by _Unpacker")


class _Packer(pickle.Pickler):
    """Puts what is shared into a list, and its place there into the file."""

    def __init__(self, file: zstandard.ZstdCompressionWriter, shared: list[Any]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._shared = shared

    def reducer_override(self, value: Any) -> Any:
        """How a value is packed; asked once for each object of a class."""
        if not isinstance(value, _SHARED):
            return NotImplemented
        self._shared.append(value)
        return _shared, (len(self._shared) - 1,)


class _Unpacker(pickle.Unpickler):
    """Takes what is shared out of the list again."""

    def __init__(self, file: BytesIO, shared: list[Any]) -> None:
        super().__init__(file)
        self._shared = shared

    def find_class(self, module: str, name: str) -> Any:
        """What a name stands for."""
        found = super().find_class(module, name)
        return self._shared.__getitem__ if found is _shared else found
