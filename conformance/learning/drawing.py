"""Draws a machine by its kinds of motion: DOT text, and SVG by Graphviz.

AALpy's own drawing has a node for each state and an arrow for each input: some thousand for a
robot, which nobody can read.
"""

from __future__ import annotations

import shutil
import subprocess
from collections import defaultdict
from collections.abc import Collection, Sequence

from bilprov.captures.text import escape_controls, quantity
from bilprov.conformance.learning.reference import Output
from bilprov.conformance.machines.wp_method import Mealy, state_cover
from bilprov.conformance.oracle.judge import answer_words
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

_PATIENCE = 300  # s that Graphviz may take
_NAMED = 3  # inputs that are named on an arrow
_HEAD = """rankdir=LR; node [shape=box style=rounded fontname="sans-serif"];
edge [fontname="sans-serif" fontsize=10];
start [shape=point]; start -> 0 [tooltip="homed"];"""
_RED = 'color="#c62828" fontcolor="#c62828"'


class DrawingError(UserError):
    """Graphviz did not draw the machine. One sentence."""


def dot_text(
    protocol: Protocol,
    machine: Mealy[Output],
    names: Sequence[str],
    title: str,
    differing: Collection[tuple[int, int]] = (),
) -> str:
    """The machine in DOT, the language of Graphviz.

    `names` are the inputs in words. A node is a kind of motion with the number of its states.
    Transitions between the same nodes are one arrow, whose tooltip says what each input gives; that
    of a node is a shortest way to it. `differing` are the transitions (state, input) to be drawn in
    red.
    """
    labels = _kinds(machine)
    nodes = list(dict.fromkeys(labels))
    lines = [f"digraph {_quoted(title)} {{", _HEAD]
    for number, label in enumerate(nodes):
        states = quantity(labels.count(label), "state")
        way = state_cover(machine)[labels.index(label)]
        words = f"{label or 'its motion is not seen'}\n{states}"
        tooltip = ", ".join(names[letter] for letter in way) or "homed"
        lines.append(f"{number} [label={_quoted(words)} tooltip={_quoted(tooltip)}];")
    arrows: dict[tuple[int, int], dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    red: dict[tuple[int, int], dict[str, None]] = defaultdict(dict)
    for source, (targets, outputs) in enumerate(zip(machine.targets, machine.outputs, strict=True)):
        for letter, (target, output) in enumerate(zip(targets, outputs, strict=True)):
            ends = nodes.index(labels[source]), nodes.index(labels[target])
            arrows[ends][names[letter]].add(answer_words(protocol, output.codes))
            if (source, letter) in differing:
                red[ends][names[letter]] = None
    for ends, answers in arrows.items():
        lines.append(_arrow(*ends, answers, red[ends]))
    return "\n".join([*lines, "}", ""])


def _arrow(source: int, target: int, answers: dict[str, set[str]], red: Collection[str]) -> str:
    """An arrow in DOT. A few inputs stand on it, more are counted."""
    each = [f"{name}: {' or '.join(sorted(words))}" for name, words in answers.items()]
    kinds = set[str]().union(*answers.values())
    label = "\n".join(each)
    if len(each) > _NAMED:
        all_alike = f": {min(kinds)}" if len(kinds) == 1 else f", {quantity(len(kinds), 'answer')}"
        label = quantity(len(each), "input") + all_alike
        label += "".join(f"\n{name} differs" for name in red)
    words = f"label={_quoted(label)} tooltip={_quoted(chr(10).join(each))}"
    return f"{source} -> {target} [{words}{' ' + _RED if red else ''}];"


def _kinds(machine: Mealy[Output]) -> list[str]:
    """The kind of motion that is seen on every way into each state, "" for none."""
    seen: list[set[str]] = [set() for _ in machine.targets]
    for targets, outputs in zip(machine.targets, machine.outputs, strict=True):
        for target, output in zip(targets, outputs, strict=True):
            seen[target].add(output.motion_words)
    return [min(ways) if len(ways) == 1 else "" for ways in seen]


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
