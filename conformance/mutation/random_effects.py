"""Effects of random faults: wrong answers, missing stops, wrong settings and lost bytes."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from bilprov.conformance.dut.fault import Event, Hear, MutatedDevice, React, Reaction
from bilprov.conformance.mutation.faults.vocabulary import (
    answers_again,
    answers_ok,
    answers_with,
    drives_on,
    late,
    resizes,
    resumes_after,
    sets,
    silent,
    stands_still,
    stops_after,
    twice,
)
from bilprov.spec.by_effect import moving_motions, variable_of
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import InstructionSpec
from bilprov.spec.protocol import Protocol as Grammar


class Drawing(Protocol):
    """Source of random numbers."""

    def below(self, end: int) -> int:
        """Return a whole number from 0 to `end` - 1."""


class Effect(NamedTuple):
    """One effect: its hooks, and words that continue the description of the trigger."""

    words: str
    react: React
    hear: Hear | None = None


def effects_on(
    protocol: Grammar,
    draw: Drawing,
    spec: InstructionSpec | None,
    outcome: Outcome | None,
    *,
    valid: bool,
    cut: bool,
) -> list[Effect]:
    """Return the effects that a random fault may have on such frames; no reading allows them.

    `spec` is the instruction (None: any), `outcome` the kind of fault (None: any), `cut` is true
    for truncated frames. An effect that stands in the list several times is drawn more often.
    """
    found = _answers(protocol, draw, outcome, valid=valid, cut=cut)
    if not valid:
        return found + _stops(protocol) + _astray(protocol, draw, ("led", "speed"))
    if spec is None or spec.effect.motion is Motion.STOPPED:
        return found + 2 * _no_stop(protocol) + _astray(protocol, draw, ("led",))
    if not spec.effect.assignments:
        return found
    found += 3 * [Effect("is answered and not carried out", drives_on)]
    motion = spec.effect.motion
    if motion is None:
        own = variable_of(spec)
        others = [name for name in ("speed", "led", "steering") if name != own]
        found += 2 * _astray(protocol, draw, (own,)) + _astray(protocol, draw, others)
        return [*found, Effect("stops it", stands_still)]
    motions = [other for other in moving_motions(protocol) if other is not motion]
    if motions:
        other = motions[draw.below(len(motions))]
        found.append(Effect(f"moves it {other.value}", sets(motion=other)))
    return found + _astray(protocol, draw, ("speed", "led"))


def _answers(
    protocol: Grammar, draw: Drawing, outcome: Outcome | None, *, valid: bool, cut: bool
) -> list[Effect]:
    ok = protocol.answers[Outcome.VALID].code
    bad = Outcome.BAD_DATA if outcome in (None, Outcome.UNKNOWN_ID) else Outcome.UNKNOWN_ID
    wrong = protocol.answers[bad]
    unused = [code for code in range(256) if code not in protocol.codes]
    code = unused[draw.below(len(unused))]
    found = [
        Effect(f"is answered {code}, an unused code", answers_with(code)),
        Effect("is answered twice", twice),
        Effect("is answered again 12 ms later", answers_again(12)),
        Effect("is answered much too late", late(1.2 * protocol.timing.answer_longest)),
        Effect("makes it lose the next byte", _marks, _loses),
    ]
    if valid:
        some = [r for r in protocol.responses if r.code != ok]
        given = some[draw.below(len(some))]
        found.append(Effect(f"is answered {given.name}", answers_with(given.code)))
    else:
        fine = protocol.answers[Outcome.VALID].name
        found.append(Effect(f"is answered {fine}, but stops it", answers_ok))
        if outcome is not None or cut:
            found.append(Effect(f"is answered {wrong.name}", answers_with(wrong.code)))
    if outcome is not None or valid:  # not to answer a truncated frame is legal
        found.append(Effect("is not answered", silent))
    return found


def _stops(protocol: Grammar) -> list[Effect]:
    longest = protocol.timing.stop_longest
    return [
        *(3 * [Effect("does not stop it", drives_on)]),
        Effect("stops it much too late", stops_after(3 * longest)),
        *(
            Effect(f"stops it, and it drives on {pause} ms later", resumes_after(pause))
            for pause in (12, 60, 120)
        ),
    ]


def _no_stop(protocol: Grammar) -> list[Effect]:
    return [
        Effect("does nothing", drives_on),
        Effect("stops it, and it drives on 15 ms later", resumes_after(15)),
    ]


def _astray(
    protocol: Grammar, draw: Drawing, variables: tuple[str, ...] | list[str]
) -> list[Effect]:
    """Return effects that turn one bit of a variable; readings allow only to keep or zero it."""
    found = []
    for name in variables:
        if name not in protocol.limits:
            continue
        high = protocol.limits[name][1]
        bit = draw.below(max(1, high.bit_length()))
        found.append(Effect(f"turns bit {bit} of the {name}", _turned(name, bit)))
    return found


def _turned(name: str, bit: int) -> React:
    return resizes(name, lambda size: size ^ 1 << bit)


def _marks(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    device.memory["deaf"] = 1
    return reaction


def _loses(device: MutatedDevice, data: bytes, now: int) -> bytes:
    return b"" if device.memory.pop("deaf", 0) else data
