"""Draws a machine by its kinds of motion: DOT text, and SVG by Graphviz.

AALpy's own drawing has a node for each state and an arrow for each input: some thousand for a
robot, which nobody can read.
"""

from __future__ import annotations

import shutil
import subprocess
from collections import defaultdict
from collections.abc import Collection, Sequence
from itertools import product

from bilprov.captures.text import escape_controls, quantity
from bilprov.conformance.learning.learner import Output
from bilprov.conformance.machines.wp_method import Mealy
from bilprov.conformance.oracle.judge import answer_words
from bilprov.spec.errors import UserError
from bilprov.spec.protocol import Protocol

_PATIENCE = 300  # s that Graphviz may take
_NAMED = 3  # inputs that are named on an arrow
_HEAD = """rankdir=LR; node [shape=box style=rounded fontname="sans-serif"];
edge [fontname="sans-serif" fontsize=10];
start [shape=point]; start -> 0 [tooltip="homed"];"""
_RED = ' color="#c62828" fontcolor="#c62828"'


def dot_text(
    protocol: Protocol,
    machine: Mealy[Output],
    names: Sequence[str],
    title: str,
    differing: Collection[tuple[int, int]] = (),
) -> str:
    """The machine in DOT, the language of Graphviz.

    `names` are the inputs in words. A node is a kind of motion with the number of its states.
    Transitions between the same nodes are one arrow: a few inputs stand on it, more are counted,
    and its tooltip has them all. `differing` are the transitions (state, input) to be drawn in red.
    """
    labels = _kinds(machine)
    nodes = list(dict.fromkeys(labels))
    lines = [f"digraph {_quoted(title)} {{", _HEAD]
    for number, label in enumerate(nodes):
        states = quantity(labels.count(label), "state")
        words = f"{label or 'its motion is not seen'}\n{states}"
        lines.append(f"{number} [label={_quoted(words)}];")
    arrows: dict[tuple[int, int], dict[str, bool]] = defaultdict(dict)
    for state, letter in product(range(len(machine)), machine.inputs):
        target = machine.targets[state][letter]
        answer = answer_words(protocol, machine.outputs[state][letter].codes)
        told = arrows[nodes.index(labels[state]), nodes.index(labels[target])]
        words = f"{names[letter]}: {answer}"
        told[words] = told.get(words, False) or (state, letter) in differing
    for (source, end), told in arrows.items():
        label = "\n".join(told)
        if len(told) > _NAMED:
            red = [words for words, differs in told.items() if differs]
            label = "\n".join([quantity(len(told), "input"), *red])
        style = _RED if any(told.values()) else ""
        tooltip = _quoted("\n".join(told))
        lines.append(f"{source} -> {end} [label={_quoted(label)} tooltip={tooltip}{style}];")
    return "\n".join([*lines, "}", ""])


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
    """The picture of a DOT text as SVG. Raises UserError where Graphviz fails."""
    try:
        done = subprocess.run(
            ["dot", "-Tsvg"], input=dot.encode(), capture_output=True, timeout=_PATIENCE, check=True
        )
    except (OSError, subprocess.SubprocessError) as error:
        raise UserError(f"Graphviz's dot did not draw the machine: {error}") from error
    return done.stdout.decode()
