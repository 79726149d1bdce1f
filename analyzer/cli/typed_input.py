"""Parses what a user types: instructions (`LED rgb=5`), hex bytes, files of recorded bytes.

Recorded bytes are JSON lines like `{"t": 0.5, "dir": "host", "hex": "5556"}`, or hex text.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click
import msgspec

from bilprov.analyzer.files import from_json, read_text
from bilprov.captures.parts import kept_parts
from bilprov.captures.schemas import Chunk, Direction
from bilprov.captures.text import near, printable
from bilprov.spec.codec import Judgement, build, free_parts
from bilprov.spec.data import FieldSpec
from bilprov.spec.layout import Part
from bilprov.spec.protocol import InstructionSpec, Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.decode.batch import Batch

PAUSE = "pause="
SEPARATOR = ";"
"""Stands between instructions on a typed line; elsewhere it may only separate bytes."""
_LONGEST_PAUSE = 60_000  # ms


def bytes_or_pause(protocol: Protocol, item: str, others: Iterable[str] = ()) -> bytes | float:
    """Parse what is typed to be sent: an instruction or hex as bytes, `pause=MS` as seconds.

    `others` are words that may have been meant. Raises ValueError, in one sentence.
    """
    if SEPARATOR in item:
        try:
            return bytes_from_hex(item)
        except ValueError:
            raise ValueError(
                f"{item!r} holds a {SEPARATOR}, which stands between typed instructions only; "
                f"here each is an item of its own, like 'Speed 80' {PAUSE}500 '81 05'"
            ) from None
    if item.startswith(PAUSE):
        try:
            pause = float(item.removeprefix(PAUSE))
        except ValueError:
            pause = -1.0
        if not 0 <= pause <= _LONGEST_PAUSE:
            raise ValueError(
                f"{item!r} is not a pause; write {PAUSE}MS with 0 to {_LONGEST_PAUSE} milliseconds"
            )
        return pause / 1000
    name, *words = item.split() or [""]
    specs = _by_name(protocol)
    if name.lower() in specs:
        return encoded(protocol, name, words)
    try:
        return bytes_from_hex(item)
    except ValueError as error:
        names = [spec.name for spec in specs.values()]
        guess = meant(name, [*names, *others]) or f": {', '.join(names)}"
        raise ValueError(f"{error}, or an instruction{guess}") from error


def _by_name(protocol: Protocol) -> dict[str, InstructionSpec]:
    """The instructions by their names in lower case."""
    return {spec.name.lower(): spec for spec in protocol.instructions}


def requests_typed(protocol: Protocol, text: str | None, sender: str) -> tuple[Judgement, ...]:
    """The requests of `--request`, which the `sender` answers; none where it is not given.

    Raises ValueError, in one sentence, for what is no request that is answered.
    """
    if text is None:
        return ()
    if sender == "host":
        raise ValueError("--request is what an answer is to: give --from device too")
    from bilprov.spec.explain import requests_of

    name, *words = text.split() or [""]
    named = name.lower() in _by_name(protocol)
    asked = encoded(protocol, name, words) if named else bytes_from_hex(text)
    return requests_of(protocol, asked)


def encoded(protocol: Protocol, name: str, words: Sequence[str]) -> bytes:
    """Encode an instruction as its frame.

    `words` are `field=value`, or bare values for the fields in order; `address=value` for the
    address of the frame. Numbers are decimal, 0x hex or 0b binary, several have commas between
    them; bytes are hex. Raises ValueError, in one sentence, for anything that is not allowed.
    """
    specs = _by_name(protocol)
    spec = specs.get(name.lower())
    if spec is None:
        names = [spec.name for spec in specs.values()]
        raise ValueError(
            f"there is no instruction {name!r}{meant(name, names)}; there are {', '.join(names)}"
        )
    return build(protocol, spec.name, _values(protocol, spec, words))


def _values(protocol: Protocol, spec: InstructionSpec, words: Sequence[str]) -> dict[str, Any]:
    """The values of the fields and of the other parts of a frame, each as it was typed."""
    fields = {part.name.lower(): part for part in spec.fields if part.constant is None}
    parts = {part.name.lower(): part for part in free_parts(protocol)}
    besides = [f"{part.name}={part.low}..{part.high}" for part in parts.values()]
    takes = " ".join(filter(None, [fields_in_words(spec), *besides])) or "no values"
    bare = [word for word in words if "=" not in word]
    if len(bare) > len(fields):
        raise ValueError(f"{spec.name} takes {takes}; got {' '.join(words)}")
    pairs = list(zip(fields, bare, strict=False))
    pairs += [(name, word) for name, equals, word in (w.partition("=") for w in words) if equals]
    values: dict[str, Any] = {}
    for name, word in pairs:
        field = fields.get(name.lower()) or protocol.named_registers.get(name)
        owner = field or parts.get(name.lower())
        if owner is None:
            known = [*(p.name for p in fields.values()), *(p.name for p in parts.values())]
            raise ValueError(
                f"{spec.name} has no field {name!r}{meant(name, known)}; it takes {takes}"
            )
        where = f"{spec.name}.{owner.name}"
        if owner.name in values:
            raise ValueError(f"{where} is given twice")
        if word in protocol.named_registers:
            values[owner.name] = word
        else:
            values[owner.name] = (
                _value(where, field, word) if field else _number(where, word, owner)
            )
    return values


def _value(name: str, part: FieldSpec, word: str) -> Any:
    """The value of a field: a number, a name, bytes in hex, or numbers with commas between."""
    if part.many is None:
        return _named_number(name, word, part)
    if part.many.element is None:
        try:
            return bytes.fromhex(word)
        except ValueError:
            raise ValueError(f"{name} is {word!r}, allowed are bytes in hex, like 01ff") from None
    return [_named_number(name, one, part) for one in word.split(",")] if word else []


def _named_number(name: str, word: str, part: FieldSpec) -> int:
    known = dict(part.names).get(word)
    return _number(name, word, part) if known is None else known


def _number(name: str, word: str, part: FieldSpec | Part) -> int:
    for base in (0, 10):  # base 0 refuses leading zeros
        try:
            return int(word, base)
        except ValueError:
            continue
    allowed = part.allowed if isinstance(part, FieldSpec) else f"{part.low} to {part.high}"
    raise ValueError(f"{name} is {word!r}, which is not a number; allowed are {allowed}")


def fields_in_words(spec: InstructionSpec) -> str:
    """The fields of an instruction with what they allow, like `rgb=0..7` and `values=HEX`."""
    return " ".join(
        f"{part.name}={part.allowed_in_short}" for part in spec.fields if part.constant is None
    )


def meant(word: str, names: Iterable[str]) -> str:
    """A question after the name that `word` may stand for, in any case; "" if there is none."""
    found = near(word, names)
    return f", did you mean {found}?" if found else ""


def file_or_bytes(words: Sequence[str]) -> Path | bytes:
    """The file that words name, or recording in parts, or the bytes that they are in hex.

    Raises ClickException, in one sentence, for neither.
    """
    path = Path(words[0])
    # Those of Path raise where it is too long for a name; then it may be hex.
    is_file = os.path.exists(path) and not os.path.isdir(path)  # noqa: PTH110, PTH112
    if len(words) == 1 and (is_file or kept_parts(path)):
        return path
    try:
        return bytes_from_hex(" ".join(words))
    except ValueError as error:
        if len(words) == 1 and os.path.lexists(path):
            return path  # a folder, or a link to nothing: what reads it reports that
        files = "there is no such file, and " if len(words) == 1 else ""
        raise click.ClickException(f"{files}{error}") from None


_BETWEEN = re.compile(r"[\s,:;-]+")


_PREFIX = re.compile(r"^(0x|\\x|\$)", re.IGNORECASE)


def bytes_from_hex(text: str) -> bytes:
    """Parse bytes from text like `81 05`, `8105`, `0x81,0x05` or `81:05`.

    A single digit between separators is a byte of its own. Raises ValueError, in one sentence, for
    anything else, and if there is no byte.
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


_MOST = 1 << 26  # bytes of a file
_BEGINNING = 64  # bytes of it that are looked at
_OBJECT = re.compile(rb'\s*\{\s*["}][^\x00-\x08\x0e-\x1f\x7f]*')
_LATEST = 4e9  # s before and after 0: the ns between any two times then fit into 64 bits


class RecordedBytes(msgspec.Struct):
    """A line of recorded bytes: its time in s, who sent them, and the bytes in hex.

    The JSON lines of the kit have the key `direction`, null where a line has no bytes.
    """

    t: Annotated[float, msgspec.Meta(ge=-_LATEST, le=_LATEST)]
    hex: str
    dir: Direction | None = None
    direction: Direction | None = None


def are_json_lines(path: Path) -> bool:
    """Whether a file begins as a JSON object does, without control characters, also damaged."""
    with path.open("rb") as file:
        return _OBJECT.fullmatch(file.read(_BEGINNING)) is not None


def recorded_chunks(path: Path, sender: Direction) -> list[Chunk]:
    """The bytes in a file of JSON lines, by their times, or of hex text from a sender.

    Raises ClickException.
    """
    try:
        text = read_text(path, _MOST)
    except OSError as error:
        raise click.ClickException(
            f"{printable(str(path))} cannot be read: {error.strerror}; name a capture (.mcap), "
            "JSON lines or hex text"
        ) from error
    if not text.lstrip().startswith("{"):
        try:
            return [Chunk(0, sender, bytes_from_hex(text))]
        except ValueError as error:
            what = f"{printable(str(path))} is neither a capture nor JSON lines"
            raise click.ClickException(f"{what}: {error}") from None
    lines = enumerate(text.splitlines(), 1)
    chunks = [_chunk(path, number, line) for number, line in lines if line.strip()]
    return sorted((chunk for chunk in chunks if chunk.data), key=lambda chunk: chunk.t)


def decoded_chunks(
    protocol: Protocol, chunks: Sequence[Chunk], *, half_duplex: bool
) -> Iterator[Batch]:
    """Yield what is decoded from bytes that one clock stamped; of one wire with `half_duplex`."""
    from bilprov.analyzer.decode.stream import StreamDecoder
    from bilprov.analyzer.taps.half_duplex import separated

    if half_duplex:
        chunks = separated(protocol, chunks)
    heard = frozenset(chunk.direction for chunk in chunks)
    decoder = StreamDecoder(protocol, heard=heard, skew=0)
    yield from decoder.feed(chunks)
    yield from decoder.finish()


def _chunk(path: Path, number: int, line: str) -> Chunk:
    try:
        row = from_json(line.encode(), RecordedBytes)
        data, sender = bytes.fromhex(row.hex), row.dir or row.direction
        if data and sender is None:
            raise ValueError("dir is missing, allowed are host and device")
        return Chunk(round(row.t * 1e9), sender or "host", data)
    except ValueError as error:
        raise click.ClickException(
            f"line {number} of {printable(str(path))} cannot be read: {error}; write "
            '{"t": 0.5, "dir": "host", "hex": "5556"}'
        ) from error
