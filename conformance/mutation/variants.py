"""Legal variants: devices that follow another reading of the document than the reference.

A variant never fails. A mixture (`mixtures.py`), which shows two choices of one point, does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache

import msgspec

from bilprov.captures.schemas import MS, Look
from bilprov.conformance.dut.fault import Event, Fault, React
from bilprov.conformance.mutation import variant_behaviour as take
from bilprov.conformance.mutation.faults.answers import under_other_ids
from bilprov.conformance.mutation.faults.vocabulary import (
    Condition,
    is_outcome,
    late,
    pipelined,
    sets,
    watchdog,
    when,
)
from bilprov.conformance.mutation.variant_behaviour import Chooses, always, only
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import POINTS, Behaviour

FAMILY = "variant"
Make = Callable[[Chooses], Fault]


@dataclass(frozen=True, slots=True)
class Variant:
    """A legal variant: a choice other than the default at one reading.

    `name` is the reading's id, `=` and the choice. `allow` names the option (`--allow`) without
    which the choice fails, "" if it is legal without one. `mixes` is true for a choice that a
    device must make the same way each time, so that mixtures of it are faults; a measured time is
    no such choice. `make` builds the device from a function that says when it takes the choice.
    `words` are the pairs of open point and choice from which it is made, if it is made from such.
    """

    name: str
    doc: str
    make: Make
    allow: str = ""
    mixes: bool = False
    words: tuple[tuple[str, str], ...] = ()

    @property
    def reading(self) -> str:
        """The reading's id."""
        return self.name.split("=")[0]

    @property
    def fault(self) -> Fault:
        """The fault that makes a simulator take this choice each time."""
        return self.taking(always, self.name, self.doc)

    def taking(self, chooses: Chooses, name: str, doc: str) -> Fault:
        """Return the fault that takes this choice whenever `chooses` returns true."""
        return replace(self.make(chooses), name=name, doc=doc)


@cache
def variants(protocol: Protocol) -> dict[str, Variant]:
    """Return every legal variant by name: answers, times, delivery, remembered state."""
    placed = (*_answers(protocol), *_times(protocol), *_delivery(protocol), *_states(protocol))
    return {variant.name: variant for variant in (*placed, *_left(placed))}


MIXTURE = "mixture:"


def _device(react: React | None = None, **more: object) -> Fault:
    return Fault("", FAMILY, "", exit=0, react=react, **more)  # type: ignore[arg-type]


def _reacting(condition: Condition, change: React) -> Make:
    return lambda chooses: _device(only(condition, change, chooses))


def _fixed(react: React | None = None, **more: object) -> Make:
    return lambda chooses: _device(react, **more)


def _choosing(name: str, doc: str, words: Mapping[str, str]) -> Variant:
    """Return the variant that makes the choice of a word at each of these open points."""
    return Variant(
        name,
        doc,
        lambda chooses: _device(take.choosing(words, chooses)),
        mixes=True,
        words=tuple(words.items()),
    )


def _left(placed: Iterable[Variant]) -> Iterator[Variant]:
    """Yield a variant for each choice about an answer or the state that none of these makes."""
    made = {pair for variant in placed for pair in variant.words}
    for point in POINTS.values():
        for choice in point.choices[1:]:
            simple = choice.does not in (None, Behaviour.DISCARDED) and not choice.option
            if simple and (point.id, choice.word) not in made:
                reading, _, part = point.id.partition(" ")
                name = f"{reading}={part and part + '-'}{choice.word}"
                yield _choosing(name, f"{point.id}: {choice.word}", {point.id: choice.word})


def _answers(protocol: Protocol) -> Iterator[Variant]:
    """Yield the variants that answer another code, or nothing."""
    many, few = (protocol.answers[o].name for o in (Outcome.TOO_MANY, Outcome.TOO_FEW))
    for word, code in (("too-many", many), ("too-few", few)):
        yield _choosing(
            f"R-unused-length={word}",
            f"answers {code} to an unused ID with data announced",
            {"R-unused-length": word, "R-truncated-unused": word},
        )
    yield _choosing(
        "R-competing-errors=bad-data",
        "judges the data before the length where both are wrong",
        {"R-competing-errors": "data"},
    )
    yield Variant(
        "R-led-upper-bits=ignored",
        "takes the bits that mean something and ignores the others",
        _reacting(take.out_of_bits, take.low_bits),
        allow="led-upper=ignore",
    )
    lit = next((s for s in protocol.instructions if any(part.bits for part in s.fields)), None)
    if lit and protocol.unused_ids:
        example = protocol.unused_ids[0]
        yield Variant(
            f"R-led-id={example}",
            f"takes ID {example} for {lit.name}, as the example does, and not {lit.id}",
            _fixed(under_other_ids(lit, (example,), kept=False)),
            allow=f"led-id={example}",
        )
        yield Variant(
            "R-version=1.0",
            f"knows no {lit.name}: its ID is unused, as before v1.1",
            _fixed(under_other_ids(lit, (), kept=False)),
            allow="version=1.0",
        )
    truncated = ("R-truncated-known", "R-truncated-unused", "R-truncated-long")
    yield _choosing(
        "R-truncated-known=silent",
        "stops at a frame that is cut short and does not answer it",
        dict.fromkeys(truncated, "silent"),
    )
    for point, name in (
        ("R-truncated-known", "R-truncated-known=silent-and-others-answered"),
        ("R-truncated-unused", "R-truncated-unused=silent"),
        ("R-truncated-long", "R-truncated-long=silent"),
    ):
        doc = f"stops without an answer where {point} is about, and answers other frames cut short"
        yield _choosing(name, doc, {point: "silent"})
    yield _choosing(
        "R-truncated-unused=too-few",
        f"answers {few} to an unused ID that is cut short",
        {"R-truncated-unused": "too-few"},
    )
    yield _choosing(
        "R-truncated-long=too-many",
        f"answers {many} to a frame that is cut short and announced too many",
        {"R-truncated-long": "too-many"},
    )
    yield Variant(
        "R-answer-point=header",
        "answers a frame that is wrong at its header at once, and takes its data without a word",
        lambda chooses: _device(hear=take.at_the_header(chooses)),
        mixes=True,
    )


def _times(protocol: Protocol) -> Iterator[Variant]:
    """Yield the variants in time-outs and delays; these are measured times, so they do not mix."""
    for pause in (3, 6, 500, 1500):
        yield Variant(
            f"R-truncation-timeout={pause}-ms",
            f"ends a frame after a pause of {pause} ms",
            _fixed(timeout=pause * MS),
        )
    yield Variant(
        "R-truncation-timeout=whole-frame",
        "counts the time-out from the header on, over the whole frame",
        _fixed(whole_frame=True),
    )
    for delay in (60, 150):
        yield Variant(
            f"R-answer-deadline={delay}-ms", f"answers after {delay} ms", _fixed(late(delay))
        )
    yield Variant(
        "R-answer-deadline=150-ms-after-faults",
        "answers faults after 150 ms",
        _fixed(
            take.answers_at(
                lambda e, free: free if e.judgement.valid else max(free, e.now + 150 * MS)
            )
        ),
    )
    yield Variant(
        "R-answer-deadline=one-at-a-time",
        "takes 60 ms for each instruction, and begins the next when it has answered",
        _fixed(take.answers_at(lambda e, free: free + 60 * MS)),
    )
    yield Variant(
        "R-stop-point=header",
        "stops at the header of a faulty frame and answers after its data",
        _fixed(begins=take.stops_at_the_header),
    )
    yield Variant(
        "R-stop-point=header-of-unused-ids",
        "stops at the header of an unused ID, and after the data of a wrong length",
        _fixed(begins=take.stops_at_an_unused_header),
    )
    yield Variant(
        "R-stop-latency=50-ms",
        "stops 50 ms after the answer to a fault",
        _fixed(take.stops_late(50)),
    )
    yield Variant(
        "R-watchdog=stops",
        "stops by itself when no frame has come for 1 s",
        _fixed(watchdog(1000)),
    )


def _delivery(protocol: Protocol) -> Iterator[Variant]:
    """Yield the variants in what happens to bytes around a fault and before the first frame."""

    def known(event: Event) -> bool:
        return event.judgement.instruction is not None

    def unused(event: Event) -> bool:
        return event.judgement.instruction is None

    def wrong_length(event: Event) -> bool:
        return event.judgement.outcome in (Outcome.TOO_MANY, Outcome.TOO_FEW)

    pause = _pause(protocol)
    for name, what, condition in (
        ("R-drain-known=flushed", "a faulty known frame", known),
        ("R-drain-unused=flushed", "an unused ID", unused),
        ("R-drain-known=flushed-after-any", "any faulty frame", lambda event: True),
        ("R-drain-known=flushed-after-wrong-lengths", "a wrong length", wrong_length),
        ("R-pipelining=flushed-after-bad-data", "bad data", is_outcome(Outcome.BAD_DATA)),
    ):

        def make(chooses: Chooses, condition: Condition = condition) -> Fault:
            react, hear = take.flushing(pause, condition, chooses)
            return _device(react, hear=hear)

        yield Variant(
            name, f"throws away what follows {what} until the line is idle", make, mixes=True
        )
    yield Variant(
        "R-drain-unused=run",
        "answers an unused ID at its header, whatever data it announces, and runs what follows",
        _fixed(
            lengths=bytes(n if i in protocol.by_id else 0 for i, n in protocol.headers),
        ),
        allow="unused-length=header-only",
    )
    yield Variant(
        "R-pipelining=lost-after-a-fault",
        "loses what was sent ahead behind a fault",
        _fixed(take.lost_behind_a_fault),
    )
    yield Variant(
        "R-pipelining=no",
        "loses whatever is sent before the answer before has gone",
        _fixed(when(pipelined, lambda d, e, r: replace(r, answers=(), state=e.before))),
        allow="pipelining=no",
    )
    yield Variant(
        "R-unsolicited=banner",
        "introduces itself at power-on, before the first instruction",
        _fixed(banner=b"ROBOT\r\n"),
    )


def _states(protocol: Protocol) -> Iterator[Variant]:
    """Yield the variants in which state variables an instruction or a fault changes or keeps."""
    fault_speed = {"R-fault-state speed": "zeroed"}
    fault_steering = {"R-fault-state steering": "kept"}
    stop_speed, stop_steering = {"R-stop-speed": "zeroed"}, {"R-stop-steering": "kept"}
    both = fault_speed | fault_steering
    straight, reset = {"R-drive-steering": "straight"}, {"R-rotate-steering": "reset"}
    rows = (
        ("R-fault-state=speed-zeroed", "a fault zeroes the speed", fault_speed),
        ("R-fault-state=steering-kept", "a fault keeps the steering", fault_steering),
        ("R-fault-state=both", "a fault zeroes the speed and keeps the steering", both),
        ("R-stop-steering=kept", "a stop keeps the steering", stop_steering),
        (
            "R-stop-steering=kept-by-faults-too",
            "a stop keeps the steering, and so does a fault",
            stop_steering | fault_steering,
        ),
        ("R-stop-speed=zeroed", "a stop zeroes the speed", stop_speed),
        (
            "R-stop-speed=zeroed-by-faults-too",
            "a stop zeroes the speed, and so does a fault",
            stop_speed | fault_speed,
        ),
        (
            "R-drive-steering=straight",
            "an instruction that drives sets the steering straight, a rotation keeps it",
            straight,
        ),
        ("R-rotate-steering=reset", "a rotation resets the steering, as a stop does", reset),
        (
            "R-rotate-steering=reset-and-drives-straight",
            "every instruction that moves it sets the steering straight",
            straight | reset,
        ),
    )
    yield from (_choosing(*row) for row in rows)
    yield Variant(
        "R-resolution=plateau",
        "the wheels turn no faster above half speed",
        _fixed(show=_no_faster(protocol.limits.get("speed", (0, 0))[1] // 2)),
    )
    yield Variant(
        "R-steer-rotating=curve",
        "steering makes a rotation a curve",
        _reacting(take.steers_while_rotating, sets(motion=Motion.FORWARD)),
        mixes=True,
    )
    yield _choosing(
        "R-led-state=off",
        "a stop and a fault switch the light off",
        {"R-led-state stop": "off", "R-led-state fault": "off"},
    )
    for part, what in (("stop", "a stop"), ("fault", "a fault")):
        name = f"R-led-state=off-after-{part}s"
        yield _choosing(
            name, f"{what} alone switches the light off", {f"R-led-state {part}": "off"}
        )
    yield Variant(
        "R-speed-moving=next-motion",
        "a speed that comes while it moves takes effect at the next motion instruction",
        lambda chooses: _device(take.speed_at_next_motion(chooses)),
        mixes=True,
    )
    low, high = protocol.limits.get("speed", (0, 0))
    yield Variant(
        "R-power-on=another-speed",
        "is found with a speed, a light and a steering that nobody has set",
        _fixed(
            power_on=replace(
                protocol.power_on,
                speed=(low + high) // 3,
                led=protocol.limits.get("led", (0, 0))[1],
                steering=protocol.limits.get("steering", (0, 0))[1] // 12,
            )
        ),
    )


def _no_faster(most: int) -> Callable[[Look], Look]:
    """Return what a probe sees of wheels that turn as at speed `most` at every higher speed."""

    def show(look: Look) -> Look:
        if look.speed is None or look.left is None or look.right is None or look.speed <= most:
            return look
        left, right = (round(wheel * most / look.speed) for wheel in (look.left, look.right))
        return msgspec.structs.replace(look, left=left, right=right)

    return show


def _pause(protocol: Protocol) -> int:
    """Return the truncation time-out in ms, after which the line counts as idle."""
    return int(protocol.timing.truncation_timeout)
