"""The level with a proof: sequences that tell the Protocol's byte machines from all others.

The words of the Wp-method (`conformance.machines`) become frames. Each word begins with the reset:
Stop instructions for a longest frame, as in homing, and the settings that the machine's first state
needs. Many words make one sequence; the resets between them are frames of it and judged as such.
The words come in a seeded order, and each byte class supplies all its values in turn.
"""

from __future__ import annotations

import random
from collections.abc import Container, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import cycle

from bilprov.captures.text import quantity
from bilprov.conformance.cases.byte_machine import ByteMachine, byte_machine
from bilprov.conformance.cases.sequence import Burst, SequenceCase
from bilprov.conformance.cases.steps import Step, step_of
from bilprov.conformance.machines.wp_method import Output, Reset, Suite, most_words, wp_suite
from bilprov.spec.by_effect import setting
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

GROUP = "complete"
MOST_WORDS = 100_000
"""Beginnings of words that a proof may have: its sequences are held in memory."""
_WORDS = 100  # of one sequence
_PAUSES = 4  # of one frame: more could reach a time-out that counts over the whole frame


@dataclass(frozen=True, slots=True)
class Proof:
    """One machine and the suite that proves it.

    `looks` says that its outputs show the kind of motion, and `settings` that they show what is set
    besides, but for the speed.
    """

    name: str
    looks: bool = False
    settings: bool = False

    def variables(self, protocol: Protocol) -> tuple[str, ...]:
        """The variables that the outputs show beside the kind of motion."""
        shown = protocol.settings if self.settings else ()
        return tuple(name for name in shown if name != protocol.car.speed)

    def facets(self, protocol: Protocol) -> tuple[str, ...]:
        """What a probe must tell for it."""
        return (protocol.car.by, *self.variables(protocol)) if self.looks else ()

    def seen(self, protocol: Protocol) -> str:
        """What the outputs show, in words."""
        if not self.looks:
            return "answers"
        *shown, last = ("the kind of motion", *map(protocol.noun, self.variables(protocol)))
        return f"{', '.join(('answers', *shown))} and {last}"

    def machine(self, protocol: Protocol) -> ByteMachine:
        """The protocol's machine, as far as this proof sees it."""
        if not self.looks:
            return byte_machine(protocol, None)
        shown = (name for name in self.variables(protocol) if _settable(protocol, name))
        return byte_machine(protocol, tuple(shown))

    def applies(self, protocol: Protocol) -> bool:
        """Whether the reset can bring a robot of this protocol into the machine's first state."""
        return not self.looks or _settable(protocol, protocol.car.speed)


PROOFS = (
    Proof("answers"),
    Proof("motion", looks=True),
    Proof("state", looks=True, settings=True),
)
"""What is proven, from what is seen through the wire alone to all that a probe may tell."""


def _settable(protocol: Protocol, variable: str) -> bool:
    """Whether the reset can give a variable its value in the machine's first state."""
    return variable not in protocol.limits or bool(_first_setting(protocol, variable))


def _first_setting(protocol: Protocol, variable: str) -> bytes:
    """A frame that gives a variable a value of the machine's first state; b"" if there is none."""
    speed = variable == protocol.car.speed
    return setting(protocol, variable, protocol.speeds[1] if speed else 0)


def announcement(protocol: Protocol, extra: int, groups: Container[str]) -> str:
    """What the proofs of these groups of sequences take, in one sentence."""
    told = []
    for proof in PROOFS:
        if proof.applies(protocol) and f"{GROUP}/{proof.name}" in groups:
            machine, words = proof.machine(protocol), suite(protocol, proof, extra).words
            told.append(
                f"{proof.seen(protocol)}: {len(machine.machine)} states, {len(machine.classes)} "
                f"byte classes and the silence, {quantity(len(words), 'word')} in "
                f"{quantity(sequences(protocol, proof, extra), 'sequence')}"
            )
    return "; ".join(told)


@lru_cache(maxsize=8)
def suite(protocol: Protocol, proof: Proof, extra: int) -> Suite:
    """The words of a proof. Raises UserError where they are too many."""
    machine = proof.machine(protocol)
    most = most_words(machine.machine, extra)
    if most > MOST_WORDS:
        raise UserError(
            f"--extra {extra} takes {most:,} words or more for {proof.seen(protocol)}, and at most "
            f"{MOST_WORDS:,} are made; give a smaller N, or choose a smaller machine with "
            f"--only '{GROUP}/{PROOFS[0].name}/*'"
        )
    pads = bytes([machine.input_of(protocol.pad_byte)]) * protocol.longest_frame
    return wp_suite(machine.machine, extra, Reset(pads, _seen_of_reset), [machine.silence])


def _seen_of_reset(outputs: tuple[Output, ...]) -> Hashable:
    """The answers to the reset, which is sent in one go, and what is seen at its end."""
    pairs = [output for output in outputs if isinstance(output, tuple)]
    return tuple(code for code, _ in pairs if code is not None), pairs[-1][1]


def sequences(protocol: Protocol, proof: Proof, extra: int) -> int:
    """How many sequences a proof has."""
    return -(-len(suite(protocol, proof, extra).words) // _WORDS)


def silence(protocol: Protocol) -> int:
    """How long (ms) nothing is sent where the silence comes between two frames."""
    return 1 + int(1.25 * protocol.timing.truncation_timeout)


def proof_sequences(
    protocol: Protocol, proof: Proof, seed: int, extra: int
) -> Iterator[SequenceCase]:
    """The sequences of a proof. Raises UserError where they are too many."""
    if not proof.applies(protocol):
        return
    told = suite(protocol, proof, extra)
    frames = _Frames(protocol, proof.machine(protocol), f"{proof.name} {seed}")
    every = random.Random(f"words {seed}").sample(told.words, len(told.words))
    for first in range(0, len(every), _WORDS):
        words = every[first : first + _WORDS]
        bursts = frames.bursts((word, frozenset(told.places(word))) for word in words)
        ident = f"{GROUP}/{proof.name}/{1 + first // _WORDS:04}"
        requirement = "from each state each byte leads where the document requires"
        about = {"seeded": True, "facets": proof.facets(protocol), "proving": True}
        yield SequenceCase.of(protocol, ident, requirement, bursts, **about)


class _Frames:
    """Writes words as bursts; each input takes the next of its bytes."""

    def __init__(self, protocol: Protocol, machine: ByteMachine, seed: str) -> None:
        self._protocol = protocol
        self._silence = machine.silence
        self._draw = random.Random(f"proof {seed}")
        self._bytes = [cycle(self._draw.sample(some, len(some))) for some in machine.classes]
        self._variables = [name for name in machine.variables if name in protocol.limits]
        self._pad = bytes([protocol.pad_byte])
        self._idle = silence(protocol)

    def bursts(self, words: Iterable[tuple[bytes, frozenset[int]]]) -> list[Burst]:
        """The words, each with the places in it after which no answer may come, and the resets."""
        made = [self._reset(b"", ())]
        for word, places in words:
            made += [Burst((step_of(self._protocol, frame),)) for frame in self._settings()]
            made += self._written(made.pop(), word, places)
        return made

    def _written(self, before: Burst, word: bytes, places: frozenset[int]) -> list[Burst]:
        """A word and the reset after it, from the burst before it on."""
        made, held, pauses = [before], b"", list[int]()
        for end, symbol in enumerate(word, 1):
            if symbol != self._silence:
                held += bytes([next(self._bytes[symbol])])
                if end in places:
                    pauses.append(len(held))
                if len(held) > self._protocol.lengths[held[0]]:
                    made.append(self._burst((step_of(self._protocol, held),), pauses))
                    held, pauses = b"", []
            elif held:
                made.append(Burst((step_of(self._protocol, held),)))
                held, pauses = b"", []
            else:
                made[-1] = replace(made[-1], idle_ms=made[-1].idle_ms + self._idle)
        return [*made, self._reset(held, pauses)]

    def _reset(self, held: bytes, pauses: Sequence[int]) -> Burst:
        """The reset, the first bytes of which complete a frame that has begun."""
        count = self._protocol.longest_frame
        missing = 1 + self._protocol.lengths[held[0]] - len(held) if held else 0
        begun = (step_of(self._protocol, held + self._pad * missing),) if held else ()
        return self._burst(
            (*begun, *[step_of(self._protocol, self._pad)] * (count - missing)), pauses
        )

    def _burst(self, steps: tuple[Step, ...], pauses: Sequence[int]) -> Burst:
        if not pauses:
            return Burst(steps)
        size = sum(len(step.frame) for step in steps)
        return Burst(steps, tuple(place for place in pauses if place < size)[-_PAUSES:])

    def _settings(self) -> Iterator[bytes]:
        """The frames that bring a stopped robot into the machine's first state."""
        for name in self._variables:
            _, high = self._protocol.limits[name]
            value = self._draw.randint(1, high) if name == self._protocol.car.speed else 0
            yield setting(self._protocol, name, value) or _first_setting(self._protocol, name)
