"""Draws the effects of random faults; no reading of the document allows any of them."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from operator import xor
from typing import NamedTuple

from bilprov.conformance.dut.fault import Event, Hear, MutatedDevice, React, Reaction
from bilprov.conformance.mutation.draw import Draw
from bilprov.conformance.mutation.faults.vocabulary import (
    answers_again,
    answers_ok,
    answers_twice,
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
from bilprov.conformance.mutation.random_triggers import What
from bilprov.spec.by_effect import moving_motions, variable_of
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol


class Effect(NamedTuple):
    """One effect: its hooks, and words that continue the description of the trigger."""

    words: str
    react: React
    hear: Hear | None = None


def effects(protocol: Protocol, draw: Draw, what: What, *, in_silence: bool = True) -> list[Effect]:
    """Return the effects that a fault may have on such frames; no reading allows them.

    An effect that stands in the list several times is drawn more often. Without `in_silence` those
    are left out that show only where nothing is sent after the frame: a trigger that ten thousand
    frames are sent to meet would take a silence after each of them.
    """
    found, spec = _answers(protocol, draw, what, in_silence=in_silence), what.spec
    if spec is None:
        found += 3 * [Effect("does not stop it", drives_on)]
        too_late = stops_after(3 * protocol.timing.stop_longest)
        found.append(Effect("stops it much too late", too_late))
        if in_silence:
            found += [_resumes(pause) for pause in (12, 60, 120)]
        return found + _astray(protocol, draw, ("led", "speed"))
    motion = spec.effect.motion
    if motion is Motion.STOPPED:
        found += 2 * [Effect("does nothing", drives_on), *([_resumes(15)] if in_silence else [])]
        return found + _astray(protocol, draw, ("led",))
    if not spec.effect.assignments:
        return found
    found += 3 * [Effect("is answered and not carried out", drives_on)]
    if motion is None:
        own = variable_of(spec)
        others = [name for name in ("speed", "led", "steering") if name != own]
        found += 2 * _astray(protocol, draw, (own,)) + _astray(protocol, draw, others)
        return [*found, Effect("stops it", stands_still)]
    motions = [other for other in moving_motions(protocol) if other is not motion]
    if motions:
        other = draw.pick(motions)
        found.append(Effect(f"moves it {other.value}", sets(motion=other)))
    return found + _astray(protocol, draw, ("speed", "led"))


def _answers(protocol: Protocol, draw: Draw, what: What, *, in_silence: bool) -> list[Effect]:
    ok = protocol.answers[Outcome.VALID]
    code = draw.pick([code for code in range(256) if code not in protocol.codes])
    found = [
        Effect(f"is answered {code}, an unused code", answers_with(code)),
        Effect("is answered twice", twice),
        again(12, in_silence=in_silence),
        Effect("is answered much too late", late(1.2 * protocol.timing.answer_longest)),
        Effect("makes it lose the next byte", _marks, _loses),
    ]
    if what.spec:
        given = draw.pick([spec for spec in protocol.responses if spec.code != ok.code])
        found.append(Effect(f"is answered {given.name}", answers_with(given.code)))
    else:
        found.append(Effect(f"is answered {ok.name}, but stops it", answers_ok))
        if what.outcome is not None or what.cut:
            bad = what.outcome in (None, Outcome.UNKNOWN_ID)
            wrong = protocol.answers[Outcome.BAD_DATA if bad else Outcome.UNKNOWN_ID]
            found.append(Effect(f"is answered {wrong.name}", answers_with(wrong.code)))
    if what.outcome is not None or what.spec:  # not to answer a truncated frame is legal
        found.append(Effect("is not answered", silent))
    return found


def again(milliseconds: int, *, in_silence: bool) -> Effect:
    """Return the effect of a second answer so much later.

    With `in_silence` it comes only if no frame comes before it.
    """
    if in_silence:
        return Effect(f"is answered again {milliseconds} ms later", answers_again(milliseconds))
    return Effect(f"is answered twice, {milliseconds} ms apart", answers_twice(milliseconds))


def _resumes(pause: int) -> Effect:
    return Effect(f"stops it, and it drives on {pause} ms later", resumes_after(pause))


def _astray(protocol: Protocol, draw: Draw, variables: Iterable[str]) -> list[Effect]:
    """Return effects that turn one bit of a variable; readings allow only to keep or zero it."""
    found = []
    for name in variables:
        if name in protocol.limits:
            bit = draw.below(max(1, protocol.limits[name][1].bit_length()))
            turned = resizes(name, partial(xor, 1 << bit))
            found.append(Effect(f"turns bit {bit} of the {name}", turned))
    return found


def _marks(device: MutatedDevice, event: Event, reaction: Reaction) -> Reaction:
    device.memory["deaf"] = 1
    return reaction


def _loses(device: MutatedDevice, data: bytes, now: int) -> bytes:
    return b"" if device.memory.pop("deaf", 0) else data
