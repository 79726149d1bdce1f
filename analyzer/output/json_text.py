"""Renders records and stretches as JSON lines; the text of each distinct frame is made once.

The text is that of `json_lines.encode(json_line(record))`, cut where lines of one frame differ:
at the time, the state, the number of the instruction, and an answer's latency.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import lru_cache
from itertools import chain, count, islice, repeat
from typing import TYPE_CHECKING

from bilprov.analyzer.decode.json_lines import encode, json_line
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record
from bilprov.captures.schemas import State
from bilprov.spec.codec import Judgement

if TYPE_CHECKING:
    from bilprov.analyzer.columns.stretch import Stretch

_REMEMBERED = 1 << 14  # texts of frames
_NO_STATE = State("", 0, 0, 0, False)


class JsonText:
    """Renders records and stretches as JSON lines, each with its newline."""

    def __init__(self) -> None:
        # The text of a whole frame's line from the time to the state, and from the number on.
        self._host: dict[bytes, tuple[str, str]] = {}
        # The text of a fitting answer's line from the time to the latency, and from the number on.
        self._device: dict[int, tuple[str, str]] = {}

    def records(self, records: Iterable[Record]) -> str:
        """The lines of the records; a record without a line gives none."""
        return "".join(self._lines(records))

    def stretch(self, stretch: Stretch) -> str:
        """The lines of all records of a stretch."""
        if not stretch.decoding.paired:
            return self.records(stretch.records())
        return "".join(self._stretch(stretch))

    def _lines(self, records: Iterable[Record]) -> Iterator[str]:
        state, shown = _NO_STATE, ""
        hosts, devices = self._host, self._device
        moment, time = -1, ""
        for record in records:
            if record.state is not state:
                state = record.state
                shown = encode(state).decode()
            if record.t != moment:  # bytes of one read have one time
                moment = record.t
                time = _seconds(moment)
            if type(record) is HostRecord and record.judgement and record.kind == "instruction":
                front, end = hosts.get(record.data) or self._host_text(record.judgement)
                yield f'{{"t":{time}{front}{shown},"sequence":{record.sequence}{end}'
            elif type(record) is DeviceRecord and record.agrees and not record.faults:
                front, end = devices.get(record.byte) or self._device_text(record)
                yield (
                    f'{{"t":{time}{front}{_seconds(record.latency or 0)},"state":'
                    f'{shown},"sequence":null,"answers":{record.instruction}{end}'
                )
            elif (line := json_line(record)) is not None:
                yield encode(line).decode() + "\n"

    def _stretch(self, stretch: Stretch) -> Iterator[str]:
        """Yield the lines of a stretch in which answers are paired, in pieces."""
        texts, steps = self._host, stretch.decoding.steps
        rows = zip(
            stretch.frame_bytes(slice(stretch.carried, None)),
            count(stretch.sequence + stretch.carried),
            *(column.tolist() for column in stretch.states),
            strict=False,
        )
        for side, start, stop, after in stretch.spans:
            if side == "device":
                yield from self._answers(stretch, start, stop, after)
                continue
            if side == "line":
                yield from self._lines([stretch.line(start, after)])
                continue
            # Frames that end in one read began in it too, but for the first of them.
            begun = stretch.start[start - stretch.carried : stop - stretch.carried]
            times = chain([_seconds(int(begun[0]))], repeat(_seconds(int(begun[-1]))))
            for t, (frame, sequence, motion, speed, steering, led) in zip(
                times, islice(rows, stop - start), strict=False
            ):
                front, end = texts.get(frame) or self._host_text(steps[frame].judgement)
                moved, moving = _motion_text(motion, speed)
                yield (
                    f'{{"t":{t}{front}{moved},"steering":{steering},"led":{led}{moving},'
                    f'"sequence":{sequence}{end}'
                )

    def _answers(self, stretch: Stretch, start: int, stop: int, after: int) -> Iterator[str]:
        """Yield the lines of the device rows of one read, after the first `after` host rows."""
        state, rows = stretch.state(after), slice(start, stop)
        shown, t = encode(state).decode(), _seconds(int(stretch.t[start]))
        known: dict[tuple[int, int], tuple[str, str]] = {}
        for row, byte, latency, fits in zip(
            count(start),
            stretch.byte[rows].tolist(),
            stretch.latency[rows].tolist(),
            stretch.fits[rows].tolist(),
            strict=False,
        ):
            around = known.get((byte, latency)) if fits else None
            if around is None:
                (answer,) = stretch.answers(slice(row, row + 1))
                record = stretch.device_record(answer, state)
                if not fits:
                    yield from self._lines([record])
                    continue
                front, end = self._device_text(record)
                front = f'{{"t":{t}{front}{_seconds(latency)},"state":{shown},"sequence":null,'
                around = known[byte, latency] = f'{front}"answers":', end
            yield f"{around[0]}{stretch.sequence + row}{around[1]}"

    def _host_text(self, judgement: Judgement) -> tuple[str, str]:
        text = self._host.get(judgement.frame)
        if text is None:
            record = HostRecord(0, 0, 0, "instruction", judgement.frame, judgement, 0, _NO_STATE)
            front, end = _around_state(record)
            text = front, end.removeprefix(',"sequence":0')
            if len(self._host) < _REMEMBERED:
                self._host[judgement.frame] = text
        return text

    def _device_text(self, record: DeviceRecord) -> tuple[str, str]:
        text = self._device.get(record.byte)
        if text is None:
            answer, answered = record.answer, record.answered
            same = DeviceRecord(0, record.byte, answer, answered, 0, 0, True, _NO_STATE)
            front, end = _around_state(same)
            text = (
                front.removesuffix('0.0,"state":'),
                end.removeprefix(',"sequence":null,"answers":0'),
            )
            self._device[record.byte] = text
        return text


def _around_state(record: Record) -> tuple[str, str]:
    """The text of a record's line from behind the time to the state, and behind the state."""
    line = json_line(record)
    front, _, end = encode(line).decode().rpartition(encode(_NO_STATE).decode())
    return front.removeprefix('{"t":0.0'), end + "\n"


def _seconds(nanoseconds: int) -> str:
    return encode(nanoseconds / 1e9).decode()


@lru_cache(maxsize=4096)
def _motion_text(motion: int, speed: int) -> tuple[str, str]:
    """The text of a state up to the speed, and from behind the LED on."""
    from bilprov.analyzer.columns.stretch import written

    text = encode(written(motion, speed, 0, 0)).decode()
    front, _, end = text.rpartition(',"steering":0,"led":0')
    return front, end
