"""The command: `bilprov` or `python -m bilprov`. Each subcommand is imported when it is called."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import NamedTuple

import click
from click import exceptions

from bilprov.analyzer.output.help import Group, with_pages
from bilprov.analyzer.settings import read_settings
from bilprov.analyzer.transport.ending import exit_status


class Row(NamedTuple):
    """One subcommand: where it stands in the help, where it lives, what it is for."""

    panel: str
    module: str
    attribute: str
    help: str


COMMANDS = {
    "sniff": Row(
        "Analyze", "bilprov.analyzer.cli.sniff", "sniff", "Listen to a line, decode and log it."
    ),
    "replay": Row("Analyze", "bilprov.analyzer.cli.replay", "replay", "Play a capture again."),
    "browse": Row(
        "Analyze", "bilprov.analyzer.cli.browse", "browse", "Look through a capture on a screen."
    ),
    "decode": Row(
        "Analyze", "bilprov.analyzer.cli.decode", "decode", "Decode bytes from hex or a file."
    ),
    "stats": Row(
        "Analyze",
        "bilprov.analyzer.cli.stats",
        "stats",
        "Count what captures hold: frames, answers.",
    ),
    "plot": Row(
        "Analyze",
        "bilprov.analyzer.cli.plot",
        "plot",
        "Draw a capture along its time, as a page.",
    ),
    "info": Row(
        "Files", "bilprov.analyzer.cli.text_commands", "info", "Tell what a capture holds."
    ),
    "export": Row(
        "Files",
        "bilprov.analyzer.cli.export",
        "export",
        "Write a capture for other programs.",
    ),
    "cut": Row("Files", "bilprov.analyzer.cli.edit", "cut", "Write a part of a capture."),
    "join": Row("Files", "bilprov.analyzer.cli.edit", "join", "Put captures together by time."),
    "recover": Row(
        "Files",
        "bilprov.analyzer.cli.edit",
        "recover",
        "Write what is whole of a damaged capture.",
    ),
    "compare": Row(
        "Files", "bilprov.analyzer.cli.edit", "compare", "Tell where two captures differ."
    ),
    "convert": Row(
        "Files",
        "bilprov.analyzer.cli.convert",
        "convert",
        "Write a capture anew, all of it decoded.",
    ),
    "ports": Row(
        "Ports",
        "bilprov.analyzer.cli.text_commands",
        "ports",
        "List the serial ports of this machine.",
    ),
    "doctor": Row(
        "Ports", "bilprov.analyzer.cli.doctor", "doctor", "Find what keeps a port from use."
    ),
    "send": Row(
        "Ports", "bilprov.analyzer.cli.send", "send", "Send instructions or bytes to a device."
    ),
    "shell": Row(
        "Ports", "bilprov.conformance.cli.shell.command", "shell", "Drive a device by hand."
    ),
    "line": Row("Ports", "bilprov.analyzer.cli.line", "line", "Join two ends by a bad line."),
    "conform": Row(
        "Conform", "bilprov.conformance.cli.conform", "conform", "Run the suite against a device."
    ),
    "learn": Row(
        "Conform", "bilprov.conformance.cli.learn", "learn", "Learn a device as a state machine."
    ),
    "report": Row(
        "Conform", "bilprov.conformance.cli.report", "report", "Compare and show past runs."
    ),
    "simulate": Row(
        "Conform", "bilprov.conformance.cli.simulate", "simulate", "Serve the reference device."
    ),
    "emulate": Row(
        "Conform", "bilprov.conformance.cli.emulate", "emulate", "Serve a board's firmware."
    ),
    "score": Row(
        "Conform",
        "bilprov.conformance.cli.score",
        "command",
        "Score the suite against faulty devices.",
    ),
    "recheck": Row(
        "Conform", "bilprov.conformance.cli.recheck", "recheck", "Judge a recorded run again."
    ),
    "merge": Row(
        "Conform", "bilprov.conformance.cli.merge", "merge_reports", "Put shards together."
    ),
    "explain": Row(
        "Protocol",
        "bilprov.analyzer.cli.text_commands",
        "explain",
        "Explain every bit of some bytes.",
    ),
    "encode": Row(
        "Protocol",
        "bilprov.analyzer.cli.text_commands",
        "encode",
        "Build the bytes of an instruction.",
    ),
    "spec": Row(
        "Protocol", "bilprov.analyzer.cli.spec", "spec", "Show protocol, readings and errata."
    ),
    "config": Row(
        "Settings", "bilprov.analyzer.cli.config", "config", "Show settings and where they are set."
    ),
    "completion": Row(
        "Settings", "bilprov.analyzer.cli.text_commands", "completion", "Print shell completion."
    ),
}


class FrontDoor(Group):
    """Lists the subcommands without importing them, and imports the one that is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Every subcommand's name, in the order of the table."""
        return list(COMMANDS)

    def panels(self, ctx: click.Context) -> dict[str, list[str]]:
        """The subcommands of each panel, in the order of the table."""
        names: dict[str, list[str]] = {}
        for name, row in COMMANDS.items():
            names.setdefault(row.panel, []).append(name)
        return names

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Only the subcommand's line in the list: its name and one sentence."""
        row = COMMANDS.get(cmd_name)
        return click.Command(name=cmd_name, help=row.help) if row else None

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The subcommand itself, imported now. Raises UsageError where there is none."""
        try:
            name, listed, rest = super().resolve_command(ctx, args)
        except exceptions.NoSuchCommand as error:
            raise exceptions.NoSuchCommand(
                error.command_name, possibilities=COMMANDS, ctx=ctx
            ) from None
        if name is None or listed is None:  # completion asks for what does not exist
            return name, listed, rest
        row = COMMANDS[name]
        command = with_pages(getattr(import_module(row.module), row.attribute))
        if ctx.resilient_parsing:
            from bilprov.analyzer.cli.completion import with_completion

            with_completion(command)
            return name, command, rest
        if "--help" in rest:
            return name, command, rest
        settings = read_settings(COMMANDS)
        if settings.empty:
            return name, command, rest
        from bilprov.analyzer.cli.settings import with_settings

        grammar = settings.values_of(name).get("grammar")
        if grammar is not None and ctx.params.get("grammar") is None:
            ctx.params["grammar"] = str(grammar.value)
        command, ctx.default_map = with_settings(
            command, name, settings, rest, ctx.params.get("grammar")
        )
        return name, command, rest


def _show_version(ctx: click.Context, param: click.Parameter, asked: bool) -> None:
    if asked and not ctx.resilient_parsing:
        from bilprov.analyzer.version import kit_version

        click.echo(f"bilprov {kit_version()}")
        ctx.exit()


@click.command(cls=FrontDoor)
@click.option(
    "--grammar",
    metavar="FILE.py",
    help="Another grammar of the same family: a changed copy of spec/grammar.py. Runs the file as "
    "Python: name only files that you trust; a grammar inside a capture is only read.",
)
@click.option(
    "--version",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=_show_version,
    help="Show the version and exit.",
)
@click.pass_context
def front_door(ctx: click.Context, grammar: str | None) -> None:
    """Protocol analyzer and conformance kit for the robot-car serial protocol.

    Exit codes: 0 fine, 1 the device does not conform, 2 wrong use or nothing to work with,
    3 nothing failed but something could not be judged.
    """
    ctx.obj = grammar


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
    asked = os.environ.get("_BILPROV_COMPLETE")
    if asked:
        return _complete(asked)
    try:
        with front_door.make_context("bilprov", arguments) as context:
            result = front_door.invoke(context)
    except exceptions.Exit as stop:
        return stop.exit_code
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 2 if stop.code else 0
    return result if type(result) is int else 0


def _complete(asked: str) -> int:
    """Print what a shell's completion asks for; nothing where the line has an error."""
    from contextlib import suppress

    from click.shell_completion import shell_complete

    from bilprov.analyzer.cli.completion import with_completion
    from bilprov.analyzer.cli.shells import register
    from bilprov.spec.errors import UserError

    register()
    with_completion(front_door)
    with suppress(UserError, OSError):
        return shell_complete(front_door, {}, "bilprov", "_BILPROV_COMPLETE", asked)
    return 0


if __name__ == "__main__":
    main()
