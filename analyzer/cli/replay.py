"""`bilprov replay`: shows a capture on a screen or in lines, and can send it to a device."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import click
import msgspec

from bilprov.analyzer.cli import options as shared
from bilprov.analyzer.cli.command import argument, command, flag, group, option
from bilprov.analyzer.cli.command_files import keep_memory, protocol_of, split
from bilprov.analyzer.cli.streams import promise_verdict
from bilprov.analyzer.decode.records import FaultRecord, HostRecord, Record
from bilprov.analyzer.decode.session import BOTH
from bilprov.analyzer.output.outputs import Shown, opened_output
from bilprov.analyzer.pipeline import Pipeline
from bilprov.analyzer.replay import capture_decoding as decoding
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.schemas import MS, Chunk, Look
from bilprov.captures.text import quantity
from bilprov.captures.topics import HOST_RAW
from bilprov.spec.by_effect import effect_words

if TYPE_CHECKING:
    from bilprov.analyzer.decode.batch import Batch
    from bilprov.analyzer.replay.comparison import Exchanges
    from bilprov.analyzer.replay.target import Target


class ReplayOptions(msgspec.Struct, frozen=True):
    """The options of `replay`."""

    path: str = argument(metavar="FILE.mcap")
    rate: float = option(
        type=shared.Finite(0),
        default=1.0,
        help="How fast it is played: 1 as recorded, 2 twice as fast, 0 without pauses.",
    )
    span: shared.WindowOptions = group(shared.WindowOptions)
    shown: shared.ShownOptions = group(shared.ShownOptions)
    duration: float | None = option(
        type=shared.Finite(0, min_open=True),
        help="End after S seconds of the recording, counted from --start.",
    )
    port: str | None = shared.port_option(
        "--to", help="Also send the host's bytes to a device there and compare its answers."
    )
    half_duplex: bool = shared.half_duplex_option()
    yes: bool = flag("With --to: the device may move, do not ask.")
    only_reading: bool = shared.only_reading_option()
    max_drive: float = shared.max_drive_option()
    line: shared.SendingLineOptions = group(shared.SendingLineOptions)
    truncation_timeout: float | None = shared.timeout_option()


@command(
    ReplayOptions, only_with={"port": ("yes", "only_reading", "max_drive", *shared.SENDING_LINE)}
)
def replay(options: ReplayOptions) -> int:
    """Examples:
      bilprov replay drive.mcap
      bilprov replay drive.mcap --plain --rate 0 --filter faulty
      bilprov replay drive.mcap --to /dev/ttyUSB0

    On a terminal a screen shows all of it: frames, their fields and bits, faults, the predicted
    state. Space plays from the selected row at the recorded pace, times --rate, and stops again; ?
    lists the keys. Nothing is written except what you export with x.

    With --plain, --format, --judge or --to, and in a pipe, the capture is played in lines, with its
    recorded timing. It is decoded from its raw bytes, and shown as `sniff` would have shown it.

    With --to the host's bytes between --start and --end go to a device too, with their recorded
    timing (at --rate 0 each frame when the one before is answered), and every answer that differs
    from the recorded one is reported: exit code 1 if there is any, 3 if the recording holds no
    answers. It is also 1 if the device floods the line, which ends it, or does not answer the stops
    at the end.

    With --judge the recorded device is judged: a table at the end (with --format jsonl a last
    object of kind judgement) shows which parts of the document the traffic covered and what
    contradicts it; exit code 1 if anything does, 2 if not all of it could be shown, 3 if nothing
    does, but Ctrl-C ended it or no instruction could be judged.
    """
    if options.shown.judged and options.port is not None:
        raise click.UsageError("--judge judges the recorded device; for one at --to, use sniff")
    if options.shown.count is not None and options.port is not None:
        raise click.UsageError("--count counts the frames shown; with --to, --duration ends it")
    if options.shown.judged:
        promise_verdict()
    return _Replay(options).done()


class _Replay:
    """A capture that is played as the options ask: what is opened, decoded and shown of it."""

    def __init__(self, options: ReplayOptions) -> None:
        from bilprov.captures.reader import open_quickly, open_verified

        self.options = options
        self.window = options.span.window(options.duration)
        in_lines = options.port is not None or options.shown.judged
        self.style = options.shown.style(in_lines=in_lines)
        timeout = options.truncation_timeout
        self.timeout = None if timeout is None else round(timeout * MS)
        # All of it is verified for what is compared or judged. For the screen the index is enough,
        # so that the first rows are there at once.
        seeks = self.window.first is not None and not in_lines
        opened = open_quickly if seeks or self.style == "live" else open_verified
        capture = opened(options.path)
        self.protocol = protocol_of(capture)
        if options.half_duplex:
            capture = split(capture, self.protocol)
        if seeks:
            first = self.window.first or 0
            self.opened = decoding.opened_at(capture, self.protocol, first, self.timeout)
        else:
            self.opened = decoding.opened_whole(capture, self.protocol, self.timeout)
        self.capture = self.opened.capture
        self.rows = options.shown.rows.style(self.protocol, self.style)
        test = shared.compiled(options.shown.expression, self.protocol)
        self.test = test and test.started(self.capture.start)
        decoding.require_begun(self.capture, self.window.first)

    def done(self) -> int:
        """Do what the options ask, and return the exit code."""
        if self.style == "live":
            self.look_through()
            return 0
        shared.note(*decoding.said_about(self.capture, self.protocol))
        if self.options.port is not None:
            self.require_allowed(self.options.port)
        judge = None
        if self.options.shown.judged:
            from bilprov.analyzer.monitor.passive_judge import PassiveJudge

            attached = self.capture.metadata.get("attached") != "no"
            paired = decoding.heard(self.capture) >= BOTH
            judge = PassiveJudge(self.protocol, paired=paired, attached=attached)
        with Stopper() as stopper:
            output = opened_output(self.style, self.protocol, self.rows, self.capture.start)
            shown = Shown(output, self.test, self.options.shown.count, self.window)
            pipeline = Pipeline(self.opened.decoder, shown, judge=judge)
            if self.options.port is not None:
                return self.send_again(self.options.port, pipeline, stopper)
            if self.options.rate or judge:
                self.play(pipeline, stopper)
            else:
                for batch in self.opened.decoded(window=self.window, largest=decoding.TEXT_BATCH):
                    if stopper.stopped or shown.full:
                        break
                    shown.show(batch)
        if judge is None:
            return 0
        from bilprov.analyzer.output.findings import tell_findings

        findings = judge.finish()
        findings.stopped = stopper.stopped
        return tell_findings(findings, self.style)

    def require_allowed(self, port: str) -> None:
        """Refuse what may not be sent, or ask; before Ctrl-C is taken over, which ends that."""
        if not self.capture.contents.counts.get(HOST_RAW):
            raise click.UsageError(f"{self.options.path} holds no bytes of the host to send")
        if self.options.only_reading:
            shared.require_reading(self.protocol, self.frames())
        words = "" if self.options.yes else effect_words(self.protocol, self.frames())
        does = "move" if self.protocol.wheels else "do"
        what = f"the device at {port} will {does} as recorded in {self.options.path}"
        shared.confirm_effect(self.protocol, what, words, yes=self.options.yes)

    def frames(self) -> Iterator[bytes]:
        """The frames that the host sent in the window, those that are cut short among them."""
        decoder = decoding.capture_decoder(self.capture, self.protocol, self.timeout)

        def batches() -> Iterator[Batch]:
            for event in self.capture.events():
                if self.window.has(event.t):
                    yield from decoder.feed([event])
            yield from decoder.finish()

        for record in _records(batches()):
            if isinstance(record, HostRecord) and record.judgement:
                yield record.data

    def look_through(self) -> None:
        """Show the capture on the screen until it is left."""
        from bilprov.analyzer.screen.feeds import Told, capture_feed
        from bilprov.analyzer.screen.terminal import shown

        keep_memory()
        capture, options = self.capture, self.options
        feed = capture_feed(self.opened, self.protocol, self.test, options.shown.count, self.window)
        name, line = capture.path.name, decoding.capture_line(capture, self.protocol)
        words = options.shown.expression or ""
        told = Told(name, capture.start, line, self.rows, words, self.test, options.rate)
        with Stopper() as stopper:
            try:
                shown(feed, told, stopper)
            finally:
                feed.stop()
            feed.join()

    def play(self, pipeline: Pipeline, stopper: Stopper) -> None:
        """Show the events at their times, and judge the device by them where there is a judge."""
        now, rate, window, judge = 0, self.options.rate, self.window, pipeline.judge
        events = self.capture.sights() if judge else self.opened.capture.events(self.opened.after)
        # Between two events, time passes as it did in the recording.
        sleep = decoding.interruptible(
            stopper, lambda slept: pipeline.advance(now + int(slept * rate * 1e9))
        )
        for event in decoding.paced(
            events, rate, sleep=sleep, start=window.first, end=window.after
        ):
            if stopper.stopped or pipeline.shown.full:
                return
            now = event.t
            if not isinstance(event, Look):
                pipeline.events([event])
            pipeline.advance(now)
            if judge and isinstance(event, Look) and window.has(now):
                judge.look(event)
        pipeline.finish()

    def send_again(self, port: str, pipeline: Pipeline, stopper: Stopper) -> int:
        """Send the host bytes of the window, compare the answers, and return the exit code."""
        from bilprov.analyzer.replay.comparison import UNANSWERED_STOPS, Exchanges
        from bilprov.analyzer.replay.target import Target, scaled_timeout
        from bilprov.analyzer.transport.port import open_port

        protocol, options = self.protocol, self.options
        recorded, now = Exchanges(), Exchanges()
        pause = decoding.capture_timeout(self.capture, protocol, self.timeout)
        pause = scaled_timeout(pause, options.rate)
        opened = open_port(port, options.line.settings(protocol))

        def heard(record: Record) -> None:
            now.record(record)
            if now.floods(recorded):
                stopper.stop()

        with Target(protocol, opened, pause, stopper, heard, options.max_drive) as target:
            self.send(target, pipeline, recorded)
            if target.driven_out:
                words = target.driven_out_words
                shared.note(f"{words}; --max-drive allows more, and nothing was compared")
                code = 1
            else:
                target.finish()
                code = self.compare(recorded, now, pipeline, stopper)
        if target.answered_stops:
            return code
        shared.note(UNANSWERED_STOPS)
        return code or 1

    def send(self, target: Target, pipeline: Pipeline, recorded: Exchanges) -> None:
        """Send what the host sent, at its times; at the rate 0 each frame by itself."""
        rate, window = self.options.rate, self.window

        def handle(batches: Iterable[Batch]) -> None:
            """Note what was recorded; send each frame after the one before it was answered."""
            for record in _records(batches):
                recorded.record(record)
                if not rate and isinstance(record, HostRecord) and not target.ended:
                    target.send(record.data)
                    target.settle()

        target.begin()
        inside = (event for event in self.capture.events() if window.has(event.t))
        for event in decoding.paced(inside, rate, sleep=target.wait, start=window.first):
            if target.ended:
                break
            handle(pipeline.events([event]))
            if rate and isinstance(event, Chunk) and event.direction == "host":
                target.send(event.data)
            pipeline.advance(event.t)
        handle(pipeline.finish())

    def compare(
        self, recorded: Exchanges, now: Exchanges, pipeline: Pipeline, stopper: Stopper
    ) -> int:
        """Show what was answered otherwise than in the recording, and return the exit code."""
        from bilprov.analyzer.decode.batch import Records
        from bilprov.analyzer.replay.comparison import differences

        sent = recorded.instructions()
        if now.floods(recorded):
            shared.note(
                "the device floods the line, which it did not in the recording: it was stopped, "
                "and nothing was compared"
            )
            return 1
        if stopper.stopped:
            shared.note_suspension(stopper)
            count = quantity(len(now.instructions()), "instruction")
            shared.note(f"stopped after {count}, nothing was compared")
            return 0
        if not any(one.answer for one in sent.values()):
            shared.note("the recording holds no answers: there is nothing to compare with")
            return 3
        found = list(differences(self.protocol, recorded, now))
        for fault in found:
            pipeline.shown.output.show(Records([FaultRecord(fault, self.protocol.power_on)]))
        count = quantity(len(sent), "instruction")
        shared.note(f"{count} sent, {quantity(len(found), 'difference')}")
        return 1 if found else 0


def _records(batches: Iterable[Batch]) -> Iterator[Record]:
    return (record for batch in batches for record in batch.records())
