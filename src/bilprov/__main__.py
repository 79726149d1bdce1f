"""The command: `bilprov` or `python -m bilprov`. Each subcommand is imported when it is called."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module

import click
from click import exceptions
from click.core import ParameterSource

from bilprov.analyzer.former_names import former_name
from bilprov.analyzer.grammar_name import GrammarName
from bilprov.analyzer.output.help import HELP_NAMES, Group
from bilprov.analyzer.transport.signals import exit_status, interrupts_kept
from bilprov.analyzer.version import kit_version


class Row(click.Command):
    """The line of a command in the lists: its module in the `cli` of a room, and what it does.

    That is the first sentence of its help, and the docstring of its function is the rest.
    """

    def __init__(self, place: str, help: str) -> None:
        super().__init__(None, help=help)
        self.place = place


class Tree(Group):
    """A group that lists its commands without importing them; imports the one that is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The name of every command directly below, in the order of the table."""
        path = _path(ctx)
        names = (name.removeprefix(path) for name in COMMANDS if name.startswith(path))
        return [name for name in names if " " not in name]

    def panels(self, ctx: click.Context) -> Mapping[str, Sequence[str]]:
        """The commands of each panel, in the order of the table."""
        return super().panels(ctx) if ctx.parent else PANELS

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """A group, or only the command's line in the list: its name and one sentence."""
        return None if " " in cmd_name else COMMANDS.get(_path(ctx) + cmd_name)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command itself, imported now. Raises UsageError where there is none."""
        path = _path(ctx)
        args = args if path else _meant(ctx, args)
        try:
            name, command, rest = super().resolve_command(ctx, args)
        except exceptions.NoSuchCommand as error:
            names = self.list_commands(ctx)
            if not path:
                raise exceptions.NoSuchCommand(args[0], possibilities=names, ctx=ctx) from error
            there = f"there is no bilprov {path}{args[0]}; there are {', '.join(names)}"
            raise click.UsageError(there) from error
        if name is None or command is None:  # completion asks for what does not exist
            return name, command, rest
        if isinstance(command, Row):
            place, help = command.place.replace(".", ".cli."), command.help
            command = getattr(import_module(f"bilprov.{place}"), name)
            command.short_help = help
        if not any(param.name == "grammar" for param in command.params):
            command.params.append(_grammar_option("Use another grammar; see bilprov --help."))
        if not any(word in rest for word in HELP_NAMES):
            from bilprov.analyzer.cli.settings import read_settings, use_settings

            use_settings(ctx, command, path + name, read_settings(COMMANDS))
        return name, command, rest


def _path(ctx: click.Context) -> str:
    """How the names begin of the commands in a group: the words of the group."""
    return " ".join([*ctx.command_path.split()[1:], ""])


@click.command(cls=Tree)
def capture() -> None:
    """Show, check, cut, join, repair and compare captures.

    Examples:
      bilprov capture info drive.mcap
      bilprov capture cut drive.mcap part.mcap --start 12 --end 20
    """


@click.command(cls=Tree)
def lab() -> None:
    """Score the suite, learn devices, impair lines.

    Examples:
      bilprov lab learn sim --svg machine.svg
      bilprov lab line --drop 1e-4 /dev/ttyUSB0 pty
    """


@click.command(cls=Tree)
def spec() -> None:
    """Show the protocol, its readings and errata; write it for other programs.

    Examples:
      bilprov spec show
      bilprov spec emit wireshark -o robot.lua
    """


@click.command(cls=Tree)
def emit() -> None:
    """Write the grammar in use for other programs, or as it is.

    Examples:
      bilprov spec emit c -o protocol.h
      bilprov spec emit grammar -o mine.py
    """


PANELS = {
    "Analyze": ["sniff", "replay", "stats", "plot", "export", "capture"],
    "Drive": ["ports", "send"],
    "Test": ["conform", "recheck", "report", "simulate", "lab"],
    "Protocol": ["decode", "explain", "encode", "spec"],
    "Settings": ["config", "completion"],
}
"""The panels in the list of commands, each with the names of its commands."""

COMMANDS: dict[str, Row | Tree] = {
    "sniff": Row("analyzer.sniff", "Listen to a line, decode and log it."),
    "replay": Row("analyzer.replay", "Look through a capture on a screen, or play it again."),
    "stats": Row("analyzer.stats", "Count frames, answers and faults in captures."),
    "plot": Row("analyzer.stats", "Draw a capture over time, as a page."),
    "export": Row("analyzer.stats", "Write the contents of a capture for other programs."),
    "capture": capture,
    "capture info": Row("analyzer.capture", "Show what a capture holds."),
    "capture cut": Row("analyzer.capture", "Write a part of a capture."),
    "capture join": Row(
        "analyzer.capture", "Join captures by the time of day at which their bytes arrived."
    ),
    "capture check": Row("analyzer.capture", "Report damaged and lost parts of a capture."),
    "capture repair": Row("analyzer.capture", "Write the intact parts of a damaged capture."),
    "capture decode": Row("analyzer.capture", "Write a capture with everything decoded from it."),
    "capture diff": Row("analyzer.capture", "Show where two captures differ."),
    "ports": Row("analyzer.ports", "List serial ports, or examine those you name."),
    "send": Row("conformance.send", "Send instructions or bytes to a device, or drive it by hand."),
    "conform": Row(
        "conformance.conform", "Test a device against the document: answers, stops, state."
    ),
    "recheck": Row("conformance.report", "Judge a recorded run again, from its bytes alone."),
    "report": Row("conformance.report", "Show and compare runs, from what conform --json wrote."),
    "simulate": Row("conformance.simulate", "Serve a simulated device, or firmware."),
    "lab": lab,
    "lab score": Row("conformance.score", "Score the suite against faulty devices."),
    "lab learn": Row("conformance.learn", "Learn a device as a Mealy machine."),
    "lab line": Row("analyzer.line", "Connect two ends through an impaired line."),
    "decode": Row("analyzer.decode", "Decode bytes from hex, a file, a capture or a pipe."),
    "explain": Row("analyzer.decode", "Explain bytes, bit by bit."),
    "encode": Row("analyzer.decode", "Build the bytes of an instruction."),
    "spec": spec,
    "spec show": Row("analyzer.spec", "Show the grammar in use."),
    "spec grammars": Row("analyzer.spec", "List the grammars that the kit has."),
    "spec check": Row("analyzer.spec", "Report how much of recorded bytes a grammar decodes."),
    "spec readings": Row("analyzer.spec", "Show how the document is read where it is silent."),
    "spec errata": Row("analyzer.spec", "Show where the document contradicts itself."),
    "spec emit": emit,
    "spec emit c": Row("analyzer.spec", "A C header, for firmware and hosts."),
    "spec emit wireshark": Row("analyzer.spec", "A dissector for Wireshark and tshark."),
    "spec emit stub": Row("analyzer.spec", "The instructions as typed methods, for Python."),
    "spec emit grammar": Row("analyzer.spec", "The text of a grammar, to be changed."),
    "config": Row("analyzer.config", "Show the settings in force."),
    "completion": Row("analyzer.config", "Print a shell's completion script."),
}
"""Every command by its name, those of a group behind the group's name; `help` is not listed."""


def _use_grammar(ctx: click.Context, param: click.Parameter, path: str | None) -> None:
    """Use a grammar from here on, the last one where several are named."""
    if path is not None:
        from bilprov.analyzer.cli.command import TYPED_GRAMMAR

        ctx.find_root().params["grammar"] = ctx.obj = path
        ctx.meta[TYPED_GRAMMAR] = ctx.get_parameter_source("grammar") is ParameterSource.COMMANDLINE


def _grammar_option(help: str) -> click.Option:
    return click.Option(
        ["--grammar"],
        metavar="NAME|FILE.py",
        type=GrammarName(readable=False),
        is_eager=True,
        expose_value=False,
        callback=_use_grammar,
        help=help,
    )


def _meant(ctx: click.Context, args: list[str]) -> list[str]:
    """The arguments with the command that they mean: `help` is none, nor is a capture's name.

    Raises UsageError, in one sentence, for the former name of a command.
    """
    first = args[0]
    if first in COMMANDS:
        return args
    if renamed := former_name(first):
        raise click.UsageError(renamed)
    if first != "help":
        is_file = os.path.isfile(first)  # noqa: PTH113 - Path's may raise
        return ["replay", *args] if is_file or first.endswith(".mcap") else args
    words = [word for word in args if word not in ("help", *HELP_NAMES)]
    if not words and not ctx.resilient_parsing:
        click.echo(ctx.get_help())
        ctx.exit()
    return [*words, "--help"]


@click.command(
    cls=Tree,
    params=[
        _grammar_option(
            "Another protocol, before or after the command: a name (bilprov spec grammars) or a "
            "file of your own (docs/your-own-protocol.md). Runs the file as Python: name only "
            "files that you trust; a grammar inside a capture is only read."
        )
    ],
)
@click.version_option(kit_version(), message="bilprov %(version)s")
def front_door(grammar: str | None = None) -> None:
    """Protocol analyzer and conformance kit for the robot-car serial protocol.

    Examples:
      bilprov sniff sim
      bilprov conform sim --fault no-stop-on-bad-data
      bilprov help conform

    A capture needs no command: bilprov drive.mcap opens it. Exit codes: 0 fine, 1 the device does
    not conform, 2 wrong use or nothing to work with, 3 nothing failed but something could not be
    judged.
    """


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command with `arguments` (the process's own by default) and end the process."""
    from bilprov.analyzer.cli.streams import report, standard_streams

    # Hardly anything here becomes garbage in cycles, which Python would look for at every turn.
    gc.set_threshold(50_000, 20, 50)
    # The threads that numpy would begin with are for matrices, and take longer than its import.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with interrupts_kept(), standard_streams() as settled:
        try:
            status = settled(_run(list(sys.argv[1:] if arguments is None else arguments)))
        except BaseException as error:
            status = settled(report(error))
    sys.exit(exit_status(status))


def _run(arguments: list[str]) -> int:
    """Run a subcommand. Its exit code is what it returns or exits with, 0 where it says nothing."""
    if asked := os.environ.get("_BILPROV_COMPLETE"):
        from bilprov.analyzer.cli.config import answer

        return answer(front_door, asked)
    try:
        with front_door.make_context("bilprov", arguments) as context:
            result = front_door.invoke(context)
    except exceptions.Exit as stop:
        return stop.exit_code
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 2 if stop.code else 0
    return result if type(result) is int else 0


if __name__ == "__main__":
    main()
