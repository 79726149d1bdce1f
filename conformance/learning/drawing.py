"""Draws a machine: DOT text of all its states or of its kinds of motion, and SVG by Graphviz."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field

from bilprov.captures.text import escape_controls, quantity
from bilprov.conformance.learning.machine import Machine
from bilprov.conformance.learning.output import Output
from bilprov.conformance.oracle.wording import answer_words
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

_PATIENCE = 300  # s that Graphviz may take
LARGE = 12
"""States up to which a picture shows each; of more, which take dot minutes, kinds of motion."""
_NAMED = 3  # inputs that are named on an arrow between kinds
_AT_ONCE = "nslimit=1; nslimit1=1; mclimit=0.1; splines=line;"


class DrawingError(UserError):
    """Graphviz did not draw the machine. One sentence."""


@dataclass(slots=True)
class _Arrow:
    """The transitions from one node to another, by their inputs' names, with their answers."""

    answers: dict[str, set[tuple[int, ...]]] = field(default_factory=dict)
    differing: dict[str, None] = field(default_factory=dict)

    def add(self, name: str, codes: tuple[int, ...], differs: bool) -> None:
        self.answers.setdefault(name, set()).add(codes)
        if differs:
            self.differing[name] = None

    def line(self, protocol: Protocol, source: int, target: int, look: str, named: int) -> str:
        """The arrow in DOT. Up to `named` inputs stand on it, more are counted."""
        told = [
            f"{name}: {' or '.join(answer_words(protocol, one) for one in sorted(codes))}"
            for name, codes in self.answers.items()
        ]
        kinds = set[tuple[int, ...]]().union(*self.answers.values())
        inputs = quantity(len(told), "input")
        if len(told) <= named:
            label = "\n".join(told)
        elif len(kinds) == 1:
            label = f"{inputs}: {answer_words(protocol, min(kinds))}"
        else:
            label = f"{inputs}, {quantity(len(kinds), 'answer')}"
        label = f"{look}, {label}" if look else label
        if self.differing and len(told) > named:
            label += "".join(f"\n{name} differs" for name in self.differing)
        red = ' color="#c62828" fontcolor="#c62828"' if self.differing else ""
        words = f"label={_quoted(label)} tooltip={_quoted(chr(10).join(told))}{red}"
        return f"{source} -> {target} [{words}];"


def dot_text(
    protocol: Protocol,
    machine: Machine,
    names: Sequence[str],
    title: str,
    differing: Collection[tuple[int, int]] = (),
) -> str:
    """The machine in DOT, the language of Graphviz.

    `names` are the inputs in words. A state is named after what is seen in it. Transitions with the
    same source, target and look are one arrow, with the number of its inputs and answers. A tooltip
    tells each input of an arrow, and a shortest way to a state. `differing` are the transitions
    (state, input) to be drawn in red.
    """
    labels = state_words(machine)
    lines = _head(title)
    if len(labels) > LARGE:
        lines.append(_AT_ONCE)
    for state, (words, access) in enumerate(zip(labels, machine.access(), strict=True)):
        way = ", ".join(names[letter] for letter in access) or "homed"
        lines.append(f"{state} [label={_quoted(words)} tooltip={_quoted(way)}];")
    for source, row in enumerate(machine.states):
        arrows: dict[tuple[int, str], _Arrow] = {}
        for letter, (target, output) in enumerate(row):
            arrow = arrows.setdefault((target, output.look_words), _Arrow())
            arrow.add(names[letter], output.codes, (source, letter) in differing)
        for (target, look), arrow in arrows.items():
            unseen = "" if labels[target].endswith(look) else look
            lines.append(arrow.line(protocol, source, target, unseen, named=1))
    return "\n".join([*lines, "}", ""])


def overview_text(
    protocol: Protocol,
    machine: Machine,
    names: Sequence[str],
    title: str,
    differing: Collection[tuple[int, int]] = (),
) -> str:
    """The kinds of motion of a machine in DOT, each with the number of its states.

    The arrows tell which inputs lead from one kind to another, in some state at least. The
    arguments are those of `dot_text`, which draws every state.
    """
    words = [
        min(seen) if len(seen) == 1 else ""
        for seen in _seen(machine, lambda output: output.motion_words)
    ]
    kinds = list(dict.fromkeys(words))
    lines = _head(title)
    for number, kind in enumerate(kinds):
        size = quantity(words.count(kind), "state")
        label = f"{kind or 'its motion is not seen'}\n{size}"
        lines.append(f"{number} [label={_quoted(label)}];")
    arrows: dict[tuple[int, int], _Arrow] = {}
    for source, row in enumerate(machine.states):
        for letter, (target, output) in enumerate(row):
            ends = kinds.index(words[source]), kinds.index(words[target])
            arrow = arrows.setdefault(ends, _Arrow())
            arrow.add(names[letter], output.codes, (source, letter) in differing)
    for (start, end), arrow in arrows.items():
        lines.append(arrow.line(protocol, start, end, "", named=_NAMED))
    return "\n".join([*lines, "}", ""])


def _head(title: str) -> list[str]:
    return [
        f"digraph {_quoted(title)} {{",
        'rankdir=LR; node [shape=box style=rounded fontname="sans-serif"];',
        'edge [fontname="sans-serif" fontsize=10];',
        'start [shape=point]; start -> 0 [tooltip="homed"];',
    ]


def state_words(machine: Machine) -> tuple[str, ...]:
    """Each state in words: its number, and what is seen on every way into it."""
    numbered = enumerate(_seen(machine, lambda output: output.look_words))
    return tuple(
        f"{i}: {min(seen)}" if len(seen) == 1 and min(seen) else str(i) for i, seen in numbered
    )


def _seen(machine: Machine, words: Callable[[Output], str]) -> list[set[str]]:
    """For each state what is seen on the ways into it, in words."""
    seen: list[set[str]] = [set() for _ in machine.states]
    for row in machine.states:
        for target, output in row:
            seen[target].add(words(output))
    return seen


def _quoted(text: str) -> str:
    """Text as a label of its own lines; Graphviz takes & for the beginning of an entity."""
    lines = (escape_controls(line).replace("\\", "\\\\") for line in text.split("\n"))
    return '"' + "\\n".join(lines).replace('"', '\\"').replace("&", "&amp;") + '"'


def has_graphviz() -> bool:
    """Whether the program `dot` of Graphviz is installed."""
    return shutil.which("dot") is not None


def svg_text(dot: str) -> str:
    """The picture of a DOT text as SVG. Raises DrawingError."""
    try:
        done = subprocess.run(
            ["dot", "-Tsvg"], input=dot.encode(), capture_output=True, timeout=_PATIENCE, check=True
        )
    except (OSError, subprocess.SubprocessError) as error:
        raise DrawingError(f"Graphviz's dot did not draw the machine: {error}") from error
    return done.stdout.decode()
