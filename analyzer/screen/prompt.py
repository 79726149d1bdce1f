"""The line at the bottom to type a filter, a place or a name in, with what it lacks under it.

A place in a recording is a row's number, a time since the start, or a time of day.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from os.path import commonprefix
from typing import Any, ClassVar, NamedTuple

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.widgets import Input, Static

from bilprov.analyzer.filters.completion import Completion
from bilprov.analyzer.filters.fields import DAY, STEP, UNITS, instant, offset
from bilprov.analyzer.filters.syntax import FilterError
from bilprov.captures.text import printable


class Question(NamedTuple):
    """What is asked for.

    `label` stands before the line and `hint` under it while it is empty or will do. `read` makes a
    value of a text, or raises ValueError that says why it will not do; `given` takes the value.
    `completions` are the ways to go on at a place of the text.
    """

    label: str
    hint: str
    read: Callable[[str], Any]
    given: Callable[[Any], object]
    completions: Callable[[str, int], list[Completion]] = lambda text, at: []


class Prompt(Vertical):
    """Asks one question at a time; it is hidden until `ask` is called.

    Tab completes the word before the cursor, Enter gives the line, at once, so that no key typed
    behind it comes first. `left` is called when it is hidden again.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("tab", "complete", show=False, priority=True),
        Binding("enter", "give", show=False, priority=True),
    ]

    def __init__(self, left: Callable[[], None]) -> None:
        super().__init__(id="prompt")
        self._left = left
        self._question = Question("", "", str, str)
        # Keys may have been typed by the time that the focus arrives.
        self.line = Input(compact=True, select_on_focus=False, id="line")
        self._label, self._under = Static(id="label", markup=False), Static(markup=False)

    def compose(self) -> ComposeResult:
        """The line to type in, and the one under it."""
        with Horizontal():
            yield self._label
            yield self.line
        yield self._under

    def ask(self, question: Question, text: str, *, replaced: bool = False) -> None:
        """Ask, with a text to change; the first key takes its place where it is `replaced`."""
        self._question = question
        self.display = True
        self._label.update(f"{question.label} ")
        self.line.value = text
        self.line.cursor_position = len(text)
        self.screen.set_focus(self.line)
        if replaced:
            self.line.action_select_all()
        self._tell(text)

    def leave(self) -> None:
        """Hide the prompt."""
        self.display = False
        self._left()

    def on_input_changed(self, event: Input.Changed) -> None:
        """Say what the text lacks, or what it may become."""
        event.stop()
        if self.display:
            self._tell(event.value)

    def action_give(self) -> None:
        """Give the line, if it will do."""
        try:
            value = self._question.read(self.line.value.strip())
        except ValueError as error:
            self._refuse(error)
        else:
            self.leave()
            self._question.given(value)

    def action_complete(self) -> None:
        """Write what all completions begin with."""
        text, cursor = self.line.value, self.line.cursor_position
        offered = self._question.completions(text, cursor)
        if offered:
            start, words = offered[0].start, [one.text for one in offered]
            common = commonprefix([word.lower() for word in words])  # noqa: RUF071 - no paths
            if len(common) > cursor - start or len(words) == 1:
                self.line.value = text[:start] + words[0][: len(common)] + text[cursor:]
                self.line.cursor_position = start + len(common)

    def _tell(self, text: str) -> None:
        """Say what may come next, or what the text lacks."""
        question = self._question
        offered = question.completions(text, self.line.cursor_position) if text.strip() else []
        words = "  ".join(one.text for one in offered)
        if len(offered) == 1:
            words = ": ".join(filter(None, (offered[0].text, offered[0].says)))
        if not any(len(one.text) > len(text) - one.start > 0 for one in offered):
            words = question.hint  # no word goes on
        self._under.update(Text(printable(words), "dim", no_wrap=True))
        if text.strip() and words == question.hint:
            try:
                question.read(text.strip())
            except ValueError as error:
                self._refuse(error)

    def _refuse(self, error: ValueError) -> None:
        wrong = error.sentence if isinstance(error, FilterError) else str(error)
        self._under.update(Text(printable(wrong), "red", no_wrap=True))


_NUMBER = re.compile(r"(?P<number>\d+(?:\.\d*)?) ?(?P<unit>us|ms|s)?")
REFUSAL = "give a row like 120, or a time like 12.5s, 300ms or 14:03:20"


def row_of(text: str, start_wall: int, utc: bool, row_at: Callable[[int], int]) -> int:
    """The row (from 0) that a text stands for. Raises ValueError if it is no place.

    `row_at` gives the row at a time (ns since the start), which is `start_wall` (ns since 1970). A
    time of day is one here, or in UTC, after the start.
    """
    match = _NUMBER.fullmatch(text)
    if match and not match["unit"] and "." not in text:
        return max(0, int(text) - 1)
    if match:
        return row_at(round(float(match["number"]) * 10.0 ** (9 + UNITS[match["unit"] or "s"])))
    moment = instant(text)
    if moment is None:
        raise ValueError(REFUSAL)
    if not moment.daily:
        return row_at(moment.ns - start_wall)
    ahead = 0 if utc else offset(start_wall // STEP)
    return row_at((moment.ns - start_wall - ahead) % DAY)
