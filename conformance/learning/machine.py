"""A Mealy machine as a value, in a numbering that depends on its behaviour alone."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

from bilprov.conformance.learning.output import Output

State = TypeVar("State", bound=Hashable)
Word = tuple[int, ...]
"""A sequence of inputs, each the index of a step of the alphabet."""


class Transition(NamedTuple):
    """The state that an input leads to, and the output that it gives."""

    target: int
    output: Output


@dataclass(frozen=True, slots=True)
class Machine:
    """A Mealy machine: `states[state][input]` is a transition, and state 0 the initial one.

    States are numbered breadth first by the inputs' order, so that minimal machines are equal if
    and only if they behave alike.
    """

    states: tuple[tuple[Transition, ...], ...]

    @property
    def inputs(self) -> range:
        """The inputs."""
        return range(len(self.states[0]))

    def outputs(self, word: Sequence[int], state: int = 0) -> list[Output]:
        """The outputs for a sequence of inputs."""
        found: list[Output] = []
        for letter in word:
            state, output = self.states[state][letter]
            found.append(output)
        return found

    def access(self) -> tuple[Word, ...]:
        """A shortest sequence of inputs to each state."""
        words: dict[int, Word] = {0: ()}
        for state in range(len(self.states)):  # in the order of breadth first
            for letter, transition in enumerate(self.states[state]):
                words.setdefault(transition.target, (*words[state], letter))
        return tuple(words[state] for state in range(len(self.states)))

    def minimal(self) -> Machine:
        """The machine with the fewest states that behaves like this one."""
        block: list[int] = [0] * len(self.states)
        while True:
            signatures = [
                (block[state], tuple((block[t.target], t.output) for t in row))
                for state, row in enumerate(self.states)
            ]
            numbers: dict[Hashable, int] = {}
            finer = [numbers.setdefault(one, len(numbers)) for one in signatures]
            if len(numbers) == len(set(block)):
                break
            block = finer
        example = {number: state for state, number in reversed(list(enumerate(block)))}

        def step(number: int, letter: int) -> tuple[int, Output]:
            target, output = self.states[example[number]][letter]
            return block[target], output

        return explored(block[0], len(self.inputs), step)


def explored(
    initial: State, inputs: int, step: Callable[[State, int], tuple[State, Output]]
) -> Machine:
    """The machine of all states that can be reached; `step` gives a state's next and output."""
    numbers: dict[State, int] = {initial: 0}
    queue = deque([initial])
    states: list[tuple[Transition, ...]] = []
    while queue:
        state = queue.popleft()
        row: list[Transition] = []
        for letter in range(inputs):
            following, output = step(state, letter)
            if following not in numbers:
                numbers[following] = len(numbers)
                queue.append(following)
            row.append(Transition(numbers[following], output))
        states.append(tuple(row))
    return Machine(tuple(states))
