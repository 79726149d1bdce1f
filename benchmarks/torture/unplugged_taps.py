"""A tap or the device of a bridge is unplugged: all that was heard besides is in the capture.

The other side of the line is played here: instructions and their answers, byte by byte known. One
port is unplugged after an instruction, or in the middle of it, once the capture has all that it
said: what waits in a driver goes with the port.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from random import Random

from benchmarks.adapter import Plug
from benchmarks.commands import bilprov_words, started
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.transport.port import open_port
from bilprov.captures.errors import CaptureError
from bilprov.captures.parts import kept_parts
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk, Direction, Line
from bilprov.spec.codec import judge, nearest

_PATIENCE = 30.0  # s
_FRAMES = 12  # instructions before the port is unplugged, at most, while it is away, and after
_PAUSE = 0.002  # s between instructions
_CHECKED = 5  # instructions at the end that must be decoded as they were sent


@dataclass(frozen=True, slots=True)
class Unplugged:
    """What came of one run: whether it was cut, plugged in again meanwhile, what went wrong."""

    cut: bool
    back: bool
    moving: bool
    wrong: tuple[str, ...]


def until(what: Callable[[], bool], why: str) -> None:
    """Wait for something. Raises TimeoutError."""
    give_up = time.monotonic() + _PATIENCE
    while not what():
        if time.monotonic() > give_up:
            raise TimeoutError(f"{why} after {_PATIENCE:g} s")
        time.sleep(0.002)


class Talk:
    """The traffic of a line: instructions drawn by the seed, with the answers that are right."""

    def __init__(self, draw: Random) -> None:
        self._draw, self._protocol = draw, load_protocol()
        self.written: dict[Direction, bytes] = {"host": b"", "device": b""}
        self.frames: list[bytes] = []

    def next(self) -> tuple[bytes, bytes]:
        """An instruction, and its answer."""
        header = self._draw.randrange(256)
        data = self._draw.randbytes(self._protocol.lengths[header])
        frame = nearest(self._protocol, bytes([header]) + data)
        self.frames.append(frame)
        return frame, bytes([judge(self._protocol, frame).response.code])

    def wrote(self, tap: Direction, data: bytes) -> None:
        """Note what the capture must have."""
        self.written[tap] += data


class Listener:
    """`sniff` while it runs."""

    def __init__(self, stack: ExitStack, folder: Path, *words: str) -> None:
        self.capture = folder / "run.mcap"
        self._errors = folder / "errors"
        errors = stack.enter_context(self._errors.open("wb"))
        more = ("-w", str(self.capture), "--quiet")
        command = bilprov_words("sniff", *words, *more)
        self.process = stack.enter_context(started(command, stderr=errors.fileno()))
        until(
            lambda: bool(kept_parts(self.capture)) or self.capture.exists() or self.ended,
            "no capture",
        )

    @property
    def ended(self) -> bool:
        """Whether it has ended."""
        return self.process.poll() is not None

    @property
    def told(self) -> str:
        """What it said so far."""
        return self._errors.read_text()

    @property
    def served(self) -> str:
        """The name of the pty that a bridge serves."""
        until(lambda: "/dev/" in self.told, "no name of a pty")
        return next(line for line in self.told.splitlines() if line.startswith("/dev/")).strip()

    def says(self, words: str) -> None:
        """Wait until it has said this."""
        until(lambda: words in self.told, f"it does not say {words!r}, but {self.told[-200:]!r}")

    def has(self, tap: Direction, data: bytes) -> bool:
        """Whether the capture has just these bytes of a side now."""
        try:
            return heard(self.capture)[tap] == data
        except CaptureError:  # it has just been made
            return False

    def end(self, *, interrupt: bool = True) -> int:
        """Its exit code, once it was interrupted."""
        if interrupt:
            self.process.send_signal(signal.SIGINT)
        return self.process.wait(_PATIENCE)


class Bridge:
    """Both ends of `sniff --bridge`: the host's pty, and the device, which is a plug."""

    def __init__(self, stack: ExitStack, sniff: Listener, plug: Plug, talk: Talk) -> None:
        self.host = stack.enter_context(open_port(sniff.served))
        self.arrived, self.got = bytearray(), bytearray()
        """What the device and the host heard."""
        self._plug, self._talk = plug, talk

    def exchanges(self, count: int) -> None:
        """Send instructions and their answers, each once the other end has heard what was before.

        Raises TimeoutError where the bridge hands nothing on.
        """
        for _ in range(count):
            frame, answer = self._talk.next()
            self.host.write(frame)
            self._talk.wrote("host", frame)
            _passed(len(frame), self.arrived, lambda: self._plug.pair.read())
            os.write(self._plug.pair.master, answer)
            self._talk.wrote("device", answer)
            _passed(len(answer), self.got, self.host.read)


def _passed(count: int, into: bytearray, read: Callable[[], bytes]) -> None:
    """Wait until so many bytes more have been read."""
    wanted = len(into) + count

    def there() -> bool:
        into.extend(read())
        return len(into) >= wanted

    until(there, "the bridge hands nothing on")


def tapped(seed: int) -> Unplugged:
    """Unplug one of two taps of `sniff`, which listens on, and plug it in again for odd seeds."""
    draw, back = Random(f"{seed} taps"), bool(seed % 2)
    lost: Direction = draw.choice(("host", "device"))
    talk = Talk(draw)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        plugs: dict[Direction, Plug] = {
            "host": Plug(folder / "host"),
            "device": Plug(folder / "device"),
        }
        sniff = Listener(stack, folder, *(str(plug.path) for plug in plugs.values()))

        def said(tap: Direction, data: bytes) -> None:
            if tap in plugs:
                os.write(plugs[tap].pair.master, data)
                talk.wrote(tap, data)

        def exchanges(count: int) -> None:
            for _ in range(count):
                frame, answer = talk.next()
                said("host", frame)
                said("device", answer)
                time.sleep(_PAUSE)

        def run() -> int:
            exchanges(draw.randint(0, _FRAMES))
            if draw.random() < 0.5:  # in the middle of an instruction
                said("host", talk.next()[0][:1])
            said_before = talk.written[lost]
            until(lambda: sniff.has(lost, said_before), f"what the {lost} said is not captured")
            plug = plugs.pop(lost)
            plug.pull()
            sniff.says(f"listening goes on without the {lost}")
            exchanges(draw.randint(0, _FRAMES))
            time.sleep(draw.uniform(0.0, 0.3))
            if back:
                plug.plug()
                sniff.says(f"{plug.path} is there again")
                plugs[lost] = plug
            time.sleep(0.2)  # a pause ends a frame, so that the next one begins as written
            exchanges(_FRAMES)
            code = sniff.end()
            for left in plugs.values():
                left.pull()
            return code

        return _came(run, sniff, talk, back, 2, checked=back or lost == "device")


def bridged(seed: int) -> Unplugged:
    """Unplug the device of a bridge; with --wait, for odd seeds, it is plugged in again."""
    draw, back = Random(f"{seed} bridge"), bool(seed % 2)
    talk = Talk(draw)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        plug = Plug(folder / "port")
        words = ("--bridge", str(plug.path), *(["--wait"] if back else []))
        sniff = Listener(stack, folder, *words)

        def run() -> int:
            bridge.exchanges(draw.randint(1, _FRAMES))
            plug.pull()
            if not back:
                return sniff.end(interrupt=False)
            sniff.says("waiting for the device")
            for _ in range(draw.randint(0, _FRAMES)):  # recorded, though nobody hears it
                frame, _ = talk.next()
                bridge.host.write(frame)
                talk.wrote("host", frame)
                time.sleep(_PAUSE)
            time.sleep(draw.uniform(0.0, 0.3))
            plug.plug()
            sniff.says("is there again")
            time.sleep(0.2)
            bridge.arrived.extend(plug.pair.read())  # what was held back for it
            before = len(bridge.arrived)
            written = len(talk.written["host"])
            bridge.exchanges(_FRAMES)
            if bridge.arrived[before:] != talk.written["host"][written:]:
                raise ValueError("the device did not hear what was sent after the gap")
            if bridge.got != talk.written["device"]:
                raise ValueError("the host did not hear what the device answered")
            code = sniff.end()
            plug.pull()
            return code

        bridge = Bridge(stack, sniff, plug, talk)
        return _came(run, sniff, talk, back, 0 if back else 2, checked=True)


def _came(
    run: Callable[[], int], sniff: Listener, talk: Talk, back: bool, code: int, *, checked: bool
) -> Unplugged:
    """Do a run, and look into its capture; `checked` tells that its last frames are decoded."""
    wrong = []
    try:
        ended = run()
        if ended != code:
            wrong.append(f"exit {ended}, allowed is {code}: {sniff.told[-200:]}")
    except (TimeoutError, subprocess.TimeoutExpired, ValueError, OSError) as error:
        sniff.process.kill()
        wrong.append(str(error))
    if "Traceback" in sniff.told:
        wrong.append(f"a traceback: {sniff.told[-300:]}")
    try:
        wrong += _capture_wrong(sniff.capture, talk, back, checked=checked)
    except CaptureError as error:
        wrong.append(f"the capture cannot be read: {error}")
    return Unplugged(cut=True, back=back, moving=False, wrong=tuple(wrong))


def heard(path: Path) -> dict[Direction, bytes]:
    """The bytes of each side in a capture, also in one that is still written."""
    sides: dict[Direction, bytes] = {"host": b"", "device": b""}
    for message in open_capture(path):
        if isinstance(message, Chunk):
            sides[message.direction] += message.data
    return sides


def _capture_wrong(path: Path, talk: Talk, back: bool, *, checked: bool) -> list[str]:
    """What is missing from the capture, or wrong in it."""
    wrong, there = [], heard(path)
    events = [message.event for message in open_capture(path) if isinstance(message, Line)]
    for tap, data in talk.written.items():
        if there[tap] != data:
            wrong.append(f"{tap}: {len(data)} bytes were said, {len(there[tap])} are there")
    for event, count in (("unplugged", 1), ("reconnected", int(back))):
        if events.count(event) != count:
            wrong.append(f"{events.count(event)} events {event}, not {count}")
    words = bilprov_words("replay", str(path), "--rate", "0", "--format", "jsonl")
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=_PATIENCE)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    last = [row["hex"] for row in rows if row.get("direction") == "host"][-_CHECKED:]
    sent = [frame.hex(" ") for frame in talk.frames[-_CHECKED:]]
    if checked and last != sent:
        wrong.append(f"sent last were {sent}, decoded are {last}")
    return wrong


TAPPED = {"sniff": tapped, "sniff --bridge": bridged}
"""Commands that listen, with what unplugs them in one run."""
