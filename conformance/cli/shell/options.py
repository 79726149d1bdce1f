"""The options of `bilprov send`, for items and for what is typed."""

from __future__ import annotations

from typing import Literal

import click
import msgspec

from bilprov.analyzer.cli.command import argument, flag, group, option
from bilprov.analyzer.cli.options import (
    SendingLineOptions,
    max_drive_option,
    only_reading_option,
    timeout_option,
    yes_option,
)
from bilprov.analyzer.cli.settings import PortName
from bilprov.analyzer.client.probes import PROBES


class SendOptions(msgspec.Struct, frozen=True):
    """The options of `send`."""

    target: str = argument(metavar="PORT|sim", type=PortName())
    items: tuple[str, ...] = argument(nargs=-1, metavar="[ITEM]...")
    together: bool = flag("Send the ITEMs without waiting for the answers.")
    unhomed: bool = flag(
        "Do not home the device first: what is sent is the first that it gets since it was "
        "switched on."
    )
    expectations: tuple[str, ...] = option(
        "--expect",
        multiple=True,
        metavar="ANSWER,...",
        help="The answer to each ITEM, in order: names or numbers, none for no answer. "
        "Exit code 0 if exactly these come, else 1.",
    )
    style: Literal["lines", "jsonl"] = option(
        "--format", type=click.Choice(["lines", "jsonl"]), default="lines"
    )
    probe: str | None = option(
        help=f"What sees the robot: {', '.join(PROBES)} (the default for a "
        "port) or sim (the target sim's own). What it sees is shown after each ITEM; with "
        "--together, once."
    )
    yes: bool = yes_option()
    only_reading: bool = only_reading_option()
    max_drive: float = max_drive_option()
    wait: bool = flag(
        "With ITEMs: wait for a port that is not there yet, and for one that is unplugged "
        "meanwhile."
    )
    line: SendingLineOptions = group(SendingLineOptions)
    truncation_timeout: float | None = timeout_option()
