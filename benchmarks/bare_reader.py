"""The smallest reader of two lines: select, os.read, a table of lines, one write for each read.

`python -m benchmarks.bare_reader HOST DEVICE [--write FILE]`: prints a JSON line for each frame and
each answer, and writes the raw bytes into FILE. It pairs nothing, notices nothing odd, and keeps no
state: what is measured beside it is what bilprov does more.
"""

from __future__ import annotations

import json
import os
import select
import signal
import sys
import time
from contextlib import ExitStack, suppress
from pathlib import Path

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol

_MOST = 1 << 16  # bytes of a read, and frames that are remembered


class _Told(dict[bytes, bytes]):
    """The end of a frame's line by the bytes that decide it, made once.

    Those are its header alone where no instruction has this header: the data decide nothing then.
    """

    def __init__(self, protocol: Protocol) -> None:
        super().__init__()
        self._protocol = protocol
        of_an_instruction = {protocol.header_bytes[s.id, s.length] for s in protocol.instructions}
        self.decides = [None if header in of_an_instruction else 1 for header in range(256)]

    def __missing__(self, frame: bytes) -> bytes:
        judged = judge(self._protocol, frame.ljust(1 + self._protocol.lengths[frame[0]], b"\0"))
        told = {
            "name": judged.name,
            "fields": dict(judged.fields),
            "judgement": judged.response.name,
            "reason": judged.reason,
        }
        line = json.dumps(told)[1:].encode() + b"\n"
        if len(self) < _MOST:
            self[frame] = line
        return line


def _answers(protocol: Protocol) -> list[bytes]:
    """The end of the line of each answer byte."""
    named = {code: response.name for code, response in protocol.codes.items()}
    return [
        json.dumps({"hex": f"{byte:02x}", "name": named.get(byte)})[1:].encode() + b"\n"
        for byte in range(256)
    ]


def main() -> None:
    """Read until SIGINT."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    protocol = load_protocol()
    host, device = (os.open(name, os.O_RDONLY | os.O_NONBLOCK) for name in sys.argv[1:3])
    lengths, held, begun = protocol.lengths, b"", time.monotonic()
    told, answers = _Told(protocol), _answers(protocol)
    decides = told.decides
    with ExitStack() as stack:
        stack.enter_context(suppress(KeyboardInterrupt))
        log = stack.enter_context(Path(sys.argv[4]).open("wb")) if len(sys.argv) > 4 else None
        while True:
            for ready in select.select([host, device], [], [])[0]:
                data = os.read(ready, _MOST)
                now = time.monotonic() - begun
                if log:
                    log.write(data)
                lines = []
                if ready == device:
                    start = b'{"t": %.6f, "direction": "device", ' % now
                    lines = [start + answers[byte] for byte in data]
                else:
                    start = b'{"t": %.6f, "direction": "host", "hex": "' % now
                    data, at = held + data, 0
                    while at < len(data) and (end := at + 1 + lengths[data[at]]) <= len(data):
                        frame = data[at:end]
                        shown = frame.hex(" ").encode()
                        lines.append(
                            b'%s%s", %s' % (start, shown, told[frame[: decides[frame[0]]]])
                        )
                        at = end
                    held = data[at:]
                if lines:
                    os.write(1, b"".join(lines))


if __name__ == "__main__":
    main()
