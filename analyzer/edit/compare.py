"""Compares two captures, frame by frame of the host: what differs in frames, answers, latencies.

Each frame of the host has what the device answered. Two streams of them are aligned by their
frames, in memory that does not depend on their length: where frames differ, difflib looks for
insertions and deletions after which 16 frames in a row are the same again, among the next 64 frames
and then among 512. Where there are none, the next 16 frames in a row that both streams have are
taken, up to 20,000 frames ahead: so much may be missing at one place. Where there are none either,
all frames are listed alone.

The JSON of `--json` is one object. Times and durations are in seconds, from the start of each
capture:

- `grammar`: `name`, `version` and `sha256` of the grammar by which both were decoded.
- `a`, `b`: the paths.
- `exit`: the exit code: 0 nothing differs, 1 something does, 3 only one of them holds answers.
- `same`: how many frames of the host both have.
- `judged`: of how many of these the answers were compared.
- `unknown`: of how many only one tells what was answered.
- `tolerance`: by how much the latencies of a frame may differ.
- `differences`: how many there are, by kind: `only_a` and `only_b` (a frame that the other has
  not), `answer` (another one, or one that is missing), `latency` (by more than the tolerance),
  `unasked` (bytes of the device behind the frame that answer nothing).
- `listed`: the first 100, each with `kind`, `frame` (hex; empty before the first frame), `words`,
  and `a` and `b`, of which one may be null: `t` of the frame, its `sequence`, `answer` (hex; null
  if there is none), `name` of the answer, `latency`, and `unasked` (hex).
- `latencies`: by the name of the instruction, `a` and `b`: `count`, `median`, `p95`, `max`, as
  `stats` has them; null where there is none.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from difflib import SequenceMatcher
from itertools import islice, takewhile
from operator import eq
from typing import Any, Final, Literal

from rich.console import RenderableType
from rich.text import Text

from bilprov.analyzer.decode.session import BOTH
from bilprov.analyzer.output.capture_stats import spread_json
from bilprov.analyzer.output.console import facts, heading, parts_of, table
from bilprov.analyzer.replay.capture_decoding import Progress, heard, opened_whole
from bilprov.analyzer.replay.comparison import Exchange, Exchanges
from bilprov.analyzer.totals.totals import Spread, Totals
from bilprov.captures.reader import Capture
from bilprov.captures.schemas import MS
from bilprov.captures.text import printable, quantity
from bilprov.spec.protocol import Protocol


def _exchanges(
    capture: Capture, protocol: Protocol, progress: Progress, totals: Totals
) -> Iterator[Exchange]:
    """Yield the exchanges of a capture in order, and add all to its totals."""
    pairs = Exchanges(paired=heard(capture) >= BOTH)
    for batch in opened_whole(capture, protocol).decoded(progress):
        totals.add(batch)
        for record in batch.records():
            pairs.record(record)
        yield from pairs.settled()
    pairs.give_up()
    yield from pairs.rest


RUN: Final = 16  # frames that are the same, after which two streams count as aligned
FAR: Final = 20_000
WINDOWS: Final = (64, 512, FAR)
"""Exchanges of each stream that are looked at: for few edits, for more, for the next run."""

Keys = Sequence[tuple[str, bytes]]
Step = tuple[bool, bool]
"""Whether an exchange is taken from the left, and whether one is from the right."""

Pair = tuple[Exchange | None, Exchange | None]


def aligned(first: Iterator[Exchange], second: Iterator[Exchange]) -> Iterator[Pair]:
    """Yield all exchanges of both in order: pairs with the same frame, or one alone."""
    left: deque[Exchange] = deque()
    right: deque[Exchange] = deque()
    steps: Sequence[Step] = [(False, False)]
    while steps:
        for window in WINDOWS:
            steps = _steps(_next(left, first, window), _next(right, second, window), window)
            if steps:
                break
        for to_left, to_right in steps:
            yield left.popleft() if to_left else None, right.popleft() if to_right else None


def _next(held: deque[Exchange], stream: Iterator[Exchange], count: int) -> Keys:
    """The keys of so many next exchanges of a stream, of fewer at the end."""
    held.extend(islice(stream, max(0, count - len(held))))
    return [one.key for one in islice(held, count)]


def _steps(left: Keys, right: Keys, window: int) -> Sequence[Step]:
    """The steps as far as the streams are the same, or up to where they are aligned again.

    There are none where the window does not show that, nor at the end of both. A stream with fewer
    keys than the window ends with them.
    """
    if not left or not right:
        return [(True, False)] * len(left) + [(False, True)] * len(right)
    if same := len([*takewhile(bool, map(eq, left, right))]):
        return [(True, True)] * same
    if window == FAR:
        return _jump(left, right)
    steps: list[Step] = []
    matcher = SequenceMatcher(None, left, right, autojunk=False)
    for _, begin, end, first, last in matcher.get_opcodes():
        if left[begin:end] == right[first:last]:
            steps += [(True, True)] * (end - begin)
            if end - begin >= RUN:
                return steps
        else:
            steps += [(True, False)] * (end - begin) + [(False, True)] * (last - first)
    return steps if max(len(left), len(right)) < window else []


def _jump(left: Keys, right: Keys) -> list[Step]:
    """The steps to the next run that both streams have; half of all steps where there is none."""
    places: dict[tuple[tuple[str, bytes], ...], int] = {}
    for x in range(len(left) - RUN + 1):
        places.setdefault(tuple(left[x : x + RUN]), x)
    best: tuple[int, int] | None = None
    for y in range(len(right) - RUN + 1):
        if best and y >= sum(best):
            break
        found = places.get(tuple(right[y : y + RUN]))
        if found is not None and (best is None or found + y < sum(best)):
            best = found, y
    to_left, to_right = best or ((len(left) + 1) // 2, (len(right) + 1) // 2)
    return [(True, False)] * to_left + [(False, True)] * to_right


TOLERANCE: Final = 20 * MS
"""Ns by which two latencies may differ: USB adapters hold bytes back for up to 16 ms."""

LISTED: Final = 100  # differences that are kept

Kind = Literal["only_a", "only_b", "answer", "latency", "unasked"]


@dataclass(slots=True)
class Comparison:
    """What two captures have in common, and where they differ.

    `same` counts the frames that both have, `judged` those of them whose answers were compared, and
    `unknown` those of which only one capture tells what was answered. `differences` counts by kind;
    the first ones are `listed`, as the JSON has them. Latencies may differ by `tolerance` (ns).
    `totals` are of each.
    """

    totals: tuple[Totals, Totals]
    tolerance: int
    same: int = 0
    judged: int = 0
    unknown: int = 0
    differences: Counter[Kind] = field(default_factory=Counter)
    listed: list[dict[str, Any]] = field(default_factory=list)

    def pair(self, first: Exchange | None, second: Exchange | None) -> None:
        """Add the next exchange, of both captures or of one alone."""
        if first is None or second is None:
            self._differs("only_a" if second is None else "only_b", first, second)
            return
        self.same += first.frame is not None
        if first.told and second.told:
            self.judged += 1
            self._answers(first, second)
        elif first.told or second.told:
            self.unknown += 1
        if first.unasked != second.unasked:
            self._differs("unasked", first, second)

    @property
    def exit(self) -> int:
        """1 if anything differs, 3 if answers cannot be compared at all, else 0."""
        if self.differences:
            return 1
        return 3 if self.unknown and not self.judged else 0

    def _answers(self, first: Exchange, second: Exchange) -> None:
        one, other = first.answer, second.answer
        if (one.data if one else None) != (other.data if other else None):
            self._differs("answer", first, second)
        elif one and other and abs((one.latency or 0) - (other.latency or 0)) > self.tolerance:
            self._differs("latency", first, second)

    def latencies(self) -> dict[str, dict[str, Any]]:
        """How the latencies of `a` and `b` are spread, by the name of the instruction."""
        first, second = (
            {name: one.latencies for name, one in totals.instructions().items() if one.latencies}
            for totals in self.totals
        )
        return {
            name: {"a": _spread(first.get(name)), "b": _spread(second.get(name))}
            for name in sorted({*first, *second})
        }

    def _differs(self, kind: Kind, first: Exchange | None, second: Exchange | None) -> None:
        self.differences[kind] += 1
        if len(self.listed) < LISTED:
            self.listed.append(_listed(kind, first, second))


def compared(
    captures: Sequence[Capture],
    protocol: Protocol,
    progress: Progress,
    tolerance: int = TOLERANCE,
) -> Comparison:
    """Compare two captures; latencies may differ by `tolerance` (ns).

    Raises CaptureError as `Capture.events` does.
    """
    comparison = Comparison((Totals(protocol), Totals(protocol)), tolerance)
    both = zip(captures, comparison.totals, strict=True)
    first, second = (_exchanges(one, protocol, progress, totals) for one, totals in both)
    for pair in aligned(first, second):
        comparison.pair(*pair)
    return comparison


SECOND = 1e9  # ns
SHOWN = 20  # differences on a screen


def as_json(comparison: Comparison, protocol: Protocol, paths: tuple[str, str]) -> dict[str, Any]:
    """The comparison as one object; the module's docstring explains the keys."""
    return {
        "grammar": parts_of(protocol, "name", "version", "sha256"),
        "a": paths[0],
        "b": paths[1],
        **parts_of(comparison, "exit", "same", "judged", "unknown"),
        "tolerance": comparison.tolerance / SECOND,
        "differences": dict(comparison.differences),
        "listed": comparison.listed,
        "latencies": comparison.latencies(),
    }


def _listed(kind: Kind, first: Exchange | None, second: Exchange | None) -> dict[str, Any]:
    exchange = first or second
    frame = exchange.frame if exchange else None
    return {
        "kind": kind,
        "frame": frame.hex if frame else "",
        "words": f"{frame.words} ({frame.hex})" if frame else "before the first frame",
        "a": _side(first),
        "b": _side(second),
    }


def _side(exchange: Exchange | None) -> dict[str, Any] | None:
    if exchange is None:
        return None
    frame, answer = exchange.frame, exchange.answer
    latency = answer.latency if answer else None
    return {
        "t": frame.t / SECOND if frame else None,
        "sequence": frame.sequence if frame else None,
        "answer": answer.hex if answer else None,
        "name": answer.words if answer else None,
        "latency": None if latency is None else latency / SECOND,
        "unasked": exchange.unasked.hex(" "),
    }


def _spread(spread: Spread | None) -> dict[str, Any] | None:
    said = spread_json(spread)
    return said and {name: said[name] for name in ("count", "median", "p95", "max")}


def drawn(comparison: Comparison, paths: tuple[str, str]) -> Iterator[RenderableType]:
    """Yield the parts to print; text from the files is escaped."""
    total = comparison.differences.total()
    yield heading("nothing differs" if not total else quantity(total, "difference"))
    yield facts(_about(comparison, paths))
    shown = comparison.listed[:SHOWN]
    if shown:
        yield Text()
        yield table(
            ("A", "B", "frame", "what differs"),
            [(_time(one["a"]), _time(one["b"]), one["words"], _difference(one)) for one in shown],
            right="A B",
        )
    if total > len(shown):
        yield Text(f"  and {quantity(total - len(shown), 'difference')} more", style="dim")
    if latencies := comparison.latencies():
        yield Text()
        yield table(
            ("latency", "A", "B", "median A", "median B", "shift", "95 % A", "95 % B"),
            [_row(name, both["a"], both["b"]) for name, both in latencies.items()],
            right="A B median",
        )


def _about(comparison: Comparison, paths: tuple[str, str]) -> Iterator[tuple[str, str]]:
    yield "A", printable(paths[0])
    yield "B", printable(paths[1])
    yield "frames", f"{comparison.same:,} in both, the answers to {comparison.judged:,} compared"
    if comparison.unknown:
        yield "not compared", f"{comparison.unknown:,}: only one of them shows the answer"
    yield "latency", f"may differ by {comparison.tolerance / 1e6:g} ms"
    for kind, count in comparison.differences.items():
        yield _KINDS[kind], f"{count:,}"


_KINDS = {
    "only_a": "only in A",
    "only_b": "only in B",
    "answer": "other answer",
    "latency": "other latency",
    "unasked": "unasked bytes",
}


def _difference(one: dict[str, Any]) -> str:
    kind, a, b = one["kind"], one["a"], one["b"]
    if a is None or b is None:
        return _KINDS[kind]
    if kind == "unasked":
        return f"unasked bytes behind it: A {a[kind] or 'none'}, B {b[kind] or 'none'}"
    if kind == "answer":
        return f"A answers {_answer(a)}, B {_answer(b)}"
    return f"A answers after {_ms(a[kind])}, B after {_ms(b[kind])}"


def _answer(side: dict[str, Any]) -> str:
    return "nothing" if side["answer"] is None else f"{side['name']} ({side['answer']})"


def _time(side: dict[str, Any] | None) -> str:
    return f"{side['t']:.6f}" if side and side["t"] is not None else ""


def _row(name: str, a: dict[str, Any] | None, b: dict[str, Any] | None) -> tuple[str, ...]:
    counts = (f"{side['count']:,}" if side else "0" for side in (a, b))
    medians, most = (
        [_ms(side[key]) if side else "" for side in (a, b)] for key in ("median", "p95")
    )
    shift = f"{round((b['median'] - a['median']) * SECOND) / 1e6:+.3f} ms" if a and b else ""
    return (name, *counts, *medians, shift, *most)


def _ms(seconds: float | None) -> str:
    return "" if seconds is None else f"{round(seconds * SECOND) / 1e6:.3f} ms"
