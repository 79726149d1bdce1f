"""Draws a machine: DOT text, and SVG where Graphviz is installed."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

from bilprov.captures.text import quantity
from bilprov.conformance.learning.machine import Machine
from bilprov.conformance.oracle.wording import answer_words
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

_PATIENCE = 300  # s that Graphviz may take
_LARGE = 12  # states; dot would polish the layout of more for minutes
_AT_ONCE = "nslimit=1; nslimit1=1; mclimit=0.1; splines=line;"


class DrawingError(UserError):
    """Graphviz did not draw the machine. One sentence."""


@dataclass(slots=True)
class _Edge:
    """The transitions from one state to another with the same look, drawn as one arrow."""

    names: list[str] = field(default_factory=list)
    answers: list[tuple[int, ...]] = field(default_factory=list)
    differs: bool = False


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
    lines = [
        f"digraph {_quoted(title)} {{",
        'rankdir=LR; node [shape=box style=rounded fontname="sans-serif"];',
        'edge [fontname="sans-serif" fontsize=10];',
        'start [shape=point]; start -> 0 [tooltip="homed"];',
    ]
    if len(labels) > _LARGE:
        lines.append(_AT_ONCE)
    for state, (words, access) in enumerate(zip(labels, machine.access(), strict=True)):
        way = ", ".join(names[letter] for letter in access) or "homed"
        lines.append(f"{state} [label={_quoted(words)} tooltip={_quoted(way)}];")
    for source, row in enumerate(machine.states):
        edges: dict[tuple[int, str], _Edge] = {}
        for letter, (target, output) in enumerate(row):
            edge = edges.setdefault((target, output.look_words), _Edge())
            edge.names.append(f"{names[letter]}: {answer_words(protocol, output.codes)}")
            edge.answers.append(output.codes)
            edge.differs = edge.differs or (source, letter) in differing
        for (target, look), edge in edges.items():
            label = _label(protocol, edge, "" if labels[target].endswith(look) else look)
            red = ' color="#c62828" fontcolor="#c62828"' if edge.differs else ""
            tooltip = "\n".join(edge.names)
            words = f"label={_quoted(label)} tooltip={_quoted(tooltip)}{red}"
            lines.append(f"{source} -> {target} [{words}];")
    return "\n".join([*lines, "}", ""])


def state_words(machine: Machine) -> tuple[str, ...]:
    """Each state in words: its number, and what is seen on every way into it."""
    looks: list[set[str]] = [set() for _ in machine.states]
    for row in machine.states:
        for target, output in row:
            looks[target].add(output.look_words)
    numbered = enumerate(looks)
    return tuple(
        f"{i}: {min(seen)}" if len(seen) == 1 and min(seen) else str(i) for i, seen in numbered
    )


def _label(protocol: Protocol, edge: _Edge, look: str) -> str:
    """The few words of an arrow: one input with its answer, else how many there are."""
    kinds = dict.fromkeys(edge.answers)
    if len(edge.names) == 1:
        name, _, answer = edge.names[0].partition(": ")
        words = f"{name}: {answer}"
    elif len(kinds) == 1:
        words = f"{quantity(len(edge.names), 'input')}: {answer_words(protocol, edge.answers[0])}"
    else:
        words = f"{quantity(len(edge.names), 'input')}, {quantity(len(kinds), 'answer')}"
    return f"{look}, {words}" if look else words


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{escaped}"'


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
