"""Unpacks the records of a chunk, at most the size it declares, and checks their checksum."""

from __future__ import annotations

import io
import zlib

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from bilprov.captures.storage.limits import CHUNK_BYTES
from bilprov.captures.storage.records import Damaged, chunk_fields, packed_length

ZSTD_WINDOW = 16 * 1024 * 1024  # bytes; a chunk is no larger


def unpacked_chunk(content: bytes, own: bool) -> tuple[bytes, bool]:
    """Unpack the records of a chunk; also return whether a checksum covers them.

    A CRC of 0 means that there is none, which is accepted from foreign writers only. Raises Damaged
    if anything is not as declared.
    """
    size, crc, compression, start = chunk_fields(content)
    if max(size, len(content) - start) > CHUNK_BYTES:
        raise Damaged(f"a chunk is larger than the {CHUNK_BYTES} bytes allowed")
    if packed_length(content, start) != len(content) - start:
        raise Damaged("a chunk's length does not fit its content")
    data = _unpacked(memoryview(content)[start:], compression, size)
    if len(data) != size:
        raise Damaged("a chunk does not unpack to the size that it declares")
    if crc == 0 and not own:
        return data, False
    if zlib.crc32(data) != crc:
        raise Damaged("a chunk's checksum is wrong")
    return data, True


def _unpacked(packed: memoryview, compression: str, size: int) -> bytes:
    try:
        if compression == "zstd":
            return _zstd(packed, size)
        if compression == "lz4":
            return _lz4(packed, size)
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise Damaged(f"a chunk cannot be unpacked with {compression}") from error
    if compression == "":
        return bytes(packed)
    raise Damaged("a chunk is compressed with something other than zstd and lz4")


def _zstd(packed: memoryview, size: int) -> bytes:
    # Streamed, because the one-call function allocates what the *frame* declares.
    decompressor = zstandard.ZstdDecompressor(max_window_size=ZSTD_WINDOW)
    source = io.BytesIO(packed)
    with decompressor.stream_reader(source, read_across_frames=True) as reader:
        return reader.read(size + 1)


def _lz4(packed: memoryview, size: int) -> bytes:
    data: bytes = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    return data
