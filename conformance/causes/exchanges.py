"""Rebuilds the exchanges of a run from its trace: each frame, its answers, and what was seen.

Each exchange is compared with the model of a conforming device. A deviation belongs to the frame
that may have caused it: what was wrong before a frame is not counted against it, and what a later
frame hides is no evidence for it.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import NamedTuple

from bilprov.analyzer.client.operations import Observation, Received, Send
from bilprov.captures.schemas import MS, Look
from bilprov.conformance.cases.steps import FrameClass, Step, step_of
from bilprov.conformance.causes.trace import Done, Event, Mark
from bilprov.conformance.oracle.judge import differences, facets_of_motion
from bilprov.conformance.oracle.sight import facets_of
from bilprov.conformance.oracle.state_model import ExpectedState, Model
from bilprov.spec.codec import Judgement, judge
from bilprov.spec.motion import MOTIONS, Moment, Wheels, visible_motion
from bilprov.spec.readings import open_after

ANSWER, MOTION, WHEELS = "answer", "motion", "wheels"
"""The facets besides the values that are set; no variable has these names but the kind of motion.

Where a motion is right, so are the wheels if no later frame has changed how they turn.
"""
ASTRAY = "turning a wheel wrongly"
"""What is seen of a motion in the right direction with wrong wheels."""
FRAMES, FAULTS, VALID, TRUNCATED, STOPPING = "frames", "faults", "valid", "truncated", "stopping"
ROTATION, MOVING = Moment.ROTATION.value, "moving"
IN_A_ROW = "two faults in a row"
"""Classes of frames that are counted, besides each `kind` and each open point."""
_OFTEN = 3
"""Late answers from which on one that did not come may still come; fewer are a busy host's."""
_NEARLY = 0.9
"""The share of a time-out from which it is not certain, as measured, that a frame goes on."""


class Deviation(NamedTuple):
    """How an exchange deviates in one facet.

    `facet` is `answer`, `motion` or a variable of the state. `how` is `silent`, `other`, `extra` or
    `late` of an answer; `wrong`, `late` or `changed` (right at first) of what was seen. `expected`
    and `seen` are response codes, kinds of motion or values.
    """

    facet: str
    how: str
    expected: int | str | None = None
    seen: int | str | None = None

    @property
    def right_code(self) -> bool:
        """Whether it is an answer with the right code: the frame was taken as what it is."""
        return self.facet == ANSWER and self.how in ("late", "extra")


class History(NamedTuple):
    """What came before a frame since power-on.

    `row` are the consecutive faults right before it, `times` how many frames of each class came
    before it, and `last` the number of the last one, from 0 on.
    """

    row: int
    times: Mapping[str, int]
    last: Mapping[str, int]

    @property
    def frames(self) -> int:
        """How many frames came before it."""
        return self.times.get(FRAMES, 0)


@dataclass(slots=True, eq=False, repr=False)
class Exchange:
    """One frame as it went over the line, with the state before it and what came of it.

    Times are in ns: `start` and `end` those of its first and last byte, `pauses` those inside it
    as (how many bytes stand before it, how long), `gap` from the frame before to its header (None
    after power-on). `ahead` is how many frames before it were not answered yet, `in_one_go` how
    many bytes were sent up to its last without waiting for an answer. `before` and `after` are the
    states of a conforming device, `accepted` its answers, `watched` how long (ns) it was then
    looked at. `unbroken` is how long (ns) the line was listened to from its first answer until the
    next frame came, `looked` whether the device was looked at before that. `assumed` are the facets
    of `before` that frames had set which were not looked at. `settled` are the facets
    of the state that were right after it, `right` those that it has certainly made right,
    `deviations` those that were wrong. `as_frames` gives the answers due to bytes that a device
    takes for frames of their own.
    """

    case: str
    judgement: Judgement
    step: Step
    start: int
    end: int
    pauses: tuple[tuple[int, int], ...]
    gap: int | None
    ahead: int
    in_one_go: int
    history: History
    previous: Exchange | None
    before: ExpectedState
    after: ExpectedState
    as_frames: AsFrames
    accepted: frozenset[int | None] = frozenset()
    watched: int = 0
    unbroken: int = 0
    looked: bool = False
    codes: tuple[tuple[int, int], ...] = ()
    assumed: frozenset[str] = frozenset()
    right: set[str] = field(default_factory=set)
    settled: set[str] = field(default_factory=set)
    deviations: dict[str, Deviation] = field(default_factory=dict)

    @property
    def pause(self) -> int:
        """The longest pause inside the frame (ns), 0 where its bytes came in one go."""
        return max((length for _, length in self.pauses), default=0)

    def settles(self, facet: str) -> bool:
        """Whether nothing deviated and this facet (for an answer, any) was seen right after it."""
        seen = self.settled if facet == ANSWER else facet in self.settled
        return bool(seen) and not self.deviations

    @property
    def answered(self) -> int:
        """When its last answer came after its end (ns), 0 where none did."""
        return self.codes[-1][0] - self.end if self.codes else 0

    @property
    def kind(self) -> str:
        """The instruction's name of a valid frame, else its outcome; `truncated` for a cut one."""
        if self.step.truncated:
            return TRUNCATED
        return self.judgement.name if self.judgement.valid else self.judgement.outcome.value

    def sets(self, facet: str) -> bool:
        """Return whether it is an instruction that sets this variable of the state."""
        effect = self.step.frame_effect.effect
        name = self.before.state.wheels.by if facet == MOTION else facet
        return effect is not None and effect.sets(name)


class Bag(NamedTuple):
    """The exchanges one of which has caused a deviation."""

    deviation: Deviation
    exchanges: tuple[Exchange, ...]

    @property
    def still(self) -> str:
        """The kind of motion of a device that stands still."""
        return str(self.exchanges[0].before.state.wheels.still)

    @property
    def keeps_moving(self) -> bool:
        """Whether the device moves where it must stand: what matters most."""
        facet, _, expected, seen = self.deviation
        return facet == MOTION and expected == self.still != seen


class Timing(NamedTuple):
    """Times of a line (ns): what pause ends a frame, a byte, how late an answer may come."""

    timeout: int
    byte_time: int
    longest: int


AsFrames = Callable[[bytes], "set[tuple[int | None, ...]]"]
Known = Callable[[Exchange], Mapping[str, "int | str | None"]]


def _nothing(exchange: Exchange) -> Mapping[str, int | str | None]:
    return {}


class Exchanges:
    """The exchanges of a trace, and the bags of those that deviate from the model.

    `known` gives what a device is known to make of an exchange, besides the model, by facet;
    `unread` are the headers whose data bytes it is known to take for frames of their own.
    """

    def __init__(
        self,
        model: Model,
        events: Iterable[Event],
        timing: Timing,
        known: Known = _nothing,
        unread: Container[int] = (),
    ) -> None:
        self.all: list[Exchange] = []
        self._known, self._unread = known, unread
        self.bags: list[Bag] = []
        self._model, self._car = model, model.protocol.car
        self._of_motion = facets_of_motion(model.protocol)
        self._judged = cache(partial(judge, model.protocol))
        self._as_frames = cache(self._answers_to)
        self.timing = timing
        self._timeout, self._byte_time, self._longest = timing
        self._stop_longest = int(model.protocol.timing.stop_longest * MS)
        self._case, self._first = "", 0
        self._expected = model.found()
        self._late = 0
        self._power_on()
        for event in events:
            self._take(event)
        self._close()

    def _power_on(self) -> None:
        self._held = b""
        self._held_start = self._held_end = 0
        self._pauses: tuple[tuple[int, int], ...] = ()
        self._burst: list[Exchange] = []
        self._answers: list[tuple[int, int]] = []
        self._looks: list[tuple[int, Look]] = []
        self._counts = History(0, {}, {})
        self._previous: Exchange | None = None
        self._over = 0
        self._waited = 0
        self._owed = 0
        self._lost = False
        self._unseen: dict[str, list[Exchange]] = {}
        self._assumed: frozenset[str] = frozenset()

    def _take(self, event: Event) -> None:
        match event:
            case Done(Send(data), int(t)):
                self._sent(t, data)
            case Done(_, Received(answers, now)):
                for answer in answers:  # a device that floods gives many: none is copied
                    self._silent_until(answer[0])
                    if self._cut_at(*answer):
                        self._frame()
                    if self._burst:  # else nothing has asked for it
                        self._answers.append(answer)
                self._silent_until(now)
                self._waited = now
            case Done(_, Observation(asked, _, look)):
                self._silent_until(asked)
                if self._burst:
                    self._looks.append((asked, look))
                elif not self._lost:
                    self._resynchronise(look)
            case Done():  # switched off and on, or its port was lost and found again
                self._close()
                self._power_on()
                self._expected = ExpectedState(self._model.protocol.power_on)
            case Mark(ident, False):
                self._begin(ident)
            case Mark(ident, True):
                self._close()
                for exchange in self.all[self._first :]:
                    exchange.case = exchange.case or ident
                self._begin("" if self._case == ident else self._case)

    def _begin(self, ident: str) -> None:
        """Begin a case, "" for what is between two; one concluded without a beginning claims it."""
        self._close()
        self._case, self._first = ident, len(self.all)
        self._lost = False

    def _sent(self, t: int, data: bytes) -> None:
        start = t - (len(data) - 1) * self._byte_time
        self._silent_until(start)
        if not self._held and self._burst and self._settled(start):
            self._close()
        for number, byte in enumerate(data):
            at = start + number * self._byte_time
            if not self._held:
                self._held_start, self._pauses = at, ()
            elif at - self._held_end >= MS:
                self._pauses += ((len(self._held), at - self._held_end),)
            self._held += bytes([byte])
            self._held_end = at
            header = self._held[0]
            if header in self._unread or len(self._held) > self._model.protocol.lengths[header]:
                self._frame()

    def _settled(self, now: int) -> bool:
        """Whether the frames of the burst were waited for."""
        late = now - self._burst[-1].end > self._longest
        return bool(self._looks) or late or len(self._answers) >= len(self._burst)

    def _silent_until(self, now: int) -> None:
        if self._held and now - self._held_end >= self._timeout:
            self._frame()

    def _cut_at(self, now: int, code: int) -> bool:
        """Whether an answer is that to the incomplete frame, cut short sooner than was measured.

        A busy host sends a frame earlier than it notes.
        """
        pausing = self._held and 2 * (now - self._held_end) > self._timeout
        if not pausing or len(self._answers) < len(self._burst):
            return False
        step = step_of(self._model.protocol, self._held)
        return code in self._accepted(step)

    def _frame(self) -> None:
        protocol, data = self._model.protocol, self._held
        sent, self._held = len(data), b""
        if data[0] in self._unread:
            data += bytes(protocol.lengths[data[0]])  # what they would be does not matter
        judgement = self._judged(data)
        step = step_of(protocol, data)
        exchange = Exchange(
            self._case,
            judgement,
            step,
            self._held_start,
            self._held_end,
            self._pauses,
            self._held_start - self._over if self._previous else None,
            max(0, len(self._burst) - len(self._answers)),
            sent + (self._burst[-1].in_one_go if self._burst else 0),
            self._counts,
            self._previous,
            self._expected,
            self._expected,
            self._as_frames,
        )
        row, times, last = self._counts
        points = (p.id for p in open_after(protocol, step.frame_effect.effect).values())
        general = FAULTS if step.faulty else VALID
        classes = {FRAMES, general, exchange.kind, step.point, *points}
        if protocol.stops(step.frame_effect.effect or protocol.on_fault):
            classes.add(STOPPING)
        moment = self._car.moment(step.frame_effect.effect)
        if moment in MOTIONS:
            classes |= {MOVING, moment.value}
        if step.faulty and row:
            classes.add(IN_A_ROW)
        self._counts = History(
            row + 1 if step.faulty else 0,
            {**times, **{one: times.get(one, 0) + 1 for one in classes}},
            {**last, **dict.fromkeys(classes, self._counts.frames)},
        )
        self._previous, self._over = exchange, self._held_end
        self._burst.append(exchange)

    def _close(self) -> None:
        """Judge the frames of a burst from their answers and the looks after them."""
        burst, answers, looks = self._burst, self._answers, self._looks
        self._burst, self._answers, self._looks = [], [], []
        if not burst:
            return
        if (burst[0].gap or 0) > 2 * self._longest:
            self._owed = 0
        if self._late >= _OFTEN and self._owed:
            self._lost = True  # what comes now may be what an earlier frame waits for
        if any(exchange.pause > _NEARLY * self._timeout for exchange in burst):
            self._lost = True  # it may have been cut
        self._owed += len(burst) - len(answers)
        guilty: Exchange | None = None
        over = [*(behind.start for behind in burst[1:]), self._waited]
        pairs = self._paired(burst, answers)
        for exchange, codes, until in zip(burst, pairs, over, strict=True):
            exchange.codes = tuple(codes)
            exchange.unbroken = until - (codes[0][0] if codes else exchange.end)
            exchange.before = self._expected
            deviation = self._judged_answer(exchange)
            if self._lost:
                pass
            elif deviation:
                candidates = self._unanswered(burst, exchange) if not codes else (exchange,)
                for candidate in candidates:
                    candidate.deviations[ANSWER] = deviation
                self.bags.append(Bag(deviation, candidates))
                if not deviation.right_code:
                    guilty = guilty or exchange
                self._lost = deviation.how == "silent"
                self._late += deviation.how == "late"
            elif not self._chosen(exchange.step):
                exchange.right.add(ANSWER)
            self._may_show_in(exchange)
            self._expected = self._model.after(self._expected, exchange.step.frame_effect)
            exchange.after = self._expected
            if known := self._known(exchange):
                self._expected = self._made(known)
            if guilty:
                self._expected = replace(
                    self._expected, unknown=frozenset(self._model.protocol.variables)
                )
            if exchange is burst[-1] or not repeats(exchange):
                self.all.append(exchange)
        if (guilty or len(answers) > len(burst)) and len(burst) > 1:
            for exchange in burst:
                exchange.right.discard(ANSWER)  # whose answer is whose is not certain
        if self._lost:
            self._unseen.clear()
        elif looks:
            self._judge_looks(burst, answers, looks, guilty)

    def _made(self, known: Mapping[str, int | str | None]) -> ExpectedState:
        """The expected state with the values of facets that this device is known to make."""
        named = {self._car.by if facet == MOTION else facet: v for facet, v in known.items()}
        values = {name: value for name, value in named.items() if value is not None}
        unknown = self._expected.unknown.union(named).difference(values)
        return replace(self._expected, state=self._expected.state.but(**values), unknown=unknown)

    def _paired(
        self, burst: list[Exchange], answers: list[tuple[int, int]]
    ) -> list[list[tuple[int, int]]]:
        """The answers of each frame of a burst: equally many where that is possible."""
        pairs: list[list[tuple[int, int]]] = [[] for _ in burst]
        if len(answers) % len(burst) == 0:
            each = len(answers) // len(burst)
            in_order = [answers[at * each : (at + 1) * each] for at in range(len(burst))]
            return self._overtaken(burst, answers) or in_order
        due = 0
        for number, answer in enumerate(answers):
            left = len(answers) - number
            # Of fewer answers than frames, a frame whose code does not fit has got none. Of more,
            # an answer whose code does not fit is one more to the frame before.
            while left < len(burst) - due and answer[1] not in self._accepted(burst[due].step):
                due += 1
            right = due < len(burst) and answer[1] in self._accepted(burst[due].step)
            if due and left > len(burst) - due and not right:
                pairs[due - 1].append(answer)
            else:
                pairs[due].append(answer)
                due += 1
        return pairs

    def _unanswered(self, burst: Sequence[Exchange], last: Exchange) -> tuple[Exchange, ...]:
        """The frames of which one has got no answer: each but the last may have the one before's.

        So it is as long as that answer is right for the frame behind, too.
        """
        first = at = burst.index(last)
        while first and burst[first - 1].codes:
            [*_, (_, code)] = burst[first - 1].codes
            if code not in self._accepted(burst[first].step):
                break
            first -= 1
        return tuple(burst[first : at + 1])

    def _overtaken(
        self, burst: list[Exchange], answers: list[tuple[int, int]]
    ) -> list[list[tuple[int, int]]] | None:
        """The answers by their codes, if those that others have overtaken came too late."""
        left = list(answers)
        pairs = []
        for exchange in burst:
            accepted = self._accepted(exchange.step)
            own = next((answer for answer in left if answer[1] in accepted), None)
            if own is None or (own is not left[0] and not self._comes_late(exchange, own)):
                return None
            left.remove(own)
            pairs.append([own])
        return None if left else pairs

    def _comes_late(self, exchange: Exchange, answer: tuple[int, int]) -> bool:
        """Whether an answer came later than it may to this frame."""
        over = self._timeout if exchange.step.truncated else 0
        return answer[0] - exchange.end > self._longest + over

    def _accepted(self, step: Step) -> set[int | None]:
        """The codes that are right for a frame, None for no answer, with the device's choices."""
        choices = self._model.choices
        word = choices.word(step.point) if step.point else ""
        chosen = [a for a in step.accepted[1:] if a.word == word]
        return {next(iter(a.codes), None) for a in (chosen or step.accepted[:1])}

    def _answers_to(self, data: bytes) -> set[tuple[int | None, ...]]:
        """The answers that may come where these bytes are taken for frames.

        Those with a header that is never right take the data it announces, or none. The answer to a
        last one that is cut short may not have come yet.
        """
        protocol, ways = self._model.protocol, set()
        for skipped in ((), (FrameClass.UNUSED_ID, FrameClass.WRONG_LENGTH)):
            codes: list[int | None] = []
            left = data
            while left:
                size = 1 + protocol.lengths[left[0]]
                if step_of(protocol, left[:size].ljust(size, b"\0")).kind in skipped:
                    size = 1
                if len(left) < size:
                    ways.add(tuple(codes))
                codes.append(next(iter(self._accepted(step_of(protocol, left[:size])))))
                left = left[size:]
            ways.add(tuple(codes))
        return ways

    def _chosen(self, step: Step) -> bool:
        """Whether the right answer is known from this very device, as a choice of its own."""
        return bool(step.point) and self._model.choices.differs(step.point)

    def _judged_answer(self, exchange: Exchange) -> Deviation | None:
        accepted = self._accepted(exchange.step)
        exchange.accepted = frozenset(accepted)
        expected = next(iter(accepted))
        codes = [code for _, code in exchange.codes]
        if not codes:
            may_come = self._late >= _OFTEN and self._waited - exchange.end < 2 * self._longest
            how = "late" if may_come else "silent"
            return None if None in accepted else Deviation(ANSWER, how, expected)
        if codes[0] not in accepted:
            return Deviation(ANSWER, "other", expected, codes[0])
        if len(codes) > 1:
            return Deviation(ANSWER, "extra", expected, f"{len(codes)} answers")
        if self._comes_late(exchange, exchange.codes[0]):
            late = exchange.codes[0][0] - exchange.end
            return Deviation(ANSWER, "late", expected, late // MS)
        return None

    def _judge_looks(
        self,
        burst: list[Exchange],
        answers: list[tuple[int, int]],
        looks: list[tuple[int, Look]],
        guilty: Exchange | None,
    ) -> None:
        since = max(burst[-1].end, answers[-1][0] if answers else 0)
        last = looks[-1][1]
        facets = facets_of(self._model.protocol, last) - {*self._of_motion}
        facets |= {MOTION} if last.moving is not None else set()
        speed, wheels = self._car.drive(self._expected.state).speed, self._wheels(self._expected)
        different = {id(look): look for _, look in looks}  # the trace keeps equal ones once
        deviating = {key: self._deviating(look) for key, look in different.items()}
        found = [deviating[id(look)] for _, look in looks]
        burst[-1].watched, burst[-1].looked = looks[-1][0] - since, True
        for facet in sorted(facets - self._unknown_facets()):
            wrong = [facet in deviating for deviating in found]
            if facet == MOTION and not any(wrong) and not speed:
                continue  # no motion shows at speed 0
            candidates = (guilty,) if guilty else self._visible(facet, burst)
            value = value_of(facet, self._expected)
            earlier = burst[: burst.index(candidates[0])] if candidates[0] in burst else []
            deviation = None
            if all(wrong):
                deviation = Deviation(facet, "wrong", *found[-1][facet])
            elif wrong[-1]:
                deviation = Deviation(facet, "changed", *found[-1][facet])
            elif wrong[0] and facet == MOTION:
                first = next(t for (t, _), bad in zip(looks, wrong, strict=True) if not bad)
                if first - since > self._stop_longest:
                    deviation = Deviation(facet, "late", *found[0][facet])
            if deviation is None:
                changed = wrong[0] and facet != MOTION  # too late, or as late as it may
                # What was so before may be there because the frames behind were ignored.
                met = any(value_of(facet, exchange.before) == value for exchange in earlier)
                for exchange in () if guilty or changed else candidates:
                    exchange.settled.add(facet)
                    if met:
                        continue
                    exchange.right.add(facet)
                    if facet == MOTION and self._wheels(exchange.after) == wheels:
                        exchange.right.add(WHEELS)
                continue
            candidates = (*_hidden(facet, value, candidates[0]), *candidates)
            for exchange in candidates:
                exchange.deviations[facet] = deviation
            self.bags.append(Bag(deviation, candidates))
        self._resynchronise(last)

    def _wheels(self, expected: ExpectedState) -> tuple[int, int]:
        return self._car.wheels(expected.state, self._model.protocol.full_steering)

    def _visible(self, facet: str, burst: list[Exchange]) -> tuple[Exchange, ...]:
        """The frames of which a look shows what they made of a facet: no later one changes it."""
        pending = self._unseen.pop(facet, burst)
        wanted = value_of(facet, self._expected)
        return tuple(e for e in pending if value_of(facet, e.after) == wanted) or tuple(pending)

    def _unknown_facets(self) -> set[str]:
        unknown = set(self._expected.unknown)
        hides = unknown & {self._car.speed, self._car.by, "curve"}
        return unknown | ({MOTION} if hides else set())

    def _deviating(self, look: Look) -> dict[str, tuple[int | str, int | str]]:
        """The facets of a look that deviate, with what was expected and what was seen."""
        found: dict[str, tuple[int | str, int | str]] = {}
        for name, wanted, seen in differences(self._model, self._expected, look):
            if name not in self._of_motion:
                found[name] = wanted, seen  # type: ignore[assignment]
        # The wheels are held to the settings that the probe reports, right or wrong.
        own = {
            name: getattr(look, name)
            for name in (self._car.speed, self._car.steering)
            if name in found
        }
        reported = replace(self._expected, state=self._expected.state.but(**own))
        if any(name in self._of_motion for name, _, _ in differences(self._model, reported, look)):
            due, seen = visible_motion(reported.state), seen_motion(self._car, look)
            found[MOTION] = due, seen if seen != due else ASTRAY
        return found

    def _may_show_in(self, exchange: Exchange) -> None:
        """Keep a frame as one that the next look may show; what it sets hides earlier frames."""
        protocol, choices = self._model.protocol, self._model.choices
        effect = exchange.step.frame_effect.effect
        by_choice = {v for v, p in open_after(protocol, effect).items() if choices.differs(p.id)}
        exchange.assumed = self._assumed
        for name in protocol.variables:
            facet = MOTION if name == self._car.by else name
            if name in by_choice or (effect or protocol.on_fault).sets(name):
                self._unseen[facet] = []
                self._assumed |= {facet}
            self._unseen.setdefault(facet, []).append(exchange)

    def _resynchronise(self, look: Look) -> None:
        """Go on from what was seen, so that a deviation is not counted again later."""
        self._assumed = frozenset()
        state, car = self._expected.state, self._car
        values = {
            name: getattr(look, name)
            for name in self._model.protocol.settings
            if getattr(look, name) is not None
        }
        unknown, motion = self._expected.unknown - values.keys(), car.drive(look).motion
        if look.moving and motion:
            values[car.by], unknown = motion, unknown - {car.by}
        elif look.moving is False and (state.moving or car.by in unknown):
            values[car.by], unknown = car.still, unknown - {car.by}
        pending = self._expected.pending_speed
        if values.get(car.speed) == pending:
            pending = None
        self._expected = ExpectedState(state.but(**values), unknown, pending)


def _hidden(facet: str, value: int | str | None, exchange: Exchange) -> list[Exchange]:
    """The frames before an exchange since the last look, as long as they left this value.

    The exchange sets nothing new, so it hides none of them.
    """
    hidden: list[Exchange] = []
    before = exchange.previous
    while before and not before.looked and value_of(facet, exchange.before) == value:
        hidden.insert(0, before)
        exchange, before = before, before.previous
    return hidden


def repeats(exchange: Exchange) -> bool:
    """Whether a right exchange repeats the one before it, as stops that home a device do."""
    previous = exchange.previous
    if previous is None or exchange.deviations or previous.deviations:
        return False
    return (
        previous.step.frame == exchange.step.frame
        and previous.after == exchange.before == exchange.after
    )


def value_of(facet: str, expected: ExpectedState) -> int | str | None:
    """Return the value of a facet in a state, None where it is not known."""
    if facet == MOTION:
        car = expected.state.wheels
        unknown = expected.unknown & {car.by, car.speed}
        return None if unknown else visible_motion(expected.state)
    return None if facet in expected.unknown else getattr(expected.state, facet)


def seen_motion(car: Wheels, look: Look) -> str:
    """Return the motion that a look shows."""
    if not look.moving:
        return car.still
    return car.drive(look).motion or "moving"
