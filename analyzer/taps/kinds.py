"""The kinds of taps that the command line names, and the one that a user has chosen."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from bilprov.analyzer.taps.bridge import Bridge
from bilprov.analyzer.taps.passive import open_taps
from bilprov.analyzer.taps.source import Source
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.ports import open_port


class Tap(NamedTuple):
    """A kind of tap: the option that asks for it, the option's metavar and help, and its opener.

    The kind whose `option` is empty takes the command's arguments. `opened` gets the names of the
    ports, one for an option. It raises ValueError for wrong use, LinkError for a port that cannot
    be opened.
    """

    option: str
    metavar: str
    help: str
    opened: Callable[[Sequence[str], LineSettings], Source]

    @property
    def usage(self) -> str:
        """How the tap is asked for on the command line."""
        return f"--{self.option} {self.metavar}" if self.option else self.metavar


TAPS = (
    Tap("", "HOST [DEVICE]", "", lambda names, settings: open_taps(settings, *names)),
    Tap(
        "bridge",
        "PORT",
        "Instead of taps: sit between. Prints a pty's name.",
        lambda names, settings: Bridge(open_port(names[0], settings)),
    ),
)


def opened_tap(given: Mapping[str, Sequence[str | None]], settings: LineSettings) -> Source:
    """Open the tap that was asked for; `given` are the names of ports by option, None for none.

    Raises ValueError, in one sentence, if not exactly one kind was asked for, and what opening it
    raises.
    """
    ports = {
        option: [name for name in names if name is not None] for option, names in given.items()
    }
    asked = [tap for tap in TAPS if ports[tap.option]]
    usages = " or ".join(tap.usage for tap in TAPS)
    if not asked:
        raise ValueError(f"what is to be sniffed? Give {usages}")
    if len(asked) > 1:
        raise ValueError(f"give either {usages}, not both")
    return asked[0].opened(ports[asked[0].option], settings)
