"""Learns the Protocol's own machine, to tell how long learning a conforming device will take."""

from __future__ import annotations

from bilprov.captures.schemas import MS
from bilprov.conformance.learning.alphabet import alphabet, reset
from bilprov.conformance.learning.learner import Learner
from bilprov.conformance.learning.machine import Machine, Transition, Word
from bilprov.conformance.learning.output import Output
from bilprov.conformance.learning.reference import reference_machine
from bilprov.conformance.oracle.choices import Choices
from bilprov.conformance.oracle.state_model import Model
from bilprov.conformance.oracle.timers import Timers
from bilprov.spec.protocol import Protocol

_OPENING = 10.0  # s for the link check, measurements and experiments
_LATENCY = MS // 2  # of an answer, and of a look


def estimated_seconds(
    protocol: Protocol,
    timers: Timers,
    *,
    byte_time: int,
    adapter: int = 0,
    observable: bool,
    seed: int = 1,
) -> float:
    """About how long (s) it takes to learn a conforming device.

    `byte_time` (ns) is that of its line, `adapter` (ns) for how long this holds each answer back;
    `observable` tells whether there is a probe. Raises NoAALpy where the library is missing.
    """
    reference = reference_machine(Model(protocol, Choices()), alphabet(protocol))
    if not observable:
        reference = Machine(
            tuple(
                tuple(Transition(t.target, Output(t.output.codes)) for t in row)
                for row in reference.states
            )
        )
    latency = _LATENCY + adapter
    rehearsal = _Rehearsal(protocol, reference, byte_time, latency, timers, looks=observable)
    Learner(rehearsal, reference, seed=seed).learn()
    return _OPENING + rehearsal.time / 1e9


class _Rehearsal:
    """A teacher that knows the machine and adds up the time (ns) that asking a device takes."""

    def __init__(
        self,
        protocol: Protocol,
        machine: Machine,
        byte_time: int,
        latency: int,
        timers: Timers,
        *,
        looks: bool,
    ) -> None:
        self.time = 0
        self._machine = machine
        self._known: set[Word] = set()

        def exchange(frame: bytes) -> int:
            return (len(frame) + 1) * byte_time + latency

        timeout = int(protocol.timing.truncation_timeout * MS)
        after = _LATENCY if looks else timers.settle
        self._steps = [
            exchange(step.frame) + step.truncated * timeout + after for step in alphabet(protocol)
        ]
        # Each stop of homing is answered while the next ones are sent.
        homing = (protocol.longest_frame + 1) * byte_time + latency + timers.settle
        self._reset = homing + sum(map(exchange, reset(protocol)))

    def outputs(self, word: Word) -> list[Output]:
        """The outputs of the machine; a sequence that is known already takes no time."""
        if word not in self._known:
            self._known |= {word[: end + 1] for end in range(len(word))}
            self.time += self._reset + sum(self._steps[letter] for letter in word)
        return self._machine.outputs(word)
