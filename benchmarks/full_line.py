"""Does sniffing keep up with a full line? Both directions at the line's own rate, for some seconds.

Run it: `python -m benchmarks.full_line [SECONDS]`. For each format it prints how many bytes were
sent and captured, how long after the last byte sniff had finished, and the CPU time as a share of
the time on the line. Speed is that ratio; it asserts nothing.
"""

from __future__ import annotations

import fcntl
import os
import pty
import random
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import termios
import threading
import time
from pathlib import Path

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.pty import open_pty
from bilprov.captures.reader import open_capture
from bilprov.captures.topics import HOST_RAW
from bilprov.spec.codec import all_data, raw_frame


def _terminal() -> tuple[int, int]:
    """A terminal of 120 x 40 that somebody reads."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 120, 0, 0))

    def read() -> None:
        try:
            while os.read(ours, 1 << 16):
                pass
        except OSError:
            return

    threading.Thread(target=read, daemon=True).start()
    return ours, theirs


def measure(style: str, seconds: float, folder: Path) -> str:
    """Sniff a full line in this format; returns a line of figures."""
    protocol = load_protocol()
    rate = 1e9 / line_settings(protocol).byte_time
    frames = [
        raw_frame(protocol, spec.id, spec.length, data)
        for spec in protocol.instructions
        for data in all_data(spec)
    ]
    draw, ok = random.Random(1), bytes([protocol.responses[0].code])
    host, device = open_pty(), open_pty()
    capture = folder / f"{style}.mcap"
    ours, theirs = _terminal()
    words = ["sniff", host.name, device.name, "-w", str(capture), "--format", style]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    process = subprocess.Popen(
        [sys.executable, "-m", "bilprov", *words], stdin=theirs, stdout=theirs, stderr=theirs
    )
    time.sleep(2)  # it has started and is waiting
    sent, begun = 0, time.monotonic()
    while (passed := time.monotonic() - begun) < seconds:
        burst = []
        while sent < passed * rate:
            burst.append(draw.choice(frames))
            sent += len(burst[-1])
        if burst:
            os.write(host.master, b"".join(burst))
            os.write(device.master, ok * len(burst))
        time.sleep(0.001)
    last = time.monotonic()
    process.send_signal(signal.SIGINT)
    process.wait(60)
    late = time.monotonic() - last
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    for fd in (ours, theirs):
        os.close(fd)
    host.close()
    device.close()
    captured = open_capture(capture).contents.sizes.get(HOST_RAW, 0)
    return (
        f"{style:6} sent {sent}, captured {captured}, finished {late:.2f} s after the last byte, "
        f"{used / seconds:.2f} of a core"
    )


def main() -> None:
    """Measure each format."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 5.0
    with tempfile.TemporaryDirectory() as folder:
        for style in ("live", "lines", "jsonl"):
            sys.stdout.write(measure(style, seconds, Path(folder)) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
