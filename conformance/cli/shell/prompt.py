"""The prompt on a terminal: completion, history, the state; unasked bytes come out above it.

What is typed is completed: instructions, their fields, and words.
"""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Iterable, Iterator, Mapping

from prompt_toolkit import PromptSession
from prompt_toolkit.application import get_app
from prompt_toolkit.completion import CompleteEvent, Completer, Completion
from prompt_toolkit.document import Document
from prompt_toolkit.formatted_text import StyleAndTextTuples
from prompt_toolkit.key_binding import KeyBindings
from prompt_toolkit.patch_stdout import patch_stdout

from bilprov.analyzer.cli.options import note
from bilprov.analyzer.cli.typed_input import PAUSE, SEPARATOR
from bilprov.analyzer.transport.signals import SUSPENDING, Stopper
from bilprov.conformance.cli.shell.driving import Driving, seen_words
from bilprov.spec.codec import free_parts
from bilprov.spec.protocol import Protocol


def candidates(protocol: Protocol, words: Mapping[str, str], line: str) -> Iterator[Completion]:
    """Yield what may stand at the end of `line`, the text before the cursor.

    `words` are the words that can be typed besides instructions, with their meanings.
    """
    item = line.rpartition(SEPARATOR)[2].lstrip()
    name, space, rest = item.partition(" ")
    if space:
        yield from _of_fields(protocol, name, rest)
        return
    names = {spec.name: spec.prose for spec in protocol.instructions}
    known = {text.lower() for text in names}
    others = {word: meaning for word, meaning in words.items() if word not in known}
    for text, meaning in {**names, **others, PAUSE: "milliseconds"}.items():
        if text.lower().startswith(name.lower()):
            yield Completion(text, -len(name), display_meta=meaning)


def _of_fields(protocol: Protocol, name: str, rest: str) -> Iterator[Completion]:
    """Yield the fields that are not given yet; what their values may be is their meaning."""
    spec = next((s for s in protocol.instructions if s.name.lower() == name.lower()), None)
    if spec is None:
        return
    *given, typed = rest.split(" ")
    taken = {word.partition("=")[0].lower() for word in given}
    own = [field for field in spec.fields if field.constant is None]
    parts = [(field.name, field.allowed_in_short, field.prose) for field in own]
    parts += [(part.name, f"{part.low}..{part.high}", part.prose) for part in free_parts(protocol)]
    for part_name, allowed, prose in parts:
        if part_name.lower().startswith(typed.lower()) and part_name.lower() not in taken:
            yield Completion(f"{part_name}=", -len(typed), display_meta=f"{allowed}, {prose}")


_TURN = 0.05  # s between two looks at the port
_MENU = 5  # lines
# Signals after which the shell goes on: the robot is stopped, and why is told.
_STOPS = {
    signal.SIGINT: "Ctrl-C",
    **dict.fromkeys(SUSPENDING, "the program was suspended, and the robot stopped before that"),
}


class Prompt:
    """Asks for lines on a terminal, and has them done, until the user or a signal ends it."""

    def __init__(self, protocol: Protocol, driving: Driving, stopper: Stopper) -> None:
        self._protocol = protocol
        self._driving = driving
        self._stopper = stopper
        keys = KeyBindings()  # Ctrl-\\ is no signal while a line is typed: it ends the shell as one
        keys.add("c-\\")(lambda event: signal.raise_signal(signal.SIGQUIT))
        self._session: PromptSession[str] = PromptSession(
            self._message,
            completer=_Completer(protocol, driving),
            complete_while_typing=False,
            enable_suspend=True,
            key_bindings=keys,
            reserve_space_for_menu=_MENU,
        )

    def run(self) -> None:
        """Do what is typed. Raises LinkError and ProbeError."""
        while not (self._driving.over or self._stopper.stopped):
            line = self._line()
            if line is None:
                return
            try:
                self._driving.do(line)
            except ValueError as error:
                note(f"{error}; see help")
            self._halt_for(*_STOPS)

    def _line(self) -> str | None:
        """Ask for a line; None at the end of the input."""
        try:
            # The signals stay with the Stopper. An exception must not wait for a key, as
            # prompt_toolkit would have it: the robot may be moving.
            with patch_stdout(raw=True):
                return self._session.prompt(
                    pre_run=self._begin_attending, set_exception_handler=False, handle_sigint=False
                )
        except KeyboardInterrupt:
            return self._interrupted()
        except EOFError:
            # Ctrl-C that came as a signal: just before the prompt, or from another program.
            return self._interrupted() if self._stopper.withdraw(signal.SIGINT) else None

    def _halt_for(self, *signals: signal.Signals) -> None:
        """Stop the robot if one of these has come, and go on."""
        for number in signals:
            if self._stopper.withdraw(number):
                self._driving.halt(_STOPS[number])

    def _interrupted(self) -> str | None:
        """Ctrl-C at the prompt stops the robot; where nothing drives or is typed, it leaves."""
        if self._protocol.directed(self._driving.target.state):
            self._driving.halt("Ctrl-C")
            return ""
        return "" if self._session.default_buffer.text else None

    def _begin_attending(self) -> None:
        get_app().create_background_task(self._attend())

    async def _attend(self) -> None:
        """Attend to the robot while the user types, and end the prompt where that is needed."""
        app = get_app()
        ended: BaseException
        try:
            while True:
                self._halt_for(*SUSPENDING)
                if self._stopper.stopped:
                    break
                before = self._driving.target.state
                self._driving.attend()
                if self._driving.target.state != before:
                    app.invalidate()
                await asyncio.sleep(_TURN)
            ended = EOFError()
        except Exception as error:
            ended = error
        if not app.is_done:
            app.exit(exception=ended)

    def _message(self) -> StyleAndTextTuples:
        state, seen = self._driving.target.state, seen_words(self._driving.look)
        colour = "ansiyellow bold" if self._protocol.directed(state) else "ansigreen"
        return [
            (colour, state.described),
            ("ansicyan", f", {seen}" if seen else ""),
            ("", "> "),
        ]


class _Completer(Completer):
    def __init__(self, protocol: Protocol, driving: Driving) -> None:
        self._protocol = protocol
        self._words = {word: meaning for word, (_, meaning) in driving.words.items()}

    def get_completions(
        self, document: Document, complete_event: CompleteEvent
    ) -> Iterable[Completion]:
        return candidates(self._protocol, self._words, document.text_before_cursor)
