"""The suite of the Wp-method finds every machine that differs: exhaustively for small ones."""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Iterator
from itertools import product
from random import Random

import pytest

from bilprov.conformance.machines.wp_method import (
    NO_RESET,
    Characterisation,
    Mealy,
    Output,
    Reset,
    Suite,
    input_classes,
    minimal,
    state_cover,
    wp_suite,
)


def counted(outputs: tuple[Output, ...]) -> Hashable:
    """What is seen of a reset whose outputs come one by one, but not when."""
    return tuple(output for output in outputs if output)


RESETS = {"not judged": NO_RESET, "judged": Reset(b"\0\0\0", counted)}


def every_machine(states: int, inputs: int, outputs: int) -> Iterator[Mealy[Output]]:
    rows = list(product(product(range(states), range(outputs)), repeat=inputs))
    for machine in product(rows, repeat=states):
        yield Mealy(
            tuple(tuple(target for target, _ in row) for row in machine),
            tuple(tuple(output for _, output in row) for row in machine),
        )


def drawn(draw: Random, states: int, inputs: int, outputs: int) -> Mealy[Output]:
    return Mealy(
        tuple(tuple(draw.randrange(states) for _ in range(inputs)) for _ in range(states)),
        tuple(tuple(draw.randrange(outputs) for _ in range(inputs)) for _ in range(states)),
    )


def equal(one: Mealy[Output], other: Mealy[Output]) -> bool:
    """Whether two machines give the same outputs to every word, by walking through both."""
    met, found = {(0, 0)}, deque([(0, 0)])
    while found:
        a, b = found.popleft()
        if one.outputs[a] != other.outputs[b]:
            return False
        for pair in zip(one.targets[a], other.targets[b], strict=True):
            if pair not in met:
                met.add(pair)
                found.append(pair)
    return True


def passes(device: Mealy[Output], specified: Mealy[Output], suite: Suite, reset: Reset) -> bool:
    """Whether a device answers the suite as specified; of resets only what is seen counts."""
    return all(
        device.run(word) == specified.run(word)
        and reset.seen(device.run(reset.word, device.after(word)))
        == reset.seen(specified.run(reset.word, specified.after(word)))
        for word in suite.words
    )


def small_machines(states: int) -> list[Mealy[Output]]:
    every = (machine for n in range(1, states + 1) for machine in every_machine(n, 2, 2))
    return [m for m in every if len(minimal(m)) == len(m)]


@pytest.mark.slow
@pytest.mark.parametrize("reset", RESETS.values(), ids=RESETS)
@pytest.mark.parametrize("extra", [0, 1])
def test_every_machine_of_one_or_two_states_is_told_from_every_other(
    reset: Reset, extra: int
) -> None:
    for specified in small_machines(2):
        suite = wp_suite(specified, extra, reset)
        for states in range(1, len(specified) + extra + 1):
            if states > 2:
                continue
            for device in every_machine(states, 2, 2):
                assert passes(device, specified, suite, reset) == equal(device, specified)


@pytest.mark.parametrize("reset", RESETS.values(), ids=RESETS)
@pytest.mark.parametrize("extra", [0, 1, 2])
def test_random_machines_with_at_most_so_many_states_more_are_told_apart(
    reset: Reset, extra: int
) -> None:
    draw = Random(extra)
    told = 0
    for _ in range(40):
        specified = minimal(drawn(draw, draw.randint(2, 6), 3, 2))
        suite = wp_suite(specified, extra, reset)
        for _ in range(20):
            device = drawn(draw, draw.randint(1, len(specified) + extra), 3, 2)
            assert passes(device, specified, suite, reset) == equal(device, specified)
        for device in mutants(draw, specified, extra):
            assert passes(device, specified, suite, reset) == equal(device, specified)
            told += not equal(device, specified)
    assert told > 100


def mutants(draw: Random, specified: Mealy[Output], extra: int) -> Iterator[Mealy[Output]]:
    """Machines that differ in one transition, each state of which may be split in several."""
    for _ in range(20):
        states = range(len(specified) + extra)
        copied = [*range(len(specified)), *(draw.randrange(len(specified)) for _ in range(extra))]
        alike = [[s for s in states if copied[s] == one] for one in range(len(specified))]
        targets = [[draw.choice(alike[t]) for t in specified.targets[copied[s]]] for s in states]
        outputs = [list(specified.outputs[copied[s]]) for s in states]
        state, symbol = draw.choice(states), draw.choice(specified.inputs)
        if draw.random() < 0.5:
            targets[state][symbol] = draw.choice(states)
        else:
            outputs[state][symbol] = 1 - int(str(outputs[state][symbol]))
        yield Mealy(tuple(map(tuple, targets)), tuple(map(tuple, outputs)))


def test_a_minimal_machine_has_the_outputs_of_the_whole_one_and_no_two_states_alike() -> None:
    draw = Random(1)
    for _ in range(200):
        machine = drawn(draw, draw.randint(1, 7), 2, 2)
        smallest = minimal(machine)
        assert equal(smallest, machine)
        assert len(minimal(smallest)) == len(smallest)
        Characterisation(smallest)  # raises for one that is not minimal


def test_a_machine_that_is_not_minimal_has_no_characterising_set() -> None:
    with pytest.raises(ValueError, match="not minimal"):
        wp_suite(Mealy(((1,), (0,)), ((0,), (0,))))


def test_each_state_is_told_from_all_others_by_its_identifying_words() -> None:
    draw = Random(2)
    for reset in RESETS.values():
        for _ in range(50):
            machine = minimal(drawn(draw, 7, 3, 2))
            told = Characterisation(machine, reset)
            for one, other in product(range(len(machine)), repeat=2):
                words = told.identifying(one)
                differs = [told.response(one, w) != told.response(other, w) for w in words]
                assert any(differs) == (one != other)
                assert set(words) <= set(told.words)


def test_a_dear_input_is_used_only_where_nothing_else_tells_states_apart() -> None:
    # Input 1 tells the states apart at once, input 0 after two steps.
    machine = minimal(Mealy(((1, 0), (2, 1), (0, 2)), ((0, 0), (0, 1), (1, 2))))

    assert all(1 not in word for word in Characterisation(machine, dear=[1]).words)
    assert any(1 in word for word in Characterisation(machine).words)


def test_the_state_cover_reaches_every_state_and_dear_inputs_last() -> None:
    machine = Mealy(((1, 2), (2, 0), (0, 0)), ((0, 0), (1, 0), (0, 1)))

    assert [machine.after(word) for word in state_cover(machine)] == [0, 1, 2]
    assert state_cover(machine) == (b"", b"\0", b"\1")
    assert state_cover(machine, dear=[1]) == (b"", b"\0", b"\0\0")


def test_inputs_that_no_state_tells_apart_are_one_class() -> None:
    machine = Mealy(((1, 1, 0), (0, 0, 1)), ((0, 0, 0), (1, 1, 0)))

    assert input_classes(machine) == ((0, 1), (2,))
