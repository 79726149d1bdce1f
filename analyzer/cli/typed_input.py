"""Hex as people write it in, bytes out."""

from __future__ import annotations

import re

_BETWEEN = re.compile(r"[\s,:;-]+")
_PREFIX = re.compile(r"^(0x|\\x|\$)", re.IGNORECASE)


def bytes_from_hex(text: str) -> bytes:
    """Bytes from text like `81 05`, `8105`, `0x81,0x05` or `81:05`.

    A single digit between separators is a byte of its own. Raises ValueError, in one sentence, for
    anything else, and where there is no byte at all.
    """
    data = bytearray()
    for word in _BETWEEN.split(text.strip()):
        digits = _PREFIX.sub("", word)
        if not re.fullmatch(r"[0-9a-fA-F]*", digits) or (word and not digits):
            raise ValueError(f"{word!r} is not hex; write bytes like 81 05, 8105 or 0x81,0x05")
        if len(digits) == 1:
            digits = f"0{digits}"
        if len(digits) % 2:
            raise ValueError(f"{word!r} has an odd number of hex digits; two make a byte")
        data += bytes.fromhex(digits)
    if not data:
        raise ValueError("there is no byte here; write bytes in hex, like 81 05")
    return bytes(data)
