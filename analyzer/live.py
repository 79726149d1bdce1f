"""Port names in, decoded records out as they happen: sniffing as an iterator."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

from analyzer.decode.records import Record
from analyzer.decode.session import BOTH, Session
from analyzer.grammar_file import load_protocol
from analyzer.taps.passive import Taps, require_two_lines
from analyzer.transport.ports import LineSettings, open_port
from captures.schemas import Direction
from spec.protocol import Protocol

_LONGEST_WAIT = 0.2  # s, so that Ctrl-C is never held up


def sniff(
    host: str,
    device: str | None = None,
    *,
    settings: LineSettings | None = None,
    protocol: Protocol | None = None,
) -> Iterator[Record]:
    """Listen to two taps, `host` and `device` (or to the host alone), and yield what they carry.

    Ports are paths or pyserial URLs; `settings` are the protocol's own line unless given. Ends when
    both lines have gone, and closes the ports when the iterator is closed. Times are ns since the
    start. Raises LinkError for a port that cannot be opened, ValueError where both are one line.
    """
    protocol = protocol or load_protocol()
    line = protocol.line
    settings = settings or LineSettings(line.baud, line.parity, line.stopbits)
    if device is not None:
        require_two_lines(host, device)
    with ExitStack() as opened:
        taps = Taps(
            opened.enter_context(open_port(host, settings)),
            opened.enter_context(open_port(device, settings)) if device is not None else None,
        )
        heard: frozenset[Direction] = frozenset({"host"}) if device is None else BOTH
        session = Session(protocol, heard=heard, attached=True)
        while not taps.ended:
            now, due = taps.now(), session.deadline
            wait = _LONGEST_WAIT if due is None else min(_LONGEST_WAIT, max(0, due - now) / 1e9)
            for event in taps.poll(wait):
                yield from session.feed(event)
            yield from session.advance(now)
        yield from session.finish(taps.now())
