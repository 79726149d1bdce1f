"""`bilprov replay --to`: sends a capture's host bytes to a device and compares its answers."""

from __future__ import annotations

from collections.abc import Iterable

from bilprov.analyzer.cli.options import note, note_suspension
from bilprov.analyzer.decode.batch import Batch, Records
from bilprov.analyzer.decode.records import Anomaly, FaultRecord, HostRecord, Record, Severity
from bilprov.analyzer.output.outputs import Output, Window
from bilprov.analyzer.pipeline import Pipeline
from bilprov.analyzer.replay.capture_decoding import paced
from bilprov.analyzer.replay.comparison import ReplayRun, differences
from bilprov.analyzer.replay.target import Target
from bilprov.analyzer.transport.signals import Stopper
from bilprov.captures.reader import Capture
from bilprov.captures.schemas import Chunk
from bilprov.captures.text import quantity
from bilprov.spec.protocol import Protocol


def send_again(
    protocol: Protocol,
    capture: Capture,
    pipeline: Pipeline,
    output: Output,
    target: Target,
    run: ReplayRun,
    rate: float,
    window: Window,
    stopper: Stopper,
) -> int:
    """Send the host bytes of the window, compare the answers, and return the exit code.

    `run` holds what was sent to the target and what it answered.
    """
    recorded = ReplayRun()
    target.begin()
    inside = (event for event in capture.events() if window.has(event.t))
    for event in paced(inside, rate, sleep=target.wait, start=window.first):
        if target.ended:
            break
        records = _records(pipeline.events([event]))
        _note_all(recorded, records)
        if rate and isinstance(event, Chunk) and event.direction == "host":
            target.send(event.data)
        if not rate:
            _send_frames(target, records)
        pipeline.advance(event.t)
    rest = _records(pipeline.finish())
    _note_all(recorded, rest)
    if not rate:
        _send_frames(target, rest)
    if target.driven_out:
        note(f"{target.driven_out_words}; --max-drive allows more, and nothing was compared")
        return 1
    target.finish()
    if stopper.stopped:
        note_suspension(stopper)
        note(f"stopped after {quantity(len(run.frames), 'instruction')}, nothing was compared")
        return 0
    return _compare(protocol, recorded, run, output)


def _records(parts: Iterable[Batch]) -> list[Record]:
    return [record for part in parts for record in part.records()]


def _send_frames(target: Target, records: Iterable[Record]) -> None:
    """Send each frame after the one before it was answered, as long as that may go on."""
    for record in records:
        if target.ended:
            return
        if isinstance(record, HostRecord):
            target.send(record.data)
            target.settle()


def _note_all(run: ReplayRun, records: Iterable[Record]) -> None:
    for record in records:
        run.record(record)


def _compare(protocol: Protocol, recorded: ReplayRun, now: ReplayRun, output: Output) -> int:
    if not recorded.answers:
        note("the recording holds no answers: there is nothing to compare with")
        return 3
    found = list(differences(protocol, recorded, now))
    for difference in found:
        about = difference.instruction
        t = 0 if about is None else recorded.frames[about].t
        fault = Anomaly(t, "difference", Severity.ERROR, difference.reason, about)
        output.show(Records([FaultRecord(fault, protocol.power_on)]))
    sent = quantity(len(recorded.frames), "instruction")
    note(f"{sent} sent, {quantity(len(found), 'difference')}")
    return 1 if found else 0
