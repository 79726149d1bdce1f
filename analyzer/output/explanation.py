"""Shows an explanation as a drawing of its bits, and as JSON."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any

from rich.console import RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from bilprov.analyzer.output.console import facts, heading, parts_of
from bilprov.analyzer.output.protocol import reading_json
from bilprov.spec.codec import spaced
from bilprov.spec.data import plain_values
from bilprov.spec.explain import BitGroup, Explanation, FrameExplanation, ResponseExplanation

_COLOURS = ("cyan", "magenta", "green", "yellow", "blue")
_FAULT = "bold red"
_READING = ("id", "clause", "point", "default")


def drawn(explanation: Explanation) -> Iterator[RenderableType]:
    """Yield the parts to print: for each frame or response its bits, then their consequences."""
    parts = (*map(_frame, explanation.frames), *map(_response, explanation.responses))
    for index, part in enumerate(parts):
        if index:
            yield Text()
        yield from part


def _frame(frame: FrameExplanation) -> Iterator[RenderableType]:
    judgement = frame.judgement
    style = "" if judgement.valid else "red"
    yield heading(spaced(judgement.frame), judgement.describe(), style)
    yield _bits(frame.groups, judgement.frame)
    yield Text()
    yield facts(_frame_facts(frame))


def _frame_facts(frame: FrameExplanation) -> Iterator[tuple[str, str | Text]]:
    judgement = frame.judgement
    style = "green" if judgement.valid else "red"
    yield "answer", Text(frame.answer, style=style)
    yield "why", judgement.reason
    yield "clause", judgement.clause
    yield frame.device, frame.action
    state = [f"{name} becomes {value}" for name, value in frame.changes]
    stay = "stays as it was" if len(frame.keeps) == 1 else "stay as they were"
    kept = [f"{', '.join(frame.keeps)} {stay}"] if frame.keeps else []
    yield "state", "; ".join(filter(None, (", ".join(state), *kept)))
    for reading in frame.readings:
        told = [f"{reading.id}, {reading.clause}: {reading.point}"]
        told += [f"our default: {reading.default}"]
        told += [f"otherwise: {choice} -> {verdict}" for choice, verdict in reading.others]
        yield "reading", Text("\n").join(map(Text, told))
    for erratum in frame.errata:
        yield "erratum", f"{erratum.id}, {erratum.clause}: {erratum.correction}"
    if frame.nearest:
        meant = frame.nearest
        told_meant = Text(spaced(meant.frame), style="bold")
        told_meant.append(f"  {meant.describe()}\n{'; '.join(frame.differences)}", style="not bold")
        yield "nearest", told_meant


def _response(response: ResponseExplanation) -> Iterator[RenderableType]:
    known = response.response
    yield heading(spaced(response.frame), response.words, "" if known else "red")
    yield _bits(response.groups, response.frame)
    yield Text()
    document = f' ("{known.document}")' if known and known.document else ""
    yield facts([("meaning", response.meaning + document), ("clause", response.clause)])


def _bits(groups: Sequence[BitGroup], data: bytes) -> RenderableType:
    """Draw each byte's bits on one line, and below it one line that names each group of bits."""
    grid = Table.grid(padding=(0, 2))
    for _ in range(5):
        grid.add_column(no_wrap=True)
    grid.add_column()
    number = 0
    for byte, members in groupby(groups, key=lambda group: group.byte):
        row = []
        for group in members:
            row.append((group, _FAULT if group.fault else _COLOURS[number % len(_COLOURS)]))
            number += 1
        bits = Text(" ").join(Text(group.bits, style) for group, style in row)
        coded = spaced(data[byte : byte + row[0][0].size])
        grid.add_row(Text(str(byte), "dim"), Text(coded, "bold"), bits)
        at = 0
        for group, style in row:
            line = Text(" " * at).append("━" * len(group.bits), style)
            shown = (group.name, str(group.value), group.meaning)
            grid.add_row("", "", line, *(Text(part, style) for part in shown))
            at += len(group.bits) + 1
    return Padding(grid, (0, 0, 0, 2), expand=False)


def as_json(explanation: Explanation) -> dict[str, Any]:
    """The explanation as a JSON object."""
    frames = [_frame_json(frame) for frame in explanation.frames]
    responses = [_response_json(response) for response in explanation.responses]
    return {"hex": spaced(explanation.data), "frames": frames, "responses": responses}


def _frame_json(frame: FrameExplanation) -> dict[str, Any]:
    judgement, meant = frame.judgement, frame.nearest
    return {
        "offset": frame.offset,
        "hex": spaced(judgement.frame),
        "words": judgement.describe(),
        **parts_of(judgement, "id", "length"),
        "missing": frame.missing,
        "name": judgement.instruction.name if judgement.instruction else None,
        "fields": plain_values(judgement.values),
        "valid": judgement.valid,
        "judgement": judgement.expected,
        "code": judgement.response.code,
        **parts_of(judgement, "reason", "clause"),
        "bits": [group._asdict() for group in frame.groups],
        **parts_of(frame, "answer", "action", "stops"),
        "changes": dict(frame.changes),
        "keeps": list(frame.keeps),
        "readings": [reading_json(one, *_READING) for one in frame.readings],
        "errata": [parts_of(erratum, "id", "clause", "correction") for erratum in frame.errata],
        "nearest": meant
        and {
            "hex": spaced(meant.frame),
            "words": meant.describe(),
            "differences": list(frame.differences),
        },
    }


def _response_json(response: ResponseExplanation) -> dict[str, Any]:
    known = response.response
    return {
        "offset": response.offset,
        "hex": spaced(response.frame),
        "name": known.name if known else None,
        **({"fields": plain_values(response.reply.values)} if response.reply else {}),
        "document": known.document if known else None,
        **parts_of(response, "meaning", "clause"),
        "bits": [group._asdict() for group in response.groups],
    }
