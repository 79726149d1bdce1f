"""Decoded batches, packed to about a tenth of the size of their records."""

from __future__ import annotations

import pickle
from io import BytesIO
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

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
            pickler = pickle.Pickler(file, pickle.HIGHEST_PROTOCOL)
            # A persistent id is asked for each object: packing records would be twice as slow.
            pickler.dispatch_table = {np.ndarray: _steps, **dict.fromkeys(_SHARED, self._share)}
            pickler.dump(batch)
        self._packed = packed.getvalue()

    def _share(self, value: Any) -> tuple[Any, ...]:
        """Keep a value beside the packed bytes, which have its place there."""
        self._shared.append(value)
        return _shared, (len(self._shared) - 1,)

    def batch(self) -> Batch:
        """The batch again."""
        data = zstandard.ZstdDecompressor().decompressobj().decompress(self._packed)
        batch: Batch = _Unpacker(BytesIO(data), self._shared).load()
        return batch

    @property
    def nbytes(self) -> int:
        """How much memory it takes, in bytes."""
        return len(self._packed)


def _steps(array: NDArray[Any]) -> Any:
    """How an array is packed: 64-bit integers as steps, in as few bytes as each of them takes."""
    if array.dtype != np.int64 or array.ndim != 1 or not len(array):
        return array.__reduce_ex__(pickle.HIGHEST_PROTOCOL)
    steps = np.diff(array)
    ends = (steps.min(initial=0), steps.max(initial=0))
    small = np.result_type(*map(np.min_scalar_type, ends))
    return _summed, (int(array[0]), steps.astype(small))


def _summed(first: int, steps: NDArray[np.integer]) -> NDArray[np.int64]:
    """The integers with these steps between them."""
    array = np.empty(len(steps) + 1, np.int64)
    array[0], array[1:] = first, steps
    return array.cumsum(out=array)


def _shared(place: int) -> Any:
    """The name under which a packed batch asks for what it shares; `_Unpacker` looks it up."""
    raise AssertionError(f"place {place} was not looked up by _Unpacker")


class _Unpacker(pickle.Unpickler):
    """Takes what is shared out of the list again."""

    def __init__(self, file: BytesIO, shared: list[Any]) -> None:
        super().__init__(file)
        self._shared = shared

    def find_class(self, module: str, name: str) -> Any:
        """What a name stands for."""
        found = super().find_class(module, name)
        return self._shared.__getitem__ if found is _shared else found
