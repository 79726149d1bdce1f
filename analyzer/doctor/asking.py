"""Finds the baud rate at which a device answers, by the link check; homes the device at the end.

At each rate stops are sent first: wherever the bytes arrive garbled, stops are what does least
harm. Only where something answers are the other frames of the link check sent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from shlex import quote

from bilprov.analyzer.client.operations import Link, done, listen, send
from bilprov.analyzer.client.rest import home_once
from bilprov.analyzer.doctor.finding import Finding, Grade
from bilprov.analyzer.transport.errors import LinkError
from bilprov.captures.schemas import MS
from bilprov.spec.by_effect import link_check
from bilprov.spec.codec import judge, spaced
from bilprov.spec.protocol import Protocol

RATES = (9600, 19200, 38400, 57600, 115200, 230400, 250000, 460800, 500000, 921600, 1000000)
"""Baud rates that devices of this kind are set to, in bits/s."""

_ROUNDS = 2  # a board that was reset when its port was opened boots during the first


class Reply(Enum):
    """What came back at one baud rate."""

    NOTHING = "nothing"
    GARBAGE = "bytes that are not answers"
    ECHO = "what was sent"
    ANSWERS = "answers"


@dataclass(frozen=True, slots=True)
class Answered:
    """What came back to the link check at one baud rate: each frame, and the bytes after it."""

    baud: int
    reply: Reply
    exchanges: tuple[tuple[bytes, bytes], ...] = ()


def rates_of(name: str, baud: int) -> tuple[int, ...]:
    """The baud rates to ask at: `baud` first, and no other where the port has none to be set."""
    if name.lower().startswith(("socket:", "loop:")):
        return (baud,)
    return (baud, *(rate for rate in RATES if rate != baud))


def longest_time(protocol: Protocol, rates: Sequence[int]) -> float:
    """The time in s that asking at these rates takes if nobody answers."""
    return _ROUNDS * len(rates) * protocol.timing.answer_longest / 1000


def asked(
    protocol: Protocol,
    link: Link,
    tune: Callable[[int], object],
    rates: Sequence[int],
    given_up: Callable[[], bool] = lambda: False,
) -> tuple[Answered, ...]:
    """Ask at each rate until answers come; give what came back, the last at the rate that is left.

    `tune` sets the line's baud rate, and raises LinkError for one that it does not have; `given_up`
    is called before each rate. A device that answers is homed at the end, and on every way out
    stops are sent at the last rate. Raises LinkError if the port is lost.
    """
    found: list[Answered] = []
    try:
        for rate in (*rates,) * _ROUNDS:
            if given_up():
                break
            try:
                tune(rate)
            except LinkError:
                continue
            answered = _link_check(protocol, link, rate, expected=rate == rates[0])
            if answered.reply is not Reply.NOTHING:
                found.append(answered)
            if answered.reply in (Reply.ANSWERS, Reply.ECHO):
                break
        else:
            tune(rates[0])
    finally:
        with suppress(LinkError):
            done(home_once(protocol), link)
    return tuple(found)


def _link_check(protocol: Protocol, link: Link, rate: int, *, expected: bool) -> Answered:
    """Home the device and, if anything comes back, send the link check.

    At another rate than the `expected` one a stray 0 is no proof: a refusal has to be right too.
    """
    if not done(home_once(protocol), link):
        return Answered(rate, Reply.NOTHING)
    setting, unused, short = link_check(protocol)
    longest, more = (
        round(milliseconds * MS)
        for milliseconds in (protocol.timing.answer_longest, protocol.timing.answer_deadline)
    )
    exchanges = []
    for frame in filter(None, (unused, setting, short)):
        done(send(frame), link)
        came = [*done(listen(1, longest), link).codes, *done(listen(None, more), link).codes]
        exchanges.append((frame, bytes(came)))
    codes = {spec.code for spec in protocol.responses}
    due = {frame: judge(protocol, frame).response.code for frame, _ in exchanges}
    sure = any(due[frame] and came == bytes([due[frame]]) for frame, came in exchanges)
    single = all(len(came) <= 1 and set(came) <= codes for _, came in exchanges)
    if all(came[: len(frame)] == frame for frame, came in exchanges):
        reply = Reply.ECHO
    elif single and (sure or expected) and any(came for _, came in exchanges):
        reply = Reply.ANSWERS
    else:
        reply = Reply.GARBAGE
    return Answered(rate, reply, tuple(exchanges))


def told(
    protocol: Protocol, name: str, rates: Sequence[int], found: Sequence[Answered]
) -> Iterator[Finding]:
    """Yield what asking at the rates has shown of the device at the port `name`."""
    last = found[-1] if found else None
    if last is None:
        tried = f"any of {len(rates)} baud rates" if len(rates) > 1 else f"{rates[0]} baud"
        sentence = f"nobody answers at {tried}: check power, wiring (TX to RX) and common ground"
        yield Finding("answers", Grade.BLOCKS, sentence)
    elif last.reply is Reply.ECHO:
        sentence = (
            "what is sent comes back: a loop-back plug, TX and RX wired together, or an adapter "
            "that hears itself"
        )
        yield Finding("echo", Grade.BLOCKS, sentence)
    elif last.reply is Reply.GARBAGE:
        came = " ".join(spaced(answer) for _, answer in last.exchanges if answer)[:60]
        asked = dict.fromkeys(one.baud for one in found)  # each is asked at twice
        sentence = (
            f"something comes back at {', '.join(map(str, asked))} baud, but no "
            f"answers ({came}): another baud rate, parity or protocol"
        )
        yield Finding("answers", Grade.BLOCKS, sentence)
    else:
        yield _at_rate(name, rates[0], last.baud)
        yield from _unlike(protocol, name, last)


def _at_rate(name: str, expected: int, baud: int) -> Finding:
    if baud == expected:
        return Finding("answers", Grade.FINE, f"a device answers at {baud} baud")
    sentence = f"a device answers at {baud} baud, not at {expected}; give each command that rate"
    command = f"bilprov conform {quote(name)} --baud {baud}"
    return Finding("baud rate", Grade.BLOCKS, sentence, command)


def _unlike(protocol: Protocol, name: str, answered: Answered) -> Iterator[Finding]:
    """The first answer that is another one than a conforming device gives."""
    for frame, came in answered.exchanges:
        due = judge(protocol, frame).response
        if came != bytes([due.code]):
            what = f"answers {spaced(came)}" if came else "gives no answer"
            sentence = f"to {spaced(frame)} it {what}, where {due.code:02x} {due.name} is due"
            command = f"bilprov conform {quote(name)} --level smoke --baud {answered.baud}"
            yield Finding("answers", Grade.ADVICE, sentence, command)
            return
