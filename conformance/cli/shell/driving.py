"""Does what is typed, line by line, on one robot: sends, shows the answers, looks, stops.

A probe is asked while the port is read.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal

import msgspec

from bilprov.analyzer.cli.options import note
from bilprov.analyzer.cli.typed_input import PAUSE, SEPARATOR, bytes_or_pause, fields_in_words
from bilprov.analyzer.client.probes import Probe
from bilprov.analyzer.decode.records import DeviceRecord, Record
from bilprov.analyzer.output.console import facts, heading, show
from bilprov.analyzer.output.outputs import opened_output, write_out
from bilprov.analyzer.replay.comparison import FLOOD, FLOOD_WORDS, AnswerCheck
from bilprov.analyzer.replay.target import Target
from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.closing import Closing
from bilprov.captures.schemas import Look
from bilprov.conformance.cli.shell.options import SendOptions
from bilprov.spec.by_effect import change_by
from bilprov.spec.codec import free_parts
from bilprov.spec.protocol import Protocol

STEP = 0.5
"""Seconds of waiting at most: a signal that came just before it began is noticed then."""


def asked(
    probe: Probe,
    attend: Callable[[float, Sequence[int]], list[int]],
    stopper: Stopper,
    now: Callable[[], int] = time.monotonic_ns,
) -> Look | None:
    """Ask the probe and return what it sees, as of `now` (ns).

    `attend` waits at most some seconds for one of the descriptors, reads the port meanwhile, and
    returns those that are readable. A probe that takes long is given up when `stopper` is asked to
    stop: None. Raises ProbeError, and LinkError as `attend` does.
    """

    def wait(patience: int, waits: int) -> bool:
        ready = waits in attend(min(patience / 1e9, STEP), [waits])
        if not ready and stopper.stopped and probe.costly:  # a command, or a person: do not wait
            probe.close()
            raise InterruptedError
        return ready

    try:
        return probe.look(now, wait)
    except InterruptedError:
        return None


def seen_words(look: Look | None) -> str:
    """Whether the robot was seen to move, in words; "" where nothing was seen since."""
    if look is None:
        return ""
    return {True: "seen moving", False: "seen stopped", None: "not seen"}[look.moving]


def look_words(look: Look | None) -> str:
    """All that the probe saw, in words: `seen moving: motion forward speed 80`."""
    told = _told(look).items() if look else ()
    facets = [f"{name} {value}" for name, value in told if value is not None]
    return f"{seen_words(look) or 'not observed'}{': ' if facets else ''}{' '.join(facets)}"


def look_text(look: Look, style: Literal["lines", "jsonl"]) -> str:
    """The line of a look among those of the frames; its time is in ns since their start."""
    seconds = look.t / 1e9
    if style == "lines":
        return f"{seconds:12.6f} - {look_words(look)}\n"
    line = {"t": seconds, "direction": None, "kind": "look", "moving": look.moving, **_told(look)}
    return msgspec.json.encode(line).decode() + "\n"


def _told(look: Look) -> dict[str, str | int | None]:
    """What a look tells besides whether the device moves."""
    return {name: getattr(look, name) for name in look.__struct_fields__[2:]}


COMMENT = "#"


class Driving(Closing):
    """One robot at an open port, driven by lines of text; it is stopped on every way out.

    `timeout` (ns) is the longest pause inside a frame. `probe` sees the robot, None if nothing
    does. One that has driven for the `max_drive` of the options without a new instruction is
    stopped.

    `target` is the robot, `check` counts what is wrong with its answers, `look` is what the probe
    saw since the last instruction, and `over` is true once the user has asked to leave. `words` are
    the words that can be typed besides instructions, and what they are for.
    """

    def __init__(
        self,
        protocol: Protocol,
        options: SendOptions,
        port: Port,
        timeout: int,
        stopper: Stopper,
        probe: Probe | None,
    ) -> None:
        self._protocol, self._options = protocol, options
        self.target = Target(protocol, port, timeout, stopper, self._heard, options.max_drive)
        self.check = AnswerCheck()
        self.look: Look | None = None
        self.over = False
        stopping = self._stopping_words(protocol)
        stops = "stops it and " if stopping else ""
        self.words: dict[str, tuple[Callable[[], object], str]] = {
            "help": (self._help, "shows this"),
            "state": (self._tell_state, "shows what the instructions so far predict"),
            "look": (self._tell_look, "shows what the probe sees"),
            **stopping,
            "quit": (self._quit, f"{stops}leaves, as Ctrl-D does"),
            "exit": (self._quit, "does the same"),
        }
        self._stopper = stopper
        self._output = opened_output(options.style, protocol)
        self._probe = probe
        self._unasked = 0  # bytes that answer no instruction, since the line began
        self._abandoned = False  # the rest of the line

    def _stopping_words(self, protocol: Protocol) -> dict[str, tuple[Callable[[], object], str]]:
        """The words that stop the device, of a grammar that tells when it is at rest."""
        if protocol.plain and protocol.stop_or_none:
            stop = bytes([protocol.pad_byte])
            return {
                "stop": (partial(self._send, stop), f"stops the {protocol.device}"),
                "home": (self._home, "stops it, and begins a new frame if one was cut short"),
            }
        return {"home": (self._home, "brings it to rest")} if protocol.at_rest else {}

    def begin(self) -> None:
        """Home the robot and look at it. Raises LinkError and ProbeError."""
        self.target.begin()
        self._look_if_cheap()

    def do(self, line: str) -> bool:
        """Do what a line says, one item after the other; return whether all of it was done.

        Pasted text may hold several lines. One with a mistake is not begun. A signal, the limit of
        driving, and a device that floods abandon the rest. Raises ValueError for a mistake, in one
        sentence; LinkError and ProbeError.
        """
        parts = [part.partition(COMMENT)[0] for part in line.splitlines()]
        items = [item.strip() for item in SEPARATOR.join(parts).split(SEPARATOR)]
        actions = [self._action(item) for item in items if item]
        self._unasked, self._abandoned = 0, False
        for action in actions:
            action()
            if self._broken_off:
                break
        else:
            self._look_if_cheap()
        return not (self._abandoned or self._stopper.stopped)

    def attend(self, seconds: float = 0.0, also: Sequence[int] = ()) -> list[int]:
        """Read what the robot sends, waiting at most `seconds` for it or for a descriptor.

        Returns those of the descriptors `also` that are readable. Stops a robot that has driven too
        long or that floods the line. Raises LinkError.
        """
        flooded, driven_out = self._unasked >= FLOOD, self.target.driven_out
        ready = self.target.pump(seconds, also)
        if self._unasked >= FLOOD and not flooded:
            self.halt(FLOOD_WORDS)
        elif self.target.driven_out and not driven_out:
            self._tell_stopped(self.target.driven_out_words)
        return ready

    def halt(self, why: str) -> None:
        """Stop the robot now, say why, and abandon the rest of the line.

        Raises LinkError and ProbeError.
        """
        self._home()
        self._tell_stopped(self.target.stopped_words(why))

    def close(self) -> None:
        """Stop the robot and close its port; further calls do nothing."""
        self.target.close()

    @property
    def _broken_off(self) -> bool:
        return self._abandoned or self.over or self._stopper.stopped

    def _heard(self, record: Record) -> None:
        self.check.record(record)
        if isinstance(record, DeviceRecord) and record.instruction is None:
            self._unasked += len(record.data)
            if self._unasked > FLOOD:
                return
        self._output.records([record])

    def _action(self, item: str) -> Callable[[], object]:
        """What an item of a line stands for. Raises ValueError if it stands for nothing."""
        word = item.lower()
        instructions = {spec.name.lower() for spec in self._protocol.instructions}
        if word in self.words and word not in instructions:
            return self.words[word][0]
        what = bytes_or_pause(self._protocol, item, self.words)
        if isinstance(what, float):
            return partial(self._pause, what)
        change = change_by(self._protocol, what) if self._options.only_reading else ""
        if change:
            raise ValueError(f"{change}: --only-reading sends what changes nothing")
        return partial(self._send, what)

    def _send(self, data: bytes) -> None:
        self.target.send(data)
        self.look = None
        self.target.settle()
        self.attend()

    def _pause(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while not self._broken_off and (left := until - time.monotonic()) > 0:
            self.attend(min(left, STEP))

    def _tell_stopped(self, words: str) -> None:
        self._abandoned, self.look = True, None
        note(words)
        self._look_if_cheap()

    def _home(self) -> None:
        self.look = None
        self.target.home()

    def _quit(self) -> None:
        self.over = True

    def _tell_state(self) -> None:
        state, protocol = self.target.state, self._protocol
        words = [state.described] if protocol.variables else ["nothing, the grammar has no STATE"]
        if protocol.at_rest:
            words.append("moving" if state.moving else "not moving")
        write_out(f"predicted: {', '.join(words)}\n")

    def _tell_look(self) -> None:
        if self._probe is None:
            write_out(f"nothing sees the {self._protocol.device}: begin with --probe\n")
            return
        self._look(self._probe)
        if self._options.style == "jsonl" and self.look is not None:
            write_out(look_text(self.look, self._options.style))
        else:
            write_out(f"{look_words(self.look)}\n")

    def _look_if_cheap(self) -> None:
        if self._probe is not None and not self._probe.costly:
            self._look(self._probe)

    def _look(self, probe: Probe) -> None:
        """Ask the probe, reading the port meanwhile. Raises ProbeError and LinkError."""
        self.look = None
        self.look = asked(probe, self.attend, self._stopper, self.target.now)

    def _help(self) -> None:
        specs = self._protocol.instructions
        stops = f"stops the {self._protocol.device}" if "home" in self.words else "ends that"
        show(
            heading("Instructions, in any case"),
            facts((f"{spec.name} {fields_in_words(spec)}".strip(), spec.prose) for spec in specs),
            heading("Also"),
            facts(
                [
                    *(
                        (f"{part.name}={part.allowed_in_short}", f"in each frame: {part.prose}")
                        for part in free_parts(self._protocol)
                    ),
                    ("81 05", "bytes in hex, right or wrong"),
                    (f"{PAUSE}500", f"waits, in milliseconds; Ctrl-C {stops}"),
                    (SEPARATOR, "stands between several on a line"),
                    (COMMENT, "begins a comment"),
                    *((word, what) for word, (_, what) in self.words.items()),
                ]
            ),
        )
