"""Describes each entry of a wire log in the grammar's words: frames and answers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import lru_cache
from itertools import groupby

from bilprov.captures.schemas import MS
from bilprov.conformance.oracle.verdicts import WireEvent
from bilprov.conformance.oracle.wording import code_words
from bilprov.conformance.report.run_report import Report
from bilprov.spec.codec import judge
from bilprov.spec.framing import Framer
from bilprov.spec.protocol import Protocol


class WireWords:
    """The words for the wire logs of one report.

    `known` is false for a report that was made with another grammar than `protocol`: its bytes are
    not described. Frames are described as a conforming device would find them in the bytes.
    """

    def __init__(self, protocol: Protocol, report: Report) -> None:
        self.known = report.grammar["sha256"] == protocol.sha256
        self._protocol = protocol
        measured = report.profile.get("truncation_timeout_ms")
        usual = protocol.timing.truncation_timeout
        # The profile may come from a file, where True is a number too.
        if not isinstance(measured, bool) and isinstance(measured, int | float):
            usual = measured if 0 < measured < 1e6 else usual
        self._timeout = int(usual * MS)
        self._frame = lru_cache(maxsize=None)(self._describe)

    def of(self, log: Iterable[WireEvent]) -> Iterator[str]:
        """The words for each entry of a log."""
        framer = Framer(self._protocol.lengths, self._timeout)
        for event in log:
            if event.look or not self.known:
                yield event.look
            elif event.kind == "sent":
                yield self._sent(framer, event)
            else:
                codes = bytes.fromhex(event.hex)
                yield _told(code_words(self._protocol, code) for code in codes)

    def _sent(self, framer: Framer, event: WireEvent) -> str:
        framer.advance(event.t)
        begun = bool(framer.held)
        words = [
            self._frame(frame.data) for frame in framer.feed(bytes.fromhex(event.hex), event.t)
        ]
        if begun:
            words.insert(0, "(goes on)")
        if framer.held:
            words.append(f"{judge(self._protocol, framer.held).describe()} so far")
        return _told(words)

    def _describe(self, frame: bytes) -> str:
        judgement = judge(self._protocol, frame)
        if judgement.valid:
            return judgement.describe()
        due = code_words(self._protocol, judgement.response.code)
        return f"{judgement.describe()} (faulty, {due} is due)"


def _told(words: Iterable[str]) -> str:
    """The words one after another, equal ones counted."""
    counted = ((word, len(list(run))) for word, run in groupby(words))
    return ", ".join(word if count == 1 else f"{count} × {word}" for word, count in counted)
