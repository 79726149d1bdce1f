"""Effects: what a device does at the frames of its trigger, each a word with its arguments.

`EFFECTS` has the function of each word: from the reaction of a conforming device, and the
arguments, it makes another. Effects on more than the reaction are in `hooks.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from operator import floordiv, xor
from typing import Any, NamedTuple, TypeVar

from bilprov.captures.schemas import MS
from bilprov.conformance.dut.simulator import Event, React, Reaction, Simulator, answers
from bilprov.conformance.mutation.triggers import OUTCOMES, Trigger, trigger
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Wheels
from bilprov.spec.readings import POINTS, Behaviour


class At(NamedTuple):
    """A frame that came to a device, and its reaction so far."""

    device: Simulator
    event: Event
    reaction: Reaction

    def then(self, word: str, *arguments: Any) -> Reaction:
        """Return the reaction with another effect."""
        return EFFECTS[word](self, *arguments)

    def state(self, **variables: Any) -> Reaction:
        """Return the reaction with these values of variables, named as in `Protocol.by_role`."""
        names = self.device.protocol.by_role
        values = {names[name]: value for name, value in variables.items()}
        return replace(self.reaction, state=self.reaction.state.but(**values))

    def value(self, variable: str, *, before: bool = False) -> Any:
        """Return the value of a variable after the reaction, or before the frame."""
        state = self.event.before if before else self.reaction.state
        return getattr(state, self.device.protocol.by_role[variable])

    @property
    def car(self) -> Wheels:
        """What the car declares."""
        return self.device.protocol.car

    def code(self, outcome: Outcome) -> int:
        """Return the code of an outcome."""
        return self.device.protocol.answers[outcome].code


Word = TypeVar("Word", bound=Callable[..., Any])

EFFECTS: dict[str, Callable[..., Reaction]] = {}
WATCHING: dict[str, Callable[..., Reaction]] = {}
"""Effects that see every frame: their first argument is the trigger."""


def entered(words: dict[str, Any]) -> Callable[[Word], Word]:
    """Return a decorator that enters a function under its name, with hyphens."""

    def enter(function: Word) -> Word:
        words[function.__name__.replace("_", "-")] = function
        return function

    return enter


effect, watching = entered(EFFECTS), entered(WATCHING)


def _ns(milliseconds: float) -> int:
    return int(milliseconds * MS)


# -- on the answers ------------------------------------------------------------------------------


@effect
def answers_with(at: At, *codes: int) -> Reaction:
    """These codes are answered instead."""
    return answers(at.reaction, *codes)


@effect
def answers_as(at: At, outcome: str) -> Reaction:
    """The code of that outcome is answered."""
    return answers(at.reaction, at.code(OUTCOMES[outcome]))


@effect
def silent(at: At) -> Reaction:
    """Nothing is answered."""
    return answers(at.reaction)


@effect
def answers_as_before(at: At) -> Reaction:
    """The code due to the frame before is answered, if there was one."""
    before = at.event.previous
    return answers(at.reaction, before.response.code) if before else at.reaction


@effect
def answers_as_first(at: At) -> Reaction:
    """The code is answered that the first frame with this effect got."""
    code = at.device.memory.setdefault("code", at.event.judgement.response.code)
    return answers(at.reaction, code)


@effect
def adds_to_code(at: At, number: int) -> Reaction:
    """So much is added to each code."""
    return answers(at.reaction, *(code + number & 0xFF for _, code in at.reaction.answers))


@effect
def codes_reversed(at: At) -> Reaction:
    """The codes of faults are answered in the wrong order."""
    codes = sorted(at.device.protocol.codes)
    turned = dict(zip(codes[1:], codes[:0:-1], strict=True))
    return answers(at.reaction, *(turned[code] for _, code in at.reaction.answers))


@effect
def answers_again(at: At, milliseconds: float) -> Reaction:
    """The code comes again that much later, unless another frame comes first."""
    return at.then("answers-later", milliseconds, at.event.judgement.response.code)


@effect
def answers_later(at: At, milliseconds: float, *codes: int) -> Reaction:
    """These codes come that much later, unless another frame comes first."""
    return replace(at.reaction, unasked=tuple((_ns(milliseconds), code) for code in codes))


@effect
def also_answers(at: At, milliseconds: float, *codes: int) -> Reaction:
    """These codes follow that much later, whatever comes between."""
    more = ((_ns(milliseconds), code) for code in codes)
    return replace(at.reaction, answers=(*at.reaction.answers, *more))


@effect
def twice(at: At, milliseconds: float = 0) -> Reaction:
    """The answers come, and once more that much later."""
    more = ((delay + _ns(milliseconds), code) for delay, code in at.reaction.answers)
    return replace(at.reaction, answers=(*at.reaction.answers, *more))


@effect
def late(at: At, milliseconds: float) -> Reaction:
    """The answers come that much later."""
    codes = (code for _, code in at.reaction.answers)
    return answers(at.reaction, *codes, delay=_ns(milliseconds))


@effect
def late_one_at_a_time(at: At, milliseconds: float) -> Reaction:
    """Each frame takes that long, and the next begins with its answer."""
    return _answered_at(at, _free(at) + _ns(milliseconds))


@effect
def late_in_order(at: At, milliseconds: float) -> Reaction:
    """Faults are answered that much later, and no answer overtakes another."""
    wait = 0 if at.event.judgement.valid else _ns(milliseconds)
    return _answered_at(at, max(_free(at), at.event.now + wait))


def _free(at: At) -> int:
    """Return when the device is free: when its last answer has gone, or now."""
    return max(at.event.now, at.device.memory.get("answered at", 0))


def _answered_at(at: At, time: int) -> Reaction:
    """Return the reaction with its answers at that time (ns); without any it takes no time."""
    if not at.reaction.answers:
        return at.reaction
    at.device.memory["answered at"] = time
    return answers(at.reaction, *(c for _, c in at.reaction.answers), delay=time - at.event.now)


# -- on the state --------------------------------------------------------------------------------


@effect
def drives_on(at: At) -> Reaction:
    """The state stays as it was before the frame."""
    return replace(at.reaction, state=at.event.before)


@effect
def starts_driving(at: At) -> Reaction:
    """A stopped robot drives forward."""
    stopped = at.value("motion", before=True) not in at.car.turns
    return at.state(motion=_forward(at.car)) if stopped else at.reaction


def _forward(car: Wheels) -> str:
    """The kind of motion in which both wheels turn forward, else the first."""
    return next((word for word, both in car.turns.items() if both == (1, 1)), next(iter(car.turns)))


@effect
def only_forward(at: At) -> Reaction:
    """A robot that moves drives forward."""
    return at.state(motion=_forward(at.car)) if at.reaction.state.moving else at.reaction


@effect
def stands_still(at: At) -> Reaction:
    """The robot stops."""
    return at.state(motion=at.car.still)


@effect
def does(at: At, *names: str) -> Reaction:
    """What the other of these two instructions does is done instead."""
    other = next(name for name in names if name != at.event.judgement.name)
    done = at.device.protocol.by_name[other].effect.apply(at.event.before)
    return replace(at.reaction, state=done)


@effect
def shows_low_bits(at: At, mask: int) -> Reaction:
    """The LED shows those bits of the first field that the mask has."""
    return at.state(led=at.event.judgement.fields[0][1] & mask)


@effect
def sets(at: At, variable: str, value: Any) -> Reaction:
    """The variable has this value afterwards."""
    return at.state(**{variable: value})


@effect
def keeps(at: At, variable: str) -> Reaction:
    """The variable stays as it was before the frame."""
    return at.state(**{variable: at.value(variable, before=True)})


@effect
def adds_up(at: At, variable: str, most: int) -> Reaction:
    """The value is added to the one before, up to a limit on both sides."""
    value = at.value(variable) + at.value(variable, before=True)
    return at.state(**{variable: min(max(value, -most), most)})


@effect
def mirrors(at: At, variable: str) -> Reaction:
    """The variable gets the other sign."""
    return at.state(**{variable: -at.value(variable)})


@effect
def signed(at: At, variable: str) -> Reaction:
    """Sizes above 127 count as negative; a speed stays positive."""
    value = at.value(variable)
    if abs(value) > 127:
        value = (256 - abs(value)) * (-1 if value > 0 else 1)
    return at.state(**{variable: abs(value) if variable == "speed" else value})


def _resizes(size: Callable[[int, int], int]) -> Callable[[At, str, int], Reaction]:
    """Return the function of a word that changes a variable's size; its sign stays."""

    def resized(at: At, variable: str, number: int) -> Reaction:
        value = at.value(variable)
        return at.state(**{variable: size(abs(value), number) * (-1 if value < 0 else 1)})

    return resized


EFFECTS |= {
    "sets-bit": _resizes(lambda size, bit: size | 1 << bit),
    "clears-bit": _resizes(lambda size, bit: size & ~(1 << bit)),
    "turns-bits": _resizes(xor),
    "divides": _resizes(floordiv),
    "lowers": _resizes(lambda size, step: max(0, size - step)),
    "reverses-bits": _resizes(lambda size, width: int(f"{size:0{width}b}"[::-1], 2)),
}


# -- on the state, in time -----------------------------------------------------------------------


@effect
def stops_after(at: At, milliseconds: float) -> Reaction:
    """The state changes that much later, if no frame comes before."""
    later = ((_ns(milliseconds), at.reaction.state),)
    return replace(at.reaction, state=at.event.before, later=later)


@effect
def stops_after_the_answer(at: At, milliseconds: float) -> Reaction:
    """The state changes that much after the answer."""
    answered = max((delay for delay, _ in at.reaction.answers), default=0)
    return at.then("stops-after", answered / MS + milliseconds)


@effect
def resumes_after(at: At, milliseconds: float) -> Reaction:
    """The state from before the frame returns that much later."""
    return replace(at.reaction, later=((_ns(milliseconds), at.event.before),))


@effect
def jerks(at: At, begin: float, end: float) -> Reaction:
    """The state from before the frame returns between these times (ms)."""
    later = ((_ns(begin), at.event.before), (_ns(end), at.reaction.state))
    return replace(at.reaction, later=later)


@effect
def watchdog(at: At, milliseconds: float, *resumes: float) -> Reaction:
    """Without another frame the robot stops that much later; after `resumes` ms it drives on."""
    if not at.reaction.state.moving:
        return at.reaction
    stopped = at.then("stands-still").state
    goes_on = ((_ns(time), at.reaction.state) for time in resumes)
    return replace(at.reaction, later=((_ns(milliseconds), stopped), *goes_on))


# -- on both, and effects that remember ----------------------------------------------------------


@effect
def accepts(at: At) -> Reaction:
    """The frame is answered as valid and changes nothing."""
    return at._replace(reaction=drives_on(at)).then("answers-as", "valid")


@effect
def loses(at: At) -> Reaction:
    """The frame is not answered and changes nothing."""
    return answers(drives_on(at))


def _as_if(at: At, frame: bytes) -> Reaction:
    """Return the reaction of a conforming device to another frame."""
    judgement, state = at.device.step(frame, at.event.before)
    return replace(answers(at.reaction, judgement.response.code), state=state)


def _under_id(at: At, identity: int) -> Reaction:
    """Return the reaction to the same frame with another ID."""
    header = at.device.protocol.header_bytes[identity, at.event.judgement.length]
    return _as_if(at, bytes([header]) + at.event.judgement.frame[1:])


@effect
def takes_for(at: At, name: str, *ids: int) -> Reaction:
    """These IDs stand for the instruction."""
    taken = at.event.judgement.id in ids
    return _under_id(at, at.device.protocol.by_name[name].id) if taken else at.reaction


@effect
def knows_no(at: At, name: str) -> Reaction:
    """The instruction's ID is an unused one."""
    protocol = at.device.protocol
    own = at.event.judgement.id == protocol.by_name[name].id
    return _under_id(at, protocol.unused_ids[-1]) if own else at.reaction


@effect
def has_forgotten(at: At, variable: str) -> Reaction:
    """The frame is carried out as if the variable had been 0 before it."""
    before = at._replace(reaction=drives_on(at)).then("sets", variable, 0).state
    return replace(at.reaction, state=at.device.step(at.event.judgement.frame, before)[1])


@effect
def swapped_header(at: At) -> Reaction:
    """ID and length change places; what fits no instruction is an unknown ID."""
    protocol, judgement = at.device.protocol, at.event.judgement
    spec = protocol.by_id.get(judgement.length)
    if spec is None or judgement.id != spec.length:
        stopped = protocol.on_fault.apply(at.event.before)
        return replace(at.then("answers-as", "unknown-id"), state=stopped)
    done = spec.effect.apply(at.event.before, {part.name: part.low for part in spec.fields})
    return replace(at.then("answers-as", "valid"), state=done)


@effect
def queue(at: At, room: int) -> Reaction:
    """Of frames sent ahead so many have room, each further one is lost."""
    memory = at.device.memory
    waiting = memory.get("waiting", 0) + 1 if at.event.pipelined else 1
    memory["waiting"] = min(waiting, room + 1)
    return loses(at) if waiting > room else at.reaction


@effect
def lost_behind_a_fault(at: At) -> Reaction:
    """Frames pipelined behind a fault are lost, until the host waits for an answer."""
    memory = at.device.memory
    lost = at.event.pipelined and "lost" in memory
    if not lost:
        memory.pop("lost", None)
    if not at.event.judgement.valid:
        memory["lost"] = 1
    return loses(at) if lost else at.reaction


@watching
def restarts(at: At, acting: Trigger, settings: int = 0) -> Reaction:
    """The motion that the last fault ended resumes at a frame of the trigger.

    `settings` is the number of valid frames since then at which it resumes; 0 for any. An
    instruction that sets the motion ends the wait.
    """
    memory, event, valid = at.device.memory, at.event, at.event.judgement.valid
    words = at.device.protocol.variables[at.car.by].words
    if not valid and event.before.moving:
        memory["motion"] = words.index(at.value("motion", before=True))
        memory["settings"] = 0
        return at.reaction
    instruction = event.judgement.instruction
    if valid and instruction and instruction.effect.sets(at.car.by):
        memory.pop("motion", None)
    if "motion" not in memory:
        return at.reaction
    if valid:
        memory["settings"] = min(memory["settings"] + 1, settings + 1)
    if not acting.holds(event, memory) or (settings and memory["settings"] != settings):
        return at.reaction
    return at.state(motion=words[memory.pop("motion")])


_SPEED_TO_COME = "speed to come"


@watching
def speed_at_next_motion(at: At, acting: Trigger) -> Reaction:
    """A speed at frames of the trigger applies from the next motion instruction."""
    memory, known = at.device.memory, at.event.judgement.instruction
    if known is None or not at.event.judgement.valid:
        return at.reaction
    if known.effect.sets(at.car.speed) and not known.effect.sets(at.car.by):
        memory.pop(_SPEED_TO_COME, None)
        if acting.holds(at.event, memory):
            memory[_SPEED_TO_COME] = at.value("speed")
            return at.then("keeps", "speed")
    elif _SPEED_TO_COME in memory and at.car.moves(known.effect):
        return at.state(speed=memory.pop(_SPEED_TO_COME))
    return at.reaction


# -- choices at open points ----------------------------------------------------------------------


@effect
def chooses(at: At, point: str, word: str) -> Reaction:
    """Where this open point arises, the device makes the choice of that word."""
    if not trigger(f"open {point}").holds(at.event, {}):
        return at.reaction
    open_point = POINTS[point.replace(":", " ")]
    choice = open_point.choice(word)
    assert choice is not None
    if isinstance(choice.does, Outcome):
        return answers(at.reaction, at.code(choice.does))
    if choice.does is Behaviour.SILENT:
        return silent(at)
    if choice.does is Behaviour.KEPT:
        return keeps(at, open_point.about)
    if open_point.about == "speed":
        at.device.memory.pop(_SPEED_TO_COME, None)
    return sets(at, open_point.about, 0)


@effect
def takes_low_bits(at: At) -> Reaction:
    """The data are accepted: bits that have a meaning are used and others ignored."""
    known = at.event.judgement.instruction
    assert known is not None
    fields = {
        part.name: value & part.high
        for part, (_, value) in zip(known.fields, at.event.judgement.fields, strict=True)
    }
    done = known.effect.apply(at.event.before, fields)
    return replace(at.then("answers-as", "valid"), state=done)


# -- from effects to hooks -----------------------------------------------------------------------


def does_effect(word: str, *arguments: Any) -> React:
    """Return the hook of an effect."""
    function = EFFECTS[word]
    return lambda device, event, reaction: function(At(device, event, reaction), *arguments)


def does_watching(word: str, acting: Trigger, *arguments: Any) -> React:
    """Return the hook of an effect that sees every frame."""
    function = WATCHING[word]
    return lambda device, event, reaction: function(At(device, event, reaction), acting, *arguments)


def at_frames(acting: Trigger, change: React) -> React:
    """Return the hook that makes the change at the frames of the trigger."""
    return lambda device, event, reaction: (
        change(device, event, reaction) if acting.holds(event, device.memory) else reaction
    )


def then(*changes: React) -> React:
    """Return the hook that makes the changes one after the other."""

    def react(device: Simulator, event: Event, reaction: Reaction) -> Reaction:
        for change in changes:
            reaction = change(device, event, reaction)
        return reaction

    return react
