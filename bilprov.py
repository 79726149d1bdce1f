"""The front door: one command and one import. Each part is loaded only when it is asked for.

As a command: `bilprov --help`. As a library: `from bilprov import decode, judge, read_capture`; the
names are those of `__all__`, and each comes with the docstring of where it lives.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

import rich_click as click
from click import exceptions

from analyzer.cli.failures import report

if TYPE_CHECKING:
    from analyzer.api import decode as decode
    from analyzer.api import encode as encode
    from analyzer.api import explain as explain
    from analyzer.api import judge as judge
    from analyzer.api import read_capture as read_capture
    from analyzer.client.errors import NoAnswer as NoAnswer
    from analyzer.client.errors import Refused as Refused
    from analyzer.client.errors import RobotError as RobotError
    from analyzer.client.robot import Robot as Robot
    from analyzer.grammar_file import load_protocol as load_protocol
    from analyzer.live import sniff as sniff
    from analyzer.transport.errors import LinkError as LinkError
    from captures.reader import open_capture as open_capture
    from captures.schemas import Look as Look
    from conformance.api import Options as Options
    from conformance.api import conform as conform

__all__ = [
    "LinkError",
    "Look",
    "NoAnswer",
    "Options",
    "Refused",
    "Robot",
    "RobotError",
    "conform",
    "decode",
    "encode",
    "explain",
    "judge",
    "load_protocol",
    "main",
    "open_capture",
    "read_capture",
    "sniff",
]

# What the import hands on: name -> (module, attribute).
API = {
    "LinkError": ("analyzer.transport.errors", "LinkError"),
    "Look": ("captures.schemas", "Look"),
    "NoAnswer": ("analyzer.client.errors", "NoAnswer"),
    "Options": ("conformance.api", "Options"),
    "Refused": ("analyzer.client.errors", "Refused"),
    "Robot": ("analyzer.client.robot", "Robot"),
    "RobotError": ("analyzer.client.errors", "RobotError"),
    "conform": ("conformance.api", "conform"),
    "decode": ("analyzer.api", "decode"),
    "encode": ("analyzer.api", "encode"),
    "explain": ("analyzer.api", "explain"),
    "judge": ("analyzer.api", "judge"),
    "load_protocol": ("analyzer.grammar_file", "load_protocol"),
    "open_capture": ("captures.reader", "open_capture"),
    "read_capture": ("analyzer.api", "read_capture"),
    "sniff": ("analyzer.live", "sniff"),
}


def __getattr__(name: str) -> Any:
    if name not in API:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = API[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted(__all__)


class Row(NamedTuple):
    """One subcommand: where it stands in the help, where it lives, what it is for."""

    panel: str
    module: str
    attribute: str
    help: str


COMMANDS = {
    "sniff": Row("Analyze", "analyzer.cli.sniff", "sniff", "Listen to a line, decode and log it."),
    "replay": Row("Analyze", "analyzer.cli.replay", "replay", "Play a capture again."),
    "decode": Row("Analyze", "analyzer.cli.decode", "decode", "Decode bytes from hex or a file."),
    "info": Row("Analyze", "analyzer.cli.text_commands", "info", "Tell what a capture holds."),
    "send": Row("Analyze", "analyzer.cli.send", "send", "Send instructions or bytes to a device."),
    "ports": Row(
        "Analyze", "analyzer.cli.text_commands", "ports", "List the serial ports of this machine."
    ),
    "conform": Row(
        "Conform", "conformance.cli.conform", "conform", "Run the suite against a device."
    ),
    "report": Row("Conform", "conformance.cli.report", "report", "Compare and show past runs."),
    "simulate": Row(
        "Conform", "conformance.cli.simulate", "simulate", "Serve the reference device."
    ),
    "emulate": Row("Conform", "conformance.cli.emulate", "emulate", "Serve a board's firmware."),
    "line": Row("Conform", "analyzer.cli.line", "line", "Join two ends by a bad line."),
    "score": Row(
        "Conform", "conformance.cli.score", "command", "Score the suite against faulty devices."
    ),
    "recheck": Row("Conform", "conformance.cli.recheck", "recheck", "Judge a recorded run again."),
    "merge": Row("Conform", "conformance.cli.merge", "merge_reports", "Put shards together."),
    "explain": Row(
        "Protocol", "analyzer.cli.text_commands", "explain", "Explain every bit of some bytes."
    ),
    "encode": Row(
        "Protocol", "analyzer.cli.text_commands", "encode", "Build the bytes of an instruction."
    ),
    "spec": Row("Protocol", "analyzer.cli.spec", "spec", "Show protocol, readings and errata."),
    "completion": Row(
        "Protocol", "analyzer.cli.text_commands", "completion", "Print shell completion."
    ),
}


class FrontDoor(click.RichGroup):
    """Lists the subcommands without importing them, and imports the one that is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Every subcommand's name, in the order of the table."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Only the subcommand's line in the list: its name and one sentence."""
        row = COMMANDS.get(cmd_name)
        return click.RichCommand(name=cmd_name, help=row.help) if row else None

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
        return name, getattr(import_module(row.module), row.attribute), rest


def _show_version(ctx: click.Context, param: click.Parameter, asked: bool) -> None:
    if asked and not ctx.resilient_parsing:
        from analyzer.version import kit_version

        click.echo(f"bilprov {kit_version()}")
        ctx.exit()


PANELS = [
    click.RichCommandPanel(panel, commands=[n for n, row in COMMANDS.items() if row.panel == panel])
    for panel in dict.fromkeys(row.panel for row in COMMANDS.values())
]


HELP_STYLE = {
    "theme": "nu",
    "commands_before_options": True,
    "text_paragraph_linebreaks": "\n\n",
    "options_table_column_types": ["opt_short", "opt_long_metavar", "help"],
    "options_table_help_sections": ["required", "help", "default", "range"],
    # Left alone, rich-click puts colours into any pipe on GitHub's runners.
    "force_terminal": None,
}


@click.command(cls=FrontDoor, panels=PANELS, context_settings={"rich_help_config": HELP_STYLE})
@click.option(
    "--grammar",
    metavar="FILE.py",
    help="Another grammar of the same family: a changed copy of spec/grammar.py.",
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
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a narrow locale is no reason to fail
    try:
        status = _run(list(sys.argv[1:] if arguments is None else arguments))
        sys.stdout.flush()
    except BaseException as error:
        status = report(error)
    sys.exit(status)


def _run(arguments: list[str]) -> int:
    """Run a subcommand. Its exit code is what it returns or exits with, 0 where it says nothing."""
    asked = os.environ.get("_BILPROV_COMPLETE")
    if asked:
        from click.shell_completion import shell_complete

        return shell_complete(front_door, {}, "bilprov", "_BILPROV_COMPLETE", asked)
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
