"""The parts of a recording that is kept in several files: their names, and what they hold together.

`drive.mcap` is kept as `drive.00001.mcap`, `drive.00002.mcap` and so on. Each part is a capture by
itself; all have the same start, from which their times count, and their sequence numbers go on from
part to part.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from bilprov.captures import topics
from bilprov.captures.errors import CaptureError
from bilprov.captures.storage.records import MAGIC
from bilprov.captures.text import printable

if TYPE_CHECKING:
    from bilprov.captures.storage.contents import Contents

DIGITS: Final = 5  # as many as dumpcap's, so that a listing is in order up to 99,999 parts


class Volume(NamedTuple):
    """One file of a capture and its contents; `missing` names the parts right before it that are
    not there, "" for none.
    """

    path: Path
    contents: Contents
    missing: str = ""


def part_path(path: Path, number: int) -> Path:
    """The file of a part, counted from 1, of a recording under the name `path`."""
    return path.with_name(f"{path.stem}.{number:0{DIGITS}d}{path.suffix}")


def part_paths(path: Path) -> dict[int, Path]:
    """The files that have names of parts of `path`, in their order, by number."""
    name = re.compile(rf"{re.escape(path.stem)}\.(\d{{{DIGITS},}}){re.escape(path.suffix)}")
    found = {}
    try:
        with os.scandir(path.parent) as entries:
            for entry in entries:
                match = name.fullmatch(entry.name)
                if match and entry.name == part_path(path, int(match[1])).name:
                    found[int(match[1])] = path.with_name(entry.name)
    except (OSError, ValueError):
        return {}
    return dict(sorted(found.items()))


def kept_parts(path: Path) -> dict[int, Path]:
    """The parts of which a capture under this name consists; none where it is one file."""
    return {} if os.path.lexists(path) else part_paths(path)


def is_capture(path: Path) -> bool:
    """Whether a file is a capture, by its name or by how it begins; a pipe is none."""
    with suppress(OSError):
        if path.is_file() and path.suffix != ".mcap":
            with path.open("rb") as file:
                return file.read(len(MAGIC)) == MAGIC
        return path.is_file()
    return False


def require_new(path: Path) -> None:
    """Raise CaptureError if a recording, in parts or not, has this name, or if it is none."""
    if str(path) == "-":
        raise CaptureError("a capture cannot be written to standard output: name a file")
    taken = next(iter(part_paths(path).values()), path)
    if os.path.lexists(taken):
        raise CaptureError(
            f"{printable(taken)} exists and captures are never overwritten: choose another name"
        )


def said_of_parts(paths: Sequence[Path]) -> str:
    """The first and the last of some parts, as a sentence names them."""
    first, last = printable(paths[0]), printable(paths[-1])
    return first if len(paths) == 1 else f"{first} to {last}"


def volumes_of(path: Path, held: Sequence[tuple[int, Path, Contents]]) -> tuple[Volume, ...]:
    """The volumes of the recording `path`, of which these numbers, files and contents are there.

    Raises CaptureError if they are not of one recording.
    """
    first, *others = held
    for other in others:
        if other[2].start != first[2].start:
            raise CaptureError(
                f"{printable(first[1])} and {printable(other[1])} are parts of different "
                "recordings: move those of one of them to another folder, or name a single part"
            )
    volumes = [Volume(first[1], first[2])]
    for (before, _, _), (number, file, contents) in zip(held, others, strict=False):
        volumes.append(Volume(file, contents, _missing(path, before + 1, number - 1)))
    return tuple(volumes)


def merged(volumes: Sequence[Volume]) -> Contents:
    """What several volumes hold together, without regions; the metadata are those of the first."""
    contents = [volume.contents for volume in volumes]
    first = contents[0]
    counts: Counter[str] = Counter()
    sizes: Counter[str] = Counter()
    for one in contents:
        counts.update(one.counts)
        sizes.update(one.sizes)
    return replace(
        first,
        size=sum(one.size for one in contents),
        regions=(),
        own=all(one.own for one in contents),
        counted=all(one.counted for one in contents),
        metadata={key: text for key, text in first.metadata.items() if key != topics.PART},
        channels={key: topic for one in contents for key, topic in one.channels.items()},
        first=next((one.first for one in contents if one.first), 0),
        last=max(one.last for one in contents),
        counts=dict(counts),
        sizes=dict(sizes),
        unfinished=any(one.unfinished for one in contents),
        damage=tuple(_damage(volumes)),
    )


def _damage(volumes: Sequence[Volume]) -> Iterator[str]:
    for volume in volumes:
        if volume.missing:
            yield volume.missing
        for note in volume.contents.damage:
            yield f"{printable(volume.path.name)}: {note}"


def _missing(path: Path, first: int, last: int) -> str:
    if first > last:
        return ""
    if first == last:
        return f"part {first} ({printable(part_path(path, first).name)}) is missing"
    return f"parts {first} to {last} of {printable(path.name)} are missing"
