"""Mealy machines as values: explores, runs and minimises them, and finds inputs that are alike."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

S = TypeVar("S", bound=Hashable)
T = TypeVar("T", bound=Hashable)
O_co = TypeVar("O_co", bound=Hashable, covariant=True)
Output = Hashable

MOST_INPUTS = 256
"""Inputs that a machine may have: a word is `bytes`, each byte the number of an input."""


@dataclass(frozen=True, slots=True)
class Mealy(Generic[O_co]):
    """A complete, deterministic Mealy machine; it starts in state 0.

    `targets` and `outputs` hold a row for each state with an entry for each input.
    """

    targets: tuple[tuple[int, ...], ...]
    outputs: tuple[tuple[O_co, ...], ...]

    def __len__(self) -> int:
        return len(self.targets)

    @property
    def inputs(self) -> range:
        """The numbers of the inputs."""
        return range(len(self.targets[0]))

    def after(self, word: bytes, state: int = 0) -> int:
        """The state to which a word leads."""
        for symbol in word:
            state = self.targets[state][symbol]
        return state

    def run(self, word: bytes, state: int = 0) -> tuple[O_co, ...]:
        """The output of each input of a word."""
        outputs = []
        for symbol in word:
            outputs.append(self.outputs[state][symbol])
            state = self.targets[state][symbol]
        return tuple(outputs)

    def restricted(self, inputs: Iterable[int]) -> Mealy[O_co]:
        """The machine with only these inputs, in this order."""
        chosen = tuple(inputs)
        return Mealy(
            tuple(tuple(row[symbol] for symbol in chosen) for row in self.targets),
            tuple(tuple(row[symbol] for symbol in chosen) for row in self.outputs),
        )


def explore(start: S, inputs: int, step: Callable[[S, int], tuple[S, T]]) -> Mealy[T]:
    """The machine of all states that inputs reach from `start`; `step` gives state and output.

    Raises ValueError for more than MOST_INPUTS inputs.
    """
    if inputs > MOST_INPUTS:
        raise ValueError(f"{inputs} inputs are too many for a word of bytes, {MOST_INPUTS} fit")
    numbers = {start: 0}
    found = deque([start])
    targets, outputs = [], []
    while found:
        state = found.popleft()
        row = [step(state, symbol) for symbol in range(inputs)]
        for target, _ in row:
            if target not in numbers:
                numbers[target] = len(numbers)
                found.append(target)
        targets.append(tuple(numbers[target] for target, _ in row))
        outputs.append(tuple(output for _, output in row))
    return Mealy(tuple(targets), tuple(outputs))


def refined(machine: Mealy[Output], blocks: Sequence[int], inputs: Iterable[int]) -> list[int]:
    """The next partition: states stay in a block that agree on outputs and on the targets' blocks.

    `blocks` holds the number of each state's block.
    """
    symbols = tuple(inputs)
    numbers: dict[Hashable, int] = {}
    after = []
    for state, (targets, outputs) in enumerate(zip(machine.targets, machine.outputs, strict=True)):
        told = tuple((outputs[symbol], blocks[targets[symbol]]) for symbol in symbols)
        after.append(numbers.setdefault((blocks[state], told), len(numbers)))
    return after


def minimal(machine: Mealy[T]) -> Mealy[T]:
    """The smallest machine with the same outputs for every word, by partition refinement."""
    blocks, count = [0] * len(machine), 0
    while count < len(set(blocks)) or count == 0:
        count = len(set(blocks))
        blocks = refined(machine, blocks, machine.inputs)
    member = {block: state for state, block in reversed(list(enumerate(blocks)))}

    def step(block: int, symbol: int) -> tuple[int, T]:
        state = member[block]
        return blocks[machine.targets[state][symbol]], machine.outputs[state][symbol]

    return explore(blocks[0], len(machine.inputs), step)


def input_classes(machine: Mealy[Output]) -> tuple[tuple[int, ...], ...]:
    """The inputs in classes: those of one class have the same target and output in every state."""
    classes: dict[Hashable, list[int]] = {}
    for symbol in machine.inputs:
        column = tuple(
            (targets[symbol], outputs[symbol])
            for targets, outputs in zip(machine.targets, machine.outputs, strict=True)
        )
        classes.setdefault(column, []).append(symbol)
    return tuple(tuple(members) for members in classes.values())
