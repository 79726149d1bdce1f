"""Draws random faults: triggers and effects of the vocabulary, crossed. A seed gives the same one.

`random:SEED` is a frame, up to two conditions (state, data, history, timing) and an effect.
`random:SEED.NUMBER` draws from wider families: also a value in the data of frames that are already
faulty (needle), frames right after others or in a state (context), every n-th frame of a class
(rhythm), settings in which the robot does not obey, and wheels that turn at another speed. No
reading of the document allows any of the effects.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

from bilprov.conformance.dut.fault import Fault
from bilprov.conformance.mutation.draw import Draw
from bilprov.conformance.mutation.faults import Row, hooks
from bilprov.conformance.mutation.triggers import OUTCOMES, TRUNCATED
from bilprov.spec.by_effect import moves, moving_motions, variable_of
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import InstructionSpec, Protocol

PREFIX = "random:"
_BYTES = (0, 1, 127, 128, 255, *(1 << bit for bit in range(1, 7)))  # boundaries and single bits
_PERIODS = (64, 100, 256, 1000)  # besides any from 20 to 300
_LEAST = 32  # a difference of wheels at a smaller speed or strength is none that a suite must see
_FAULTY = [word for word in OUTCOMES if word != "valid"]


class Frames(NamedTuple):
    """The frames of a fault: their terms, the instruction of valid ones, the fault of others.

    `outcome` is "" for any fault. `narrow` is true where any value of 256 besides would make them
    too few to be met: where both ID and length are given, or each takes a time-out. `one_byte` is
    true of those with a single data byte.
    """

    when: str
    spec: InstructionSpec | None = None
    outcome: str = ""
    narrow: bool = False
    one_byte: bool = False


class Drawn(NamedTuple):
    """A fault that is drawn: its family, terms and effect."""

    family: str
    when: Sequence[str]
    what: str


class FaultDraw:
    """Draws faults of one protocol from one seed."""

    def __init__(self, protocol: Protocol, seed: int | str) -> None:
        self._protocol = protocol
        self._draw = Draw(seed)
        self._tops = {name: high for name, (_, high) in protocol.limits.items() if high > 0}

    def wide(self) -> Drawn:
        """Draw a fault of any family."""
        families = (
            *8 * (self.simple,),
            *4 * (self.needle,),
            *3 * (self.in_context,),
            *3 * (self.rhythm,),
            self.disobedience,
            self.wheels_astray,
        )
        return self._draw.pick(families)()

    def simple(self) -> Drawn:
        """Draw a frame, up to two conditions, and an effect."""
        frames = self._frames()
        carries = frames.spec.fields if frames.spec else frames.outcome != TRUNCATED
        kinds = [self._state, self._state, self._history, self._timing]
        kinds += [self._data] * 3 if carries else []
        terms = [frames.when]
        for _ in range(self._draw.pick((0, 1, 1, 1, 1, 2))):
            kind = self._draw.pick(kinds)
            kinds = [other for other in kinds if other != kind]
            terms.append(kind(frames))
        return Drawn("random", terms, self._effect(frames))

    def needle(self) -> Drawn:
        """Draw a value in the data of faulty frames, sometimes in one state only."""
        frames = self._faulty_frames()
        terms = [frames.when, self._byte(frames, any_value=not frames.narrow)]
        if not frames.narrow and self._draw.below(3) == 0:
            terms.append(self._state(frames))
        return Drawn("random needle", terms, self._effect(frames, in_silence=False))

    def in_context(self) -> Drawn:
        """Draw a frame, a value in it, and the frame before or the state."""
        draw = self._draw
        carriers = [spec for spec in self._protocol.instructions if spec.fields]
        in_state = draw.below(5) == 0  # where any value is met often enough; elsewhere one of a few
        if carriers and draw.below(2):
            spec = draw.pick(carriers)
            low, high = spec.fields[0].low, spec.fields[0].high
            some = [value for value in _BYTES if low <= value <= high]
            value = draw.between(low, high) if in_state or not some else draw.pick(some)
            frames = Frames(f"instruction {spec.name}", spec)
            terms = [frames.when, f"value {value}"]
        else:
            frames = self._faulty_frames()
            terms = [frames.when]
            if not frames.narrow:
                terms.append(self._byte(frames, any_value=in_state))
        terms.append(self._state(frames) if in_state else self._right_after())
        return Drawn("random context", terms, self._effect(frames, in_silence=False))

    def rhythm(self) -> Drawn:
        """Draw every n-th frame, fault, or frame of a class, sometimes in one state."""
        draw = self._draw
        name, outcome = draw.pick(self._protocol.instructions), draw.pick(_FAULTY)
        every = Frames("")
        kinds = (
            *(every, every, Frames("faulty")),
            *(
                Frames(f"instruction {name.name}", name),
                Frames(f"outcome {outcome}", None, outcome),
            ),
        )
        frames = draw.pick(kinds)
        times = f"times every {draw.pick((*_PERIODS, draw.between(20, 300)))}"
        states = [self._state(frames)] if draw.below(3) == 0 else []
        terms = [times, *states] if draw.below(2) else [*states, times]  # counted in any state, or
        effects = ["twice", "silent", self._unused_code(), "twice 12"]
        effects.append(f"answers-with {draw.pick(self._protocol.responses).code}")
        if frames.spec or frames.outcome:
            effects.append(self._effect(frames, in_silence=False))
        return Drawn("random rhythm", [frames.when, *terms], draw.pick(effects))

    def disobedience(self) -> Drawn:
        """Draw settings in which instructions are answered and not carried out."""
        draw, tops = self._draw, self._tops
        settings = []
        if "speed" in tops:
            settings.append(f"speed >= {draw.between(2, tops['speed'])}")
        if "led" in tops:
            settings += 2 * [f"led & {self._bit('led')}"]
        if "steering" in tops:
            settings.append(draw.pick(("steering > 0", "steering < 0")))
        if not settings:
            return self.simple()
        specs = self._protocol.instructions
        some = ([s.name for s in specs if moves(s)], [s.name for s in specs if not moves(s)])
        frames = ["valid", *(f"instruction {' '.join(names)}" for names in some if names)]
        return Drawn("random settings", [draw.pick(frames), draw.pick(settings)], "drives-on")

    def wheels_astray(self) -> Drawn:
        """Draw wheels that turn slower, or backwards, from a speed or a strength on."""
        names = [n for n in ("speed", "steering") if self._tops.get(n, 0) >= _LEAST]
        if not names:
            return self.simple()
        name = self._draw.pick(names)
        least = self._draw.between(_LEAST, self._tops[name])
        how = self._draw.pick(("half", "reversed"))
        return Drawn("random wheels", [], f"wheels-astray {how} {name} {least}")

    # -- frames ----------------------------------------------------------------------------------

    def _frames(self) -> Frames:
        """Draw valid frames of an instruction, a kind of fault, cut frames, or any fault."""
        draw, kind = self._draw, self._draw.below(10)
        if kind < 5:
            spec = draw.pick(self._protocol.instructions)
            return Frames(f"instruction {spec.name}", spec)
        if kind < 7:
            outcome = draw.pick(_FAULTY)
            return Frames(f"outcome {outcome}", None, outcome)
        if kind == 7:
            return Frames(TRUNCATED, None, TRUNCATED)
        if kind == 8 and self._protocol.unused_ids:
            return Frames(f"id {draw.pick(self._protocol.unused_ids)}", None, "unknown-id")
        return Frames("faulty")

    def _faulty_frames(self) -> Frames:
        """Draw faulty frames with data: a wrong length, an unused ID, or a cut frame."""
        kinds = [self._wrong_length]
        kinds += [self._unused] if self._protocol.unused_ids else []
        kinds += [self._cut] if self._protocol.data_lengths[-1] > 1 else []
        return self._draw.pick(kinds)()

    def _wrong_length(self) -> Frames:
        draw, protocol = self._draw, self._protocol
        wrong = {
            spec: [n for n in protocol.data_lengths if n not in (0, spec.length)]
            for spec in protocol.instructions
        }
        spec = draw.pick([spec for spec, lengths in wrong.items() if lengths])
        length = draw.pick(wrong[spec])
        outcome = "too-many" if length > spec.length else "too-few"
        alike = [s.id for s in protocol.instructions if s.length == spec.length]
        any_length, two_ids = draw.pick(((True, False), (False, True), (False, False)))
        ids = sorted({spec.id, draw.pick(alike)} if two_ids else {spec.id})
        when = f"outcome {outcome}, id {' '.join(map(str, ids))}"
        if any_length:
            return Frames(when, None, outcome)
        return Frames(f"{when}, length {length}", None, outcome, True, length == 1)

    def _unused(self) -> Frames:
        draw, protocol = self._draw, self._protocol
        identity, length = draw.pick(protocol.unused_ids), draw.pick(protocol.data_lengths[1:])
        terms, narrow = draw.pick(
            (
                (f"id {identity}, length > 0", False),
                (f"length {length}", False),
                (f"id {identity}, length {length}", True),
            )
        )
        when = f"outcome unknown-id, {terms}"
        return Frames(when, None, "unknown-id", narrow, length == 1)

    def _cut(self) -> Frames:
        longest = self._protocol.data_lengths[-1]
        arrived = self._draw.between(1, min(3, longest - 1))
        kinds = ["", ", known", *([", known 0"] if self._protocol.unused_ids else [])]
        when = f"truncated, size {arrived + 1}{self._draw.pick(kinds)}"
        return Frames(when, None, TRUNCATED, True, arrived == 1)

    # -- conditions ------------------------------------------------------------------------------

    def _bit(self, variable: str) -> int:
        return 1 << self._draw.below(self._tops[variable].bit_length())

    def _state(self, frames: Frames) -> str:
        """Draw a state before the frame that there can be: a motion, a speed, a side, a light."""
        draw, tops = self._draw, self._tops
        motions = moving_motions(self._protocol)
        found = 3 * [f"moves {draw.pick(motions)}"] if motions else []
        fast = [f"speed >= {draw.between(1, tops['speed'])}"] if "speed" in tops else []
        starts = frames.spec is not None and frames.spec.effect.motion is not Motion.STOPPED
        found += [*(["moves stopped"] if starts else fast), *fast]
        low, high = self._protocol.limits.get("steering", (0, 0))
        sides = ["steering > 0"] * (high > 0) + ["steering < 0"] * (low < 0)
        found += [draw.pick(sides)] if sides else []
        found += [f"led & {self._bit('led')}"] if "led" in tops else []
        return draw.pick(found or ["moves stopped"])

    def _data(self, frames: Frames) -> str:
        """Draw data of the frame: a value, a threshold, a bit; or what its header announces."""
        draw = self._draw
        if frames.outcome == "bad-data":
            return f"value & {1 << draw.below(8)}"
        if frames.spec is None:
            length = draw.pick(self._protocol.data_lengths)
            return draw.pick(("length & 1", "length !& 1", *2 * (f"length {length}",)))
        part = frames.spec.fields[0]
        bit = 1 << draw.below(max(1, part.high.bit_length()))
        return draw.pick(
            (
                f"value {draw.between(part.low, part.high)}",
                f"value >= {draw.between(min(part.low + 1, part.high), part.high)}",
                f"value & {bit}",
                f"value !& {bit}",
            )
        )

    def _byte(self, frames: Frames, *, any_value: bool) -> str:
        """Draw a value, a threshold or a bit of a data byte; a few values unless `any_value`."""
        draw = self._draw
        value = draw.below(256) if any_value else draw.pick(_BYTES)
        tests = (f">= {draw.between(1, 255)}", f"& {1 << draw.below(8)}", *2 * (str(value),))
        places = ["first-byte", "last-byte", *(["second-byte"] if not frames.one_byte else [])]
        return f"{draw.pick(places)} {draw.pick(tests)}"

    def _history(self, frames: Frames) -> str:
        """Draw what came before: a frame, a fault, a count."""
        draw = self._draw
        name = draw.pick(self._protocol.instructions).name
        return draw.pick(
            (
                *3 * (f"previous {name}",),
                "row > 0",
                f"frames every {draw.between(2, 40)}",
                f"frames >= {draw.between(5, 250)}",
                f"faults >= {draw.between(2, 60)}",
            )
        )

    def _timing(self, frames: Frames) -> str:
        """Draw a delivery: sent ahead, after a pause, split."""
        carries = frames.spec.length if frames.spec else frames.outcome != TRUNCATED
        split = ["pause > 1"] if carries else []
        return self._draw.pick(("pipelined", f"gap >= {self._draw.pick((15, 30, 60))}", *split))

    def _right_after(self) -> str:
        name = self._draw.pick(self._protocol.instructions).name
        fault = f"previous {self._draw.pick(_FAULTY)}"
        return self._draw.pick((fault, fault, f"previous {name}", "after-truncated"))

    # -- effects ---------------------------------------------------------------------------------

    def _unused_code(self) -> str:
        codes = [code for code in range(256) if code not in self._protocol.codes]
        return f"answers-with {self._draw.pick(codes)}"

    def _effect(self, frames: Frames, *, in_silence: bool = True) -> str:
        """Draw an effect on such frames; one that is listed several times is drawn more often.

        Without `in_silence` those are left out that show only where nothing is sent after the
        frame: a trigger that many frames must meet would take a silence after each.
        """
        found = self._on_answer(frames, in_silence=in_silence)
        motions, spec = moving_motions(self._protocol), frames.spec
        if spec is None:
            found += [*3 * ["drives-on"], f"stops-after {3 * self._protocol.timing.stop_longest}"]
            found += [f"resumes-after {pause}" for pause in (12, 60, 120)] * in_silence
            found += self._astray("led", "speed")
        elif spec.effect.motion is Motion.STOPPED:
            found += 2 * ["drives-on", *["resumes-after 15"] * in_silence] + self._astray("led")
        elif spec.effect.motion is not None:
            others = [f"sets motion {m}" for m in motions if m is not spec.effect.motion]
            found += [self._draw.pick(others)] if others else []
            found += [*3 * ["drives-on"], *self._astray("speed", "led")]
        elif spec.effect.assignments:
            own = variable_of(spec)
            others = [name for name in ("speed", "led", "steering") if name != own]
            found += [*3 * ["drives-on"], "stands-still"]
            found += 2 * self._astray(own) + self._astray(*others)
        return self._draw.pick(found)

    def _on_answer(self, frames: Frames, *, in_silence: bool) -> list[str]:
        late = f"late {1.2 * self._protocol.timing.answer_longest}"
        again = "answers-again 12" if in_silence else "twice 12"
        found = [self._unused_code(), "twice", again, late, "loses-next-byte"]
        if frames.spec:
            found.append(f"answers-as {self._draw.pick(_FAULTY)}")
        else:
            found.append("answers-as valid")
            if frames.outcome:
                other = frames.outcome in (TRUNCATED, "unknown-id")
                found.append(f"answers-as {'bad-data' if other else 'unknown-id'}")
        if frames.spec or frames.outcome not in ("", TRUNCATED):  # silence there is legal
            found.append("silent")
        return found

    def _astray(self, *variables: str) -> list[str]:
        """Return effects that turn one bit of a variable; readings only keep or zero it."""
        return [f"turns-bits {n} {self._bit(n)}" for n in variables if n in self._tops]


@cache
def random_fault(protocol: Protocol, seed: int) -> Fault:
    """Return the fault `random:SEED`."""
    return _fault(protocol, f"{PREFIX}{seed}", FaultDraw(protocol, seed).simple())


@cache
def drawn_fault(protocol: Protocol, seed: int, number: int) -> Fault:
    """Return the fault `random:SEED.NUMBER`, drawn from the wider families."""
    drawn = FaultDraw(protocol, f"{seed}.{number}").wide()
    return _fault(protocol, f"{PREFIX}{seed}.{number}", drawn)


def _fault(protocol: Protocol, name: str, drawn: Drawn) -> Fault:
    when = ", ".join(term for term in drawn.when if term)
    doc = f"{when or 'always'}: {drawn.what}"
    clauses = ("safety", "responses", "instructions", "header")
    row = Row(doc, drawn.what, when)
    return Fault(name, drawn.family, doc, ("*",), clauses=clauses, **hooks(protocol, row))


def find_random_fault(protocol: Protocol, name: str) -> Fault:
    """Return the random fault of that name. Raises ValueError, in one sentence, for any other."""
    parts = name.removeprefix(PREFIX).split(".")
    numbers = [int(part) for part in parts if part.isascii() and part.isdigit()]
    if len(numbers) == len(parts) == 1:
        return random_fault(protocol, numbers[0])
    if len(numbers) == len(parts) == 2:
        return drawn_fault(protocol, *numbers)
    raise ValueError(
        f"there is no fault {name!r}; a random one is {PREFIX}SEED or {PREFIX}SEED.NUMBER, each a "
        f"whole number, for example {PREFIX}7 or {PREFIX}7.1"
    )
