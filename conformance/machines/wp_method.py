"""The Wp-method: words that tell a machine from every other with a bounded number of states.

After Fujiwara, von Bochmann, Khendek, Amalou, Ghedamsi: "Test selection based on finite state
models", IEEE Transactions on Software Engineering 17 (1991). A device with at most `extra` states
more than the minimal machine that answers every word of the suite as the machine does is equal to
it, if each word begins in the device's initial state.

What comes after a word, the reset, may be judged too. Then it helps to tell states apart, and most
words get by with a shorter ending, or with none.

Also: Mealy machines as values; explores, runs and minimises them, and finds inputs that are alike.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import zip_longest
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


def _nothing(outputs: tuple[Output, ...]) -> Hashable:
    return ()


@dataclass(frozen=True, slots=True)
class Reset:
    """The word that follows each word of the suite, and what is seen of its outputs.

    `seen` may be less than the outputs one by one, for example what they are without when they
    came: the outputs under test are those before the reset.
    """

    word: bytes = b""
    seen: Callable[[tuple[Output, ...]], Hashable] = _nothing


NO_RESET = Reset()


@dataclass(frozen=True, slots=True)
class Suite:
    """The words of a test suite.

    `covered` are the beginnings of the words whose last output is under test: after each of them it
    must be seen whether there was an output, and which.
    """

    words: tuple[bytes, ...]
    covered: frozenset[bytes]

    def places(self, word: bytes) -> tuple[int, ...]:
        """The places in a word (inputs from its beginning) where the last output is under test."""
        return tuple(end for end in range(1, len(word) + 1) if word[:end] in self.covered)


class Characterisation:
    """What tells the states of a minimal machine apart.

    `words` is the characterising set (W): no two states respond alike to all of them.
    `identifying(state)` is a part of it that tells one state from all others (W_i). `dear` are
    inputs that are used only where no word without them tells two states apart.
    """

    def __init__(
        self, machine: Mealy[Output], reset: Reset = NO_RESET, dear: Sequence[int] = ()
    ) -> None:
        self._machine = machine
        self._reset = reset
        self._dear = bytes(dear)
        self._rounds = list(_rounds(machine, dear))
        self.words = self._words()
        self._responses = [
            [self.response(state, word) for word in self.words] for state in range(len(machine))
        ]

    def response(self, state: int, word: bytes) -> Hashable:
        """What is seen when a word and then the reset are given in a state."""
        machine, reset = self._machine, self._reset
        ended = machine.run(reset.word, machine.after(word, state))
        return machine.run(word, state), reset.seen(ended)

    def identifying(self, state: int) -> tuple[bytes, ...]:
        """A few of `words` to which no other state responds as this one does."""
        mine = self._responses[state]
        alike = set(range(len(self._machine))) - {state}
        chosen: list[bytes] = []
        while alike:
            told = [
                {s for s in alike if self._responses[s][n] != own} for n, own in enumerate(mine)
            ]
            best = max(range(len(told)), key=lambda n: self._worth(self.words[n], len(told[n])))
            chosen.append(self.words[best])
            alike -= told[best]
        return tuple(chosen) or (b"",)

    def _worth(self, word: bytes, told: int) -> tuple[object, ...]:
        """How good a word is that tells so many states apart: larger is better."""
        return told > 0, not self._is_dear(word), told, -len(word)

    def _is_dear(self, word: bytes) -> bool:
        return any(symbol in self._dear for symbol in word)

    def _words(self) -> tuple[bytes, ...]:
        """Words until every state responds differently.

        States that words without dear inputs tell apart are told apart by these first, and what
        other words make superfluous is left out of them.
        """
        cheap = [blocks for inputs, blocks in self._rounds if not self._is_dear(bytes(inputs))][-1]
        words = self._completed([b""], cheap)
        for word in sorted(words, key=len):
            others = [one for one in words if one != word]
            words = words if self._alike(others, cheap) else others
        _, every = self._rounds[-1]
        return tuple(self._completed(words, every)) or (b"",)

    def _completed(self, words: list[bytes], blocks: list[int]) -> list[bytes]:
        """These words and as many more as tell the states of different blocks apart."""
        words = list(words)
        while pair := self._alike(words, blocks):
            words.append(self.separating(*pair))
        return words

    def _alike(self, words: list[bytes], blocks: list[int]) -> tuple[int, int] | None:
        """Two states of different blocks that respond alike to these words, None if no two do."""
        met: dict[Hashable, int] = {}
        for state in range(len(self._machine)):
            first = met.setdefault(tuple(self.response(state, word) for word in words), state)
            if blocks[first] != blocks[state]:
                return first, state
        return None

    def separating(self, one: int, other: int) -> bytes:
        """The shortest word that tells two states apart, without dear inputs if there is one."""
        machine, word = self._machine, bytearray()
        level = self._level(one, other)
        while level:
            inputs, _ = self._rounds[level]
            _, before = self._rounds[level - 1]
            for symbol in inputs:
                ends = machine.targets[one][symbol], machine.targets[other][symbol]
                differ = machine.outputs[one][symbol] != machine.outputs[other][symbol]
                if differ or before[ends[0]] != before[ends[1]]:
                    break
            word.append(symbol)
            if differ:
                break
            one, other = ends
            level = self._level(one, other)
        return bytes(word)

    def _level(self, one: int, other: int) -> int:
        """The first round of the refinement that has two states in different blocks."""
        return next(n for n, (_, b) in enumerate(self._rounds) if b[one] != b[other])


def _rounds(
    machine: Mealy[Output], dear: Sequence[int]
) -> Iterator[tuple[tuple[int, ...], list[int]]]:
    """The partitions of the refinement, each with the inputs that led to it; dear ones come last.

    Raises ValueError for a machine that is not minimal.
    """
    blocks = [0] * len(machine)
    yield (), blocks
    cheap = tuple(symbol for symbol in machine.inputs if symbol not in dear)
    for inputs in (cheap, (*cheap, *dear)):
        while True:
            finer = refined(machine, blocks, inputs)
            if len(set(finer)) == len(set(blocks)):
                break
            blocks = finer
            yield inputs, blocks
    if len(set(blocks)) < len(machine):
        raise ValueError("the machine is not minimal: no word distinguishes two of its states")


def state_cover(machine: Mealy[Output], dear: Sequence[int] = ()) -> tuple[bytes, ...]:
    """The shortest word to each state, in the order of the states; dear inputs are tried last."""
    words: dict[int, bytes] = {0: b""}
    cheap = [symbol for symbol in machine.inputs if symbol not in dear]
    for inputs in (cheap, machine.inputs):
        found = deque(words)
        while found:
            state = found.popleft()
            for symbol in inputs:
                target = machine.targets[state][symbol]
                if target not in words:
                    words[target] = words[state] + bytes([symbol])
                    found.append(target)
    return tuple(words[state] for state in range(len(machine)))


def most_words(machine: Mealy[Output], extra: int) -> int:
    """How many beginnings the suite has, each of which needs at least one word."""
    return int(len(machine) * len(machine.inputs) ** (extra + 1))


def wp_suite(
    machine: Mealy[Output], extra: int = 0, reset: Reset = NO_RESET, dear: Sequence[int] = ()
) -> Suite:
    """The words of the Wp-method for devices with at most `extra` states more than the machine.

    The machine must be minimal. First each state is reached and shown to differ from the others
    (by the whole characterising set), then each transition is taken and its end identified.
    """
    characterisation = Characterisation(machine, reset, dear)
    identifying = [characterisation.identifying(state) for state in range(len(machine))]
    known = set(state_cover(machine, dear))
    level = known
    for _ in range(extra):
        level = {word + bytes([symbol]) for word in level for symbol in machine.inputs} - known
        known |= level
    transitions = {word + bytes([symbol]) for word in level for symbol in machine.inputs} - known
    reached = (word + end for word in known for end in characterisation.words)
    taken = (word + end for word in transitions for end in identifying[machine.after(word)])
    words = sorted({*reached, *taken})
    # What follows the beginning of a longer word is not the reset.
    chosen = words if reset.word else _without_beginnings(words)
    return Suite(tuple(chosen), frozenset(known | transitions))


def _without_beginnings(words: list[bytes]) -> Iterator[bytes]:
    """The sorted words that are not the beginning of another."""
    for word, following in zip_longest(words, words[1:], fillvalue=b""):
        if not following.startswith(word) or not following:
            yield word
