"""What `bilprov capture diff` shows of two captures: as JSON and as tables.

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

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from rich.console import RenderableType
from rich.text import Text

from bilprov.analyzer.output.capture_stats import grammar_json, spread_json
from bilprov.analyzer.output.console import facts, heading, table
from bilprov.captures.text import printable, quantity
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from bilprov.analyzer.decode.records import HostRecord
    from bilprov.analyzer.edit.compare import Comparison, Difference, Exchange
    from bilprov.analyzer.totals.latencies import Spread

SECOND = 1e9  # ns
SHOWN = 20  # differences on a screen


def as_json(comparison: Comparison, protocol: Protocol, paths: tuple[str, str]) -> dict[str, Any]:
    """The comparison as one object; the module's docstring explains the keys."""
    return {
        "grammar": grammar_json(protocol),
        "a": paths[0],
        "b": paths[1],
        "exit": comparison.exit,
        "same": comparison.same,
        "judged": comparison.judged,
        "unknown": comparison.unknown,
        "tolerance": comparison.tolerance / SECOND,
        "differences": {kind: comparison.differences[kind] for kind in comparison.differences},
        "listed": [_listed(difference) for difference in comparison.listed],
        "latencies": {
            name: {"a": _spread(first), "b": _spread(second)}
            for name, (first, second) in comparison.latencies().items()
        },
    }


def _listed(difference: Difference) -> dict[str, Any]:
    frame = _frame_of(difference)
    return {
        "kind": difference.kind,
        "frame": frame.hex if frame else "",
        "words": _words(difference),
        "a": _side(difference.first),
        "b": _side(difference.second),
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
            [(_time(one.first), _time(one.second), _words(one), _difference(one)) for one in shown],
            right="A B",
        )
    if total > len(shown):
        yield Text(f"  and {quantity(total - len(shown), 'difference')} more", style="dim")
    if latencies := comparison.latencies():
        yield Text()
        yield table(
            ("latency", "A", "B", "median A", "median B", "shift", "95 % A", "95 % B"),
            [_row(name, *both) for name, both in latencies.items()],
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


def _difference(difference: Difference) -> str:
    one, other = difference.first, difference.second
    if one is None or other is None:
        return _KINDS[difference.kind]
    if difference.kind == "unasked":
        said = (side.unasked.hex(" ") or "none" for side in (one, other))
        return "unasked bytes behind it: A {}, B {}".format(*said)
    if difference.kind == "answer":
        return f"A answers {_answer(one)}, B {_answer(other)}"
    return f"A answers after {_latency(one)}, B after {_latency(other)}"


def _answer(exchange: Exchange) -> str:
    answer = exchange.answer
    return f"{answer.words} ({answer.hex})" if answer else "nothing"


def _latency(exchange: Exchange) -> str:
    latency = exchange.answer.latency if exchange.answer else None
    return "" if latency is None else f"{latency / 1e6:.3f} ms"


def _words(difference: Difference) -> str:
    frame = _frame_of(difference)
    return f"{frame.words} ({frame.hex})" if frame else "before the first frame"


def _frame_of(difference: Difference) -> HostRecord | None:
    exchange = difference.first or difference.second
    return exchange.frame if exchange else None


def _time(exchange: Exchange | None) -> str:
    return f"{exchange.frame.t / SECOND:.6f}" if exchange and exchange.frame else ""


def _row(name: str, first: Spread | None, second: Spread | None) -> tuple[str, ...]:
    both = (first, second)
    counts = (f"{side.count:,}" if side else "0" for side in both)
    medians = (_ms(side.median) if side else "" for side in both)
    most = (_ms(side.p95) if side else "" for side in both)
    shift = f"{(second.median - first.median) / 1e6:+.3f} ms" if first and second else ""
    return (name, *counts, *medians, shift, *most)


def _ms(latency: int) -> str:
    return f"{latency / 1e6:.3f} ms"
