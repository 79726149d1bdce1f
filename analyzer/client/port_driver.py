"""Drives a robot on a port of this machine; homes it after opening and on every way out."""

from __future__ import annotations

import math
from contextlib import ExitStack, suppress
from os import PathLike
from typing import Self

from bilprov.analyzer.client.driver import Driver, NoAnswer, RobotError
from bilprov.analyzer.client.wire import PortWire, home_once, stops
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.ports import open_port
from bilprov.analyzer.transport.signals import (
    ending_in_order,
    suspending,
    undisturbed,
)
from bilprov.spec.protocol import Protocol


class PortDriver(Driver):
    """One robot on a port; a context manager that homes it on every way out.

    `url` is a path or any pyserial URL. `grammar` is a grammar file or a Protocol, the kit's own
    unless given; `timeout` how long (ms) an answer may take; `baud` (bits/s), `parity` (N E O M S)
    and `stopbits` (1 1.5 2) are the grammar's unless given.

    Opening sends only stops, until the robot answers, so it starts no motion. It asks for no
    confirmation, since starting the program is the user's consent. Raises LinkError for a port
    that cannot be opened, NoAnswer if the robot does not answer, GrammarError and ValueError for
    wrong use.

    Within `with`, the robot is also homed after Ctrl-C, and after SIGTERM and SIGHUP unless the
    program handles them itself; a second signal waits until homing has ended. Ctrl-Z stops it
    before the program is suspended; once that is continued, RobotError is raised. An exception
    raised in the block is kept; if the robot could not be homed, a note on the exception says so.
    """

    def __init__(
        self,
        url: str,
        *,
        grammar: str | PathLike[str] | Protocol | None = None,
        timeout: float | None = None,
        baud: int | None = None,
        parity: str | None = None,
        stopbits: float | None = None,
    ) -> None:
        if not isinstance(grammar, Protocol):
            grammar = load_protocol(None if grammar is None else str(grammar))
        if timeout is not None and not 0 < timeout < math.inf:
            raise ValueError(f"timeout is {timeout:g}, allowed are milliseconds above 0")
        self._port = open_port(url, line_settings(grammar, baud, parity, stopbits))
        self._open = True
        self._signals = ExitStack()
        try:
            super().__init__(grammar, PortWire(self._port), timeout)
            self.home()
        except BaseException:
            self._port.close()
            raise

    def close(self) -> None:
        """Home the robot and close the port; further calls do nothing.

        Raises NoAnswer if the robot does not answer and LinkError if the line is lost; in both
        cases the robot may still be moving.
        """
        if not self._open:
            return
        with undisturbed(again=True):
            self._open = False
            try:
                if not home_once(self.protocol, self._wire):
                    raise self._nobody()
            finally:
                self._port.close()

    def __enter__(self) -> Self:
        self._signals.enter_context(ending_in_order(self._halt))
        self._signals.enter_context(suspending(self._halt, self._continued))
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        with self._signals:
            try:
                self.close()
            except (RobotError, LinkError) as left:
                if error is None:
                    raise
                error.add_note(f"the robot was not brought to a stop at the end: {left}")

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self._port.name} {self.protocol.name}>"

    def _halt(self) -> None:
        self._in_step = False
        with suppress(LinkError):
            self._port.write(stops(self.protocol))

    def _continued(self) -> None:
        if self._open:
            raise RobotError("the program was suspended, and the robot stopped before that")

    def _nobody(self) -> NoAnswer:
        return NoAnswer(
            f"nobody answers at {self._port.name}; is the robot on, and is it the right port?",
            super()._nobody().frame,
        )
