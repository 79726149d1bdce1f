"""The line at the bottom where a filter is typed, with completions or its error under it."""

from __future__ import annotations

from collections.abc import Callable
from os.path import commonprefix
from typing import ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.widgets import Input, Static

from bilprov.analyzer.filters.completion import Completion, completions
from bilprov.analyzer.filters.filter import Filter, compile_filter
from bilprov.analyzer.filters.parts import FilterError
from bilprov.captures.text import printable
from bilprov.spec.protocol import Protocol

LINES = 2


class FilterInput(Input):
    """One line of text: Tab completes the word before the cursor, Enter submits it.

    `submit` is called while Enter is handled, so that no key typed behind it comes first.
    """

    BINDINGS: ClassVar[list[BindingType]] = [Binding("tab", "complete", show=False)]

    def __init__(
        self, complete: Callable[[str, int], list[Completion]], submit: Callable[[str], None]
    ) -> None:
        super().__init__(compact=True, select_on_focus=False, id="filter")
        self._complete = complete
        self._submit = submit
        self._offered: list[Completion] = []
        self._at = 0
        self._made = ""
        self._behind = ""

    async def action_submit(self) -> None:
        """Submit the line."""
        self._submit(self.value.strip())

    def action_complete(self) -> None:
        """Write what all completions begin with; where that is written, each one in turn."""
        text, cursor = self.value, self.cursor_position
        if not (self._offered and text == self._made):
            self._offered, self._behind = self._complete(text, cursor), text[cursor:]
            self._at = -1
        if not self._offered:
            return
        start = self._offered[0].start
        common = _common([offered.text for offered in self._offered])
        if self._at < 0 and len(common) > cursor - start:
            word, self._offered = common, self._offered if len(self._offered) > 1 else []
        else:
            self._at = (self._at + 1) % len(self._offered)
            word = self._offered[self._at].text
        self._made = text[:start] + word + self._behind
        self.value = self._made
        self.cursor_position = start + len(word)


class FilterPrompt(Vertical):
    """Asks for a filter; it is hidden until `ask` is called.

    `given` is called with a filter and its text ("" and None for none), `left` where it was left
    without one.
    """

    DEFAULT_CSS = """
    FilterPrompt { height: 2; display: none; }
    FilterPrompt Horizontal { height: 1; }
    FilterPrompt .slash { width: 9; height: 1; }
    FilterPrompt Input { width: 1fr; height: 1; border: none; padding: 0; }
    FilterPrompt #help-line { height: 1; }
    """

    def __init__(
        self,
        protocol: Protocol,
        start_wall: int,
        given: Callable[[str, Filter | None], None],
        left: Callable[[], None],
    ) -> None:
        super().__init__(id="prompt")
        self._protocol = protocol
        self._start_wall = start_wall
        self._given, self._left = given, left
        self._input = FilterInput(lambda text, at: completions(text, at, protocol), self._submit)
        self._under = Static(id="help-line", markup=False)

    def compose(self) -> ComposeResult:
        """The line to type in, and the one under it."""
        with Horizontal():
            yield Static("filter / ", classes="slash", markup=False)
            yield self._input
        yield self._under

    def ask(self, text: str) -> None:
        """Show the prompt with a text to change."""
        self.display = True
        self._input.value = text
        self._input.cursor_position = len(text)
        self.screen.set_focus(self._input)
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

    def _submit(self, text: str) -> None:
        """Give the filter, if it is one."""
        try:
            test = self._compiled(text) if text else None
        except FilterError as error:
            self._refuse(error)
            return
        self.display = False
        self._given(text, test)

    def _tell(self, text: str) -> None:
        """Say what may come next, or what the filter lacks."""
        if not text.strip():
            self._under.update(Text("Tab completes, Enter filters, Esc goes back", "dim"))
            return
        offered = completions(text, self._input.cursor_position, self._protocol)
        words = Text(printable("  ".join(one.text for one in offered)), "dim", no_wrap=True)
        begun = any(one.start < len(text) for one in offered)  # a word that can be gone on with
        try:
            self._compiled(text)
        except FilterError as error:
            if begun:
                self._under.update(words)
            else:
                self._refuse(error)
            return
        self._under.update(words if begun else Text("Enter filters", "dim"))

    def _compiled(self, text: str) -> Filter:
        return compile_filter(text, self._protocol).started(self._start_wall)

    def _refuse(self, error: FilterError) -> None:
        self._under.update(Text(printable(error.sentence), "red", no_wrap=True))


def _common(words: list[str]) -> str:
    """What all words begin with, in any case."""
    return words[0][: len(commonprefix([word.lower() for word in words]))]  # noqa: RUF071 - no paths
