"""The command: `bilprov` or `python -m bilprov`. Each subcommand is imported when it is called."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any, NamedTuple

import click
from click import exceptions

from bilprov.analyzer.former_names import former_name
from bilprov.analyzer.output.help import HELP_NAMES, Group
from bilprov.analyzer.transport.ending import exit_status


class Row(NamedTuple):
    """One command: its panel in the help, where it lives, its line in the list of commands.

    A group of commands lives nowhere: its commands are the rows whose names begin with its own.
    Then the help is all of its page.
    """

    panel: str
    module: str
    attribute: str
    help: str


ANALYZER, CONFORMANCE = "bilprov.analyzer.cli", "bilprov.conformance.cli"
COMMANDS = {
    "sniff": Row("Analyze", f"{ANALYZER}.sniff", "sniff", "Listen to a line, decode and log it."),
    "replay": Row(
        "Analyze", f"{ANALYZER}.replay", "replay", "Look through a capture, or play it again."
    ),
    "stats": Row(
        "Analyze", f"{ANALYZER}.stats", "stats", "Count frames, answers and faults in captures."
    ),
    "plot": Row("Analyze", f"{ANALYZER}.plot", "plot", "Draw a capture over time, as a page."),
    "export": Row("Analyze", f"{ANALYZER}.export", "export", "Write a capture for other programs."),
    "capture": Row(
        "Analyze",
        "",
        "",
        """Show, check, cut, join, repair and compare captures.

        Examples:
          bilprov capture info drive.mcap
          bilprov capture cut drive.mcap part.mcap --start 12 --end 20
        """,
    ),
    "capture info": Row("", f"{ANALYZER}.capture", "info", "Show what a capture holds."),
    "capture cut": Row("", f"{ANALYZER}.capture", "cut", "Write a part of a capture."),
    "capture join": Row("", f"{ANALYZER}.capture", "join", "Join captures by time."),
    "capture check": Row(
        "", f"{ANALYZER}.capture", "check", "Report damaged and lost parts of a capture."
    ),
    "capture repair": Row(
        "", f"{ANALYZER}.capture", "repair", "Write the intact parts of a damaged capture."
    ),
    "capture decode": Row(
        "", f"{ANALYZER}.capture", "decode", "Write a capture with everything decoded from it."
    ),
    "capture diff": Row("", f"{ANALYZER}.capture", "diff", "Show where two captures differ."),
    "ports": Row(
        "Drive", f"{ANALYZER}.ports", "ports", "List serial ports, or examine those you name."
    ),
    "send": Row(
        "Drive",
        f"{CONFORMANCE}.send",
        "send",
        "Send instructions to a device, or drive it by hand.",
    ),
    "conform": Row("Test", f"{CONFORMANCE}.conform", "conform", "Run the suite against a device."),
    "recheck": Row("Test", f"{CONFORMANCE}.recheck", "recheck", "Judge a recorded run again."),
    "report": Row("Test", f"{CONFORMANCE}.report", "report", "Show and compare past runs."),
    "merge": Row(
        "Test", f"{CONFORMANCE}.merge", "merge_reports", "Merge the reports of shards into one."
    ),
    "simulate": Row(
        "Test", f"{CONFORMANCE}.simulate", "simulate", "Serve a simulated device, or firmware."
    ),
    "lab": Row(
        "Test",
        "",
        "",
        """Score the suite, learn devices, impair lines.

        Examples:
          bilprov lab learn sim --svg machine.svg
          bilprov lab line --drop 1e-4 /dev/ttyUSB0 pty
        """,
    ),
    "lab score": Row(
        "", f"{CONFORMANCE}.score", "score_suite", "Score the suite against faulty devices."
    ),
    "lab learn": Row("", f"{CONFORMANCE}.learn", "learn", "Learn a device as a state machine."),
    "lab line": Row("", f"{ANALYZER}.line", "line", "Connect two ends through an impaired line."),
    "decode": Row(
        "Protocol", f"{ANALYZER}.decode", "decode", "Decode bytes from hex, a file or a capture."
    ),
    "explain": Row(
        "Protocol", f"{ANALYZER}.text_commands", "explain", "Explain bytes, bit by bit."
    ),
    "encode": Row(
        "Protocol", f"{ANALYZER}.text_commands", "encode", "Build the bytes of an instruction."
    ),
    "spec": Row(
        "Protocol",
        "",
        "",
        """Show the protocol, its readings and errata; write it for other programs.

        Examples:
          bilprov spec show
          bilprov spec emit wireshark -o robot.lua
        """,
    ),
    "spec show": Row("", f"{ANALYZER}.spec", "spec_show", "Show the grammar in use."),
    "spec readings": Row(
        "", f"{ANALYZER}.spec", "spec_readings", "Show how the document is read where it is silent."
    ),
    "spec errata": Row(
        "", f"{ANALYZER}.spec", "spec_errata", "Show where the document contradicts itself."
    ),
    "spec emit": Row(
        "",
        "",
        "",
        """Write the grammar in use for other programs, or as it is.

        Examples:
          bilprov spec emit c -o protocol.h
          bilprov spec emit grammar -o mine.py
        """,
    ),
    "spec emit c": Row(
        "", f"{ANALYZER}.spec", "spec_emit_c", "A C header, for firmware and hosts."
    ),
    "spec emit wireshark": Row(
        "", f"{ANALYZER}.spec", "spec_emit_wireshark", "A dissector for Wireshark and tshark."
    ),
    "spec emit grammar": Row(
        "", f"{ANALYZER}.spec", "spec_emit_grammar", "The grammar's own text, to be changed."
    ),
    "config": Row("Settings", f"{ANALYZER}.config", "config", "Show the settings in force."),
    "completion": Row(
        "Settings", f"{ANALYZER}.completion", "completion", "Print a shell's completion script."
    ),
}
"""Every command by its name, those of a group behind the group's name; `help` is not listed."""


def _use_grammar(ctx: click.Context, param: click.Parameter, path: str | None) -> None:
    """Use a grammar from here on, the last one where several are named."""
    if path is not None:
        ctx.find_root().params["grammar"] = ctx.obj = path


def _grammar_option(help: str) -> click.Option:
    return click.Option(
        ["--grammar"],
        metavar="FILE.py",
        type=click.Path(readable=False),
        is_eager=True,
        expose_value=False,
        callback=_use_grammar,
        help=help,
    )


class Tree(Group):
    """Lists the commands below `path` without importing them; imports the one that is called."""

    def __init__(self, *arguments: Any, path: str = "", **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.path = path

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The name of every command directly below, in the order of the table."""
        names = (name[len(self.path) :] for name in COMMANDS if name.startswith(self.path))
        return [name for name in names if " " not in name]

    def panels(self, ctx: click.Context) -> dict[str, list[str]]:
        """The commands of each panel, in the order of the table."""
        names: dict[str, list[str]] = {}
        for name in self.list_commands(ctx):
            names.setdefault(COMMANDS[self.path + name].panel or "Commands", []).append(name)
        return names

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """A group, or only the command's line in the list: its name and one sentence."""
        row = None if " " in cmd_name else COMMANDS.get(self.path + cmd_name)
        if row is None or row.module:
            return click.Command(name=cmd_name, help=row.help) if row else None
        return Tree(cmd_name, path=f"{self.path}{cmd_name} ", help=row.help)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command itself, imported now. Raises UsageError where there is none."""
        if not self.path:
            args = _meant(ctx, args)
        try:
            name, command, rest = super().resolve_command(ctx, args)
        except exceptions.NoSuchCommand as error:
            raise self._unknown(ctx, error) from None
        if name is None or command is None:  # completion asks for what does not exist
            return name, command, rest
        row = COMMANDS[self.path + name]
        if row.module:
            command = getattr(import_module(row.module), row.attribute)
        if not any(param.name == "grammar" for param in command.params):
            command.params.append(_grammar_option("Use another grammar; see bilprov --help."))
        if not ctx.resilient_parsing and not any(word in rest for word in HELP_NAMES):
            from bilprov.analyzer.cli.settings import read_settings, use_settings

            use_settings(ctx, command, self.path + name, read_settings(COMMANDS))
        return name, command, rest

    def _unknown(self, ctx: click.Context, error: exceptions.NoSuchCommand) -> click.UsageError:
        names = self.list_commands(ctx)
        if self.path:
            return click.UsageError(
                f"there is no bilprov {self.path}{error.command_name}; there are {', '.join(names)}"
            )
        return exceptions.NoSuchCommand(error.command_name, possibilities=names, ctx=ctx)


def _meant(ctx: click.Context, args: list[str]) -> list[str]:
    """The arguments with the command that they mean: `help` is none, nor is a capture's name.

    Raises UsageError, in one sentence, for the former name of a command.
    """
    first = args[0]
    if first in COMMANDS:
        return args
    renamed = former_name(first, args[1:])
    if not renamed and first != "help":
        is_file = os.path.isfile(first)  # noqa: PTH113 - Path's may raise
        return ["replay", *args] if is_file or first.endswith(".mcap") else args
    if ctx.resilient_parsing:
        return args
    if renamed:
        raise click.UsageError(renamed)
    words = [word for word in args if word not in ("help", *HELP_NAMES)]
    if not words:
        click.echo(ctx.get_help())
        ctx.exit()
    return [*words, "--help"]


def _show_version(ctx: click.Context, param: click.Parameter, asked: bool) -> None:
    if asked and not ctx.resilient_parsing:
        from bilprov.analyzer.version import kit_version

        click.echo(f"bilprov {kit_version()}")
        ctx.exit()


@click.command(cls=Tree)
@click.option(
    "--version",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=_show_version,
    help="Show the version and exit.",
)
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


front_door.params.insert(
    0,
    _grammar_option(
        "Another grammar of the same family, before or after the command: a changed copy of "
        "spec/grammar.py (bilprov spec emit grammar). Runs the file as Python: name only files "
        "that you trust; a grammar inside a capture is only read."
    ),
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command with `arguments` (the process's own by default) and end the process."""
    from bilprov.analyzer.cli.failures import interrupts_kept, report
    from bilprov.analyzer.cli.streams import standard_streams

    with interrupts_kept(), standard_streams() as streams:
        try:
            status = streams.settled(_run(list(sys.argv[1:] if arguments is None else arguments)))
        except BaseException as error:
            status = streams.settled(report(error))
    sys.exit(exit_status(status))


def _run(arguments: list[str]) -> int:
    """Run a subcommand. Its exit code is what it returns or exits with, 0 where it says nothing."""
    if asked := os.environ.get("_BILPROV_COMPLETE"):
        from bilprov.analyzer.cli.completion import answer

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
