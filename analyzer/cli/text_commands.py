"""The text commands: explain, encode, ports, info, completion."""

from __future__ import annotations

import sys
from typing import Any

import click

from bilprov.analyzer.cli.options import note, sender_option, text_format_option
from bilprov.analyzer.output.console import show, show_as, show_json


@click.command()
@click.argument("words", metavar="HEX...", nargs=-1, required=True)
@sender_option
@text_format_option
@click.pass_obj
def explain(grammar: str | None, words: tuple[str, ...], sender: str, style: str) -> None:
    """Explain every bit of some bytes.

    For each frame: what its bits mean, what a conforming device answers and does, why, on which
    clause, reading or erratum of the document that rests, and the nearest valid frame.

    Example: bilprov explain 81 09
    """
    from bilprov.analyzer.cli.typed_input import bytes_from_hex
    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.analyzer.output.explanation import as_json, drawn
    from bilprov.spec import explain as explaining

    data = _or_sentence(bytes_from_hex, " ".join(words))
    protocol = load_protocol(grammar)
    make = explaining.explain if sender == "host" else explaining.explain_responses
    explanation = make(protocol, data)
    show_as(style, lambda: as_json(explanation), lambda: drawn(explanation))


def _or_sentence(function: Any, *arguments: Any) -> Any:
    """Call a function and return its value; its ValueError becomes a ClickException."""
    try:
        return function(*arguments)
    except ValueError as error:
        raise click.ClickException(str(error)) from None


# A negative value looks like an option; here it is taken as a value, whose range check refuses it.
@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("name", metavar="INSTRUCTION")
@click.argument("values", metavar="[FIELD=VALUE]...", nargs=-1)
@click.option("--raw", is_flag=True, help="Write the bytes themselves, for a pipe.")
@click.pass_obj
def encode(grammar: str | None, name: str, values: tuple[str, ...], raw: bool) -> None:
    """Build the bytes of an instruction and print them in hex.

    Values are decimal, 0x hex or 0b binary; without FIELD= they are taken in order. See the
    instructions and their fields with: bilprov spec show

    INSTRUCTION is a name of the grammar's, FIELD one of its fields.
    """
    from bilprov.analyzer.cli.typed_input import encoded
    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.spec.codec import spaced

    for word in (name, *values):
        if word.startswith("-") and not word[1:2].isdigit():
            raise click.NoSuchOption(word, possibilities=["--raw", "--help"])
    frame = _or_sentence(encoded, load_protocol(grammar), name, values)
    if raw:
        sys.stdout.buffer.write(frame)
    else:
        click.echo(spaced(frame))


@click.command()
@text_format_option
def ports(style: str) -> None:
    """List the serial ports of this machine, their adapters, and who holds them.

    USB adapters and boards are marked with a star. The latency is how long an adapter holds bytes
    back; what is wrong with a port tells bilprov doctor PORT.
    """
    from dataclasses import asdict

    from bilprov.analyzer.output.port_list import drawn, unseen
    from bilprov.analyzer.transport.ports import list_ports

    found = list_ports()
    if style == "json":
        show_json([asdict(port) for port in found])
    elif found:
        show(*drawn(found))
    else:
        click.echo(
            "No serial port here. Plug the robot or its USB adapter in and look again, give the "
            "path of a pty or a URL like socket://HOST:PORT, or try without a robot: "
            "bilprov simulate"
        )
    if unseen(found):
        note(unseen(found))


@click.command()
@click.argument("file", metavar="FILE.mcap")
@text_format_option
@click.option("--json", "as_json", is_flag=True, help="The same as --format json.")
@click.pass_obj
def info(grammar: str | None, file: str, style: str, as_json: bool) -> None:
    """Tell what a capture holds, when and where it was recorded and whether it is whole.

    The keys of the JSON are explained in analyzer/output/capture_info.py.
    """
    from dataclasses import asdict

    from bilprov.analyzer.grammar_file import load_protocol
    from bilprov.analyzer.output.capture_info import drawn, summarized
    from bilprov.captures.reader import open_capture

    summary = summarized(open_capture(file), load_protocol(grammar))
    show_as("json" if as_json else style, lambda: asdict(summary), lambda: drawn(summary))


# How to install the completion script permanently in each shell.
INSTALL = {
    "bash": 'eval "$(bilprov completion bash)" in ~/.bashrc',
    "zsh": 'eval "$(bilprov completion zsh)" in ~/.zshrc, after compinit',
    "fish": "bilprov completion fish > ~/.config/fish/completions/bilprov.fish",
}


@click.command(
    epilog="\n\n".join(f"{shell}: {line}" for shell, line in INSTALL.items()),
)
@click.argument("shell", type=click.Choice(list(INSTALL)))
@click.pass_context
def completion(ctx: click.Context, shell: str) -> None:
    """Print the script that completes bilprov's subcommands, options and names in a shell."""
    from click.shell_completion import get_completion_class

    from bilprov.analyzer.cli.shells import register

    register()
    made = get_completion_class(shell)
    if made is None:
        raise click.ClickException(f"click knows no completion for {shell}")
    root = ctx.find_root()
    click.echo(made(root.command, {}, "bilprov", "_BILPROV_COMPLETE").source())
