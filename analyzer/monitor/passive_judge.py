"""Judges a device from ordinary traffic: turns decoded records into coverage and violations.

An anomaly of severity error is a violation. A warning is legal: the device follows another reading
of the document, or is slow. The answers that other readings allow are those of the test suite
(`spec.readings`). What cannot be judged is counted separately and never counted as correct.
The judge uses no port and no clock.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from typing import Any

import msgspec

from bilprov.analyzer.decode.decoder import SIDES, UNREAD
from bilprov.analyzer.decode.records import (
    UNCERTAIN,
    Anomaly,
    DeviceRecord,
    FaultRecord,
    HostRecord,
    LineRecord,
    Record,
    Severity,
)
from bilprov.captures.schemas import MS, Chunk, Line, Look
from bilprov.spec.codec import Judgement
from bilprov.spec.fields import Outcome
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import SILENCE_READING, other_choices
from bilprov.spec.state import State

_KEPT = 1 << 16  # frames remembered of each kind: a limit for the memory of long, varied sessions
_COUNTED = 1 << 16  # different data, up to which it makes sense to say how many of them were met


class Covered(msgspec.Struct, frozen=True):
    """One coverage count: the clause, what is counted, how many were met (`done`) out of `of`."""

    clause: str
    what: str
    done: int
    of: int


class Coverage:
    """Counts the frames and responses that were exercised."""

    def __init__(self, protocol: Protocol) -> None:
        self._protocol = protocol
        self._names = {code.name for code in protocol.responses}
        self._met: defaultdict[str, set[Any]] = defaultdict(set)  # by what is counted

    def frame(self, judgement: Judgement, state: State) -> None:
        """Count a frame; `state` is the predicted state of the device before the frame."""
        wheels, frame = self._protocol.wheels, judgement.frame
        self._meet("headers", frame[0])
        if judgement.valid:
            self._meet("instructions", judgement.id)
            self._meet("valid frames", frame)
            data = self._protocol.layout.of(judgement.id).data_of(frame)
            self._meet(f"data of {judgement.name}", data)
            return
        outcome = None if judgement.truncated else judgement.outcome
        if wheels and getattr(state, wheels.by) in wheels.turns:
            self._meet(_FAULTS, (outcome, getattr(state, wheels.by)))
        if outcome is None:
            # A truncated frame is counted by its header and length; its data do not matter.
            self._meet("frames cut short", (frame[0], len(frame)))
        elif outcome is Outcome.BAD_DATA:
            self._meet("data out of range", frame)
        else:
            unknown = outcome is Outcome.UNKNOWN_ID
            self._meet(f"headers with {'an unused ID' if unknown else 'a wrong length'}", frame[0])

    def answer(self, record: DeviceRecord) -> None:
        """Count the names of an answer's codes."""
        names = record.reply.names if record.reply else (record.name,)
        self._met["response codes"].update(self._names.intersection(names))

    def _meet(self, what: str, value: object) -> None:
        if len(met := self._met[what]) < _KEPT:
            met.add(value)

    def covered(self) -> tuple[Covered, ...]:
        """Every count, in the order of the document's clauses.

        Where frames have other parts besides the header and data, only those of what is said.
        """
        protocol, specs = self._protocol, self._protocol.instructions
        clauses, lengths, wheels = protocol.clauses, protocol.data_lengths, protocol.wheels
        instructions = (clauses.instructions, "instructions", len(specs))
        data = [
            (clauses.instructions, f"data of {spec.name}", spec.valid_count)
            for spec in specs
            if (spec.fields if protocol.plain else 1 < spec.valid_count <= _COUNTED)
        ]
        codes = (clauses.responses, "response codes", len(protocol.codes))
        rows = [instructions, *data, *([codes] if protocol.codes else [])]
        if protocol.plain:
            unused, wrong = len(protocol.unused_ids) * len(lengths), len(specs) * (len(lengths) - 1)
            bad = sum(spec.bad_data_count for spec in specs)
            valid = sum(spec.valid_count for spec in specs)
            rows = [
                (clauses.header, "headers", len(protocol.headers)),
                instructions,
                (clauses.instructions, "valid frames", valid),
                *data,
                (clauses.instructions, "headers with an unused ID", unused),
                (clauses.instructions, "data out of range", bad),
                (clauses.responses, "headers with a wrong length", wrong),
                (clauses.responses, "frames cut short", sum(protocol.lengths)),
                codes,
            ]
        if protocol.plain and wheels:
            longer = any(spec.length < lengths[-1] for spec in specs)
            shorter, cut = any(spec.length for spec in specs), any(protocol.lengths)
            classes = sum([cut, unused > 0, longer, shorter, bad > 0])
            rows.append((clauses.safety, _FAULTS, classes * len(wheels.turns)))
        return tuple(Covered(clause, what, len(self._met[what]), of) for clause, what, of in rows)


_FAULTS = "classes of fault x kinds of motion"
_CHANGES = 16
_NEVER = 1 << 64  # ns
KEPT = 20  # violations that are listed; all are counted

MOVING = "moving after a fault"
_UNSEEN = "it is not clear which instruction was answered"
_DEAF = "the other direction was not listened to"


class Violation(msgspec.Struct, frozen=True):
    """Something a conforming device never does: its time `t` (ns), clause, reading and reason.

    `kind` is that of the anomaly (`disagreeing`, `unused code`, `unsolicited`, `unanswered`) or
    `moving after a fault`; `instruction` is the sequence of the instruction that it is about.
    """

    t: int
    kind: str
    clause: str
    reading: str
    reason: str
    instruction: int | None


class Findings(msgspec.Struct):
    """The results of judging one session; the judge counts in it while the session runs.

    `judged` counts the instructions whose answer was judged, and `looks` the probe readings of a
    robot that a faulty instruction had stopped. `not_judged` counts by reason. `violations` counts
    by kind; the first ones are `listed`. `readings` counts, by reading, the answers that are legal
    although the kit reads the document otherwise; for a grammar without readings, by what is odd
    about them. `unread` is for how long (ns) nothing was read. `stopped` is true where a recording
    was not judged to its end.
    """

    instructions: int = 0
    judged: int = 0
    looks: int = 0
    unread: int = 0
    not_judged: Counter[str] = msgspec.field(default_factory=Counter)
    violations: Counter[str] = msgspec.field(default_factory=Counter)
    readings: Counter[str] = msgspec.field(default_factory=Counter)
    coverage: tuple[Covered, ...] = ()
    listed: list[Violation] = []
    stopped: bool = False

    @property
    def exit(self) -> int:
        """1 if there was a violation, else 3 where not all or nothing could be judged, else 0."""
        unjudged = self.instructions > 0 and not self.judged
        return 1 if self.violations else 3 if self.stopped or unjudged else 0


class PassiveJudge:
    """Judges a running session, record by record.

    `paired` is true if both directions are heard; `attached` is true, as in Session, if listening
    began in running traffic.

    Pairs of instruction and answer cannot be trusted after attaching, after a loss, after a time in
    which nothing was read, and after a frame with a pause that the device may have taken
    for its end: one wrong pair shifts all that follow.
    From then on no anomaly is judged, until both sides were silent for the answer deadline
    with no instruction waiting, or answers in a row agreed of which 16 were unlike the one before
    (wrong pairs agree too while all answers are alike).
    """

    def __init__(self, protocol: Protocol, *, paired: bool = True, attached: bool = False) -> None:
        self._protocol = protocol
        self._paired = paired
        self._coverage = Coverage(protocol)
        self._findings = Findings()
        # Instructions that wait for an answer, and whether a device that flushes may lose them.
        self._pending: dict[int, bool] = {}
        self._flushes_until = -1  # R-drain-known: the device may flush until the line is idle
        self._newest = -1
        self._state = protocol.power_on
        self._stopped_by: int | None = None  # the faulty instruction that stopped the robot
        self._away: frozenset[str] = frozenset()  # the sides whose port is unplugged
        self._said = 0  # time of the host's last byte
        self._decoded = 0  # time up to which host bytes are decoded
        self._refused = 0  # when the instruction of `_stopped_by` was answered, or else ended
        self._stood = False  # whether the robot was seen standing still since then
        self._in_step_from = _NEVER if attached else 0  # from when on pairs can be trusted
        self._agreed = 0  # answers that agreed in a row and were unlike the one before
        self._answer: int | None = None
        self._heard = 0  # time of the last byte of either side
        self._unread_from: int | None = None  # since when nothing was read, until the next event
        self._deadline = round(protocol.timing.answer_deadline * MS)
        self._idle = round(protocol.timing.truncation_timeout * MS)
        self._pause = round(protocol.timing.truncation_shortest * MS) // 2
        self._longest_stop = round(protocol.timing.stop_longest * MS)

    def event(self, event: Chunk | Line) -> None:
        """Note the time of an event, before the records that are decoded from it."""
        if self._unread_from is not None:
            self._findings.unread += event.t - self._unread_from
            self._heard, self._unread_from = event.t, None
        if not isinstance(event, Chunk):
            return
        silent = event.t - self._heard >= self._deadline and not self._pending
        if silent and self._in_step_from == _NEVER:
            self._in_step_from = event.t
        self._heard = event.t
        if event.direction == "host":
            self._said = event.t

    def record(self, record: Record) -> None:
        """Judge a record."""
        if isinstance(record, HostRecord):
            self._host(record)
        elif isinstance(record, DeviceRecord):
            self._device(record)
        elif isinstance(record, FaultRecord):
            self._unanswered(record.fault)
        else:
            self._line(record)

    def look(self, look: Look) -> None:
        """Judge a look of the probe: a robot stopped by a faulty instruction must not be moving."""
        # While an instruction is under way, it is unknown whether it or the look came first.
        if self._stopped_by is None or self._pending or self._said > self._decoded:
            return
        since = look.t - self._refused
        if look.moving and since <= self._longest_stop and not self._stood:
            return  # it may still be stopping (R-stop-latency)
        if look.moving is None:
            self._findings.not_judged["the probe does not know whether the robot moves"] += 1
            return
        self._findings.looks += 1
        self._stood = not look.moving
        if look.moving:
            number, self._stopped_by = self._stopped_by, None
            reason = (
                f"seen moving {since / MS:.0f} ms after the faulty instruction {number} "
                "was over, and nothing has set it in motion since"
            )
            fault = Anomaly(look.t, MOVING, Severity.ERROR, reason, number)
            self._violate(fault, self._protocol.clauses.safety, "R-stop-latency")

    def finish(self) -> Findings:
        """End the traffic and return the findings."""
        self._give_up("the traffic ended before the answer was due")
        self._findings.coverage = self._coverage.covered()
        return self._findings

    def _host(self, record: HostRecord) -> None:
        judgement, number = record.judgement, record.sequence
        self._decoded = max(self._decoded, record.end)
        if judgement is None or number is None:
            self._findings.not_judged["bytes that belong to no frame"] += len(record.data)
            self._stopped_by = None  # the device may have read these bytes as an instruction
            return
        self._findings.instructions += 1
        if record.t < self._in_step_from:  # it was buffered: the host was not silent then
            self._in_step_from = _NEVER
        self._coverage.frame(judgement, self._state)
        self._state = record.state
        if not judgement.valid and self._protocol.stops(self._protocol.on_fault):
            self._stopped_by, self._stood = number, False
            self._refused = max((record.end, *(fault.t for fault in record.faults)))
        elif judgement.valid and self._protocol.directed(self._state):
            self._stopped_by = None
        if record.end - record.t > self._pause and not judgement.truncated:
            self._out_of_step()  # the device may have given up on it (R-truncation-timeout)
        lost = record.t <= self._flushes_until
        self._newest = number
        if not judgement.answer_due:
            self._findings.not_judged["no answer is due"] += 1
            return
        if lost or not (judgement.valid or _is_short(judgement)):
            self._flushes_until = record.end + self._idle
        if self._paired and not self._away:
            self._pending[number] = lost
        else:
            self._findings.not_judged[_DEAF] += 1

    def _device(self, record: DeviceRecord) -> None:
        number = record.instruction
        if number is None:
            self._unpaired(record)
            return
        if number == self._stopped_by:
            self._refused = max(self._refused, record.t)
        if self._pending.pop(number, False):
            self._flushes_until = -1  # it does not flush
        if record.answered and _is_short(record.answered) and number == self._newest:
            self._flushes_until = record.t + self._idle
        self._agreed = self._agreed + (record.byte != self._answer) if record.agrees else 0
        self._answer = record.byte
        if self._agreed >= _CHANGES:
            self._in_step_from = 0
        if record.t < self._in_step_from and not record.agrees:
            self._findings.not_judged[_UNSEEN] += 1
            return
        if ("disagreeing", Severity.INFO) in [(one.kind, one.severity) for one in record.faults]:
            self._findings.not_judged["the grammar may lack the instruction"] += 1
            return
        self._findings.judged += 1
        self._coverage.answer(record)
        for fault in record.faults:
            if fault.severity is Severity.ERROR and record.answered:
                self._violate(fault, record.answered.clause, record.answered.reading)
            elif fault.severity is Severity.WARNING and record.answered:
                reading = "R-answer-deadline" if fault.kind == "slow" else "R-answer-point"
                if fault.kind == "disagreeing":
                    choices = other_choices(self._protocol, record.answered)
                    reading = next(one.reading for one in choices if one.code == record.byte)
                self._legal(fault, reading)

    def _unpaired(self, record: DeviceRecord) -> None:
        """Judge a device byte that answers no instruction, or none that was heard."""
        errors = [fault for fault in record.faults if fault.severity is Severity.ERROR]
        # A banner before the first instruction, an answer around a loss: see R-unsolicited.
        doubts = {fault.kind for fault in record.faults if fault.severity is Severity.INFO}
        uncertain = bool(doubts - {UNCERTAIN})  # bytes that answer nothing, wherever they end
        if uncertain or not errors or record.t < self._in_step_from:
            self._findings.not_judged[_UNSEEN if self._paired else _DEAF] += 1
            return
        self._violate(errors[0], self._protocol.clauses.responses, "R-unsolicited")

    def _unanswered(self, fault: Anomaly) -> None:
        if fault.instruction is None or fault.instruction not in self._pending:
            return
        lost = self._pending.pop(fault.instruction)
        if fault.t < self._in_step_from:
            self._findings.not_judged[_UNSEEN] += 1
            return
        self._findings.judged += 1
        if lost:
            self._legal(fault, "R-drain-known")
        elif fault.severity is Severity.ERROR:
            self._violate(fault, self._protocol.clauses.responses, "R-answer-deadline")
        else:
            self._legal(fault, SILENCE_READING)

    def _line(self, record: LineRecord) -> None:
        event, tap = record.value.event, record.value.tap
        taps: set[str] = {tap} if tap else set(SIDES)
        if event == "unplugged":
            self._away |= taps
        elif event == "reconnected":
            self._away -= taps
        lost = record.lost or bool(self._away)
        if lost:
            self._give_up("bytes were lost before the answer")
            self._heard = record.t
        if event == UNREAD:
            self._unread_from = record.t
        if lost or event == UNREAD:
            self._out_of_step()
            self._stopped_by = None

    def _out_of_step(self) -> None:
        self._in_step_from, self._agreed = _NEVER, 0

    def _give_up(self, reason: str) -> None:
        if self._pending:
            self._findings.not_judged[reason] += len(self._pending)
            self._pending.clear()

    def _legal(self, fault: Anomaly, reading: str) -> None:
        """Count what is legal, by its reading; the readings are those of the car's document."""
        declared = "later than TIMING.answer_deadline" if fault.kind == "slow" else fault.kind
        self._findings.readings[reading if self._protocol.plain else declared] += 1

    def _violate(self, fault: Anomaly, clause: str, reading: str) -> None:
        if not self._protocol.plain:  # the readings are those of the car's document
            reading = "TIMING.answer_longest" if fault.kind == "unanswered" else ""
        self._findings.violations[fault.kind] += 1
        if len(self._findings.listed) < KEPT:
            self._findings.listed.append(
                Violation(fault.t, fault.kind, clause, reading, fault.reason, fault.instruction)
            )


def _is_short(judgement: Judgement) -> bool:
    """Whether the frame is complete, but its header announces too few data bytes.

    A device may answer such a frame only after it has taken the next byte.
    """
    return judgement.outcome is Outcome.TOO_FEW and not judgement.truncated
