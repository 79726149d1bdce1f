"""`bilprov simulate`: serves the reference device on a pty or over TCP."""

from __future__ import annotations

import click

from bilprov.analyzer.cli.options import note
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.transport.server import serve
from bilprov.analyzer.transport.signals import Stopper
from bilprov.conformance.cli import completion
from bilprov.conformance.cli.options import named_device
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.catalogue import listed_faults, listed_variants


@click.command()
@click.option("--listen", metavar="HOST:PORT", help="Serve raw TCP instead of a pty; port 0: any.")
@click.option(
    "--probe-listen", metavar="HOST:PORT", help="Serve the probe over TCP too; 256 clients at most."
)
@click.option(
    "--fault",
    metavar="NAME",
    shell_complete=completion.faults,
    help="Misbehave in one way; random:SEED or random:SEED.NUMBER draws one.",
)
@click.option(
    "--variant",
    metavar="NAME",
    shell_complete=completion.variants,
    help="Read the document in another legal way.",
)
@click.option("--list-faults", is_flag=True, help="List the named faults.")
@click.option("--list-variants", is_flag=True, help="List the legal variants, and mixtures.")
@click.pass_obj
def simulate(
    grammar: str | None,
    listen: str | None,
    probe_listen: str | None,
    fault: str | None,
    variant: str | None,
    list_faults: bool,
    list_variants: bool,
) -> int:
    """Serve the reference device on a pty, or over TCP, until Ctrl-C.

    Prints one line for each thing it serves: the pty's path, socket://HOST:PORT, and
    probe tcp:HOST:PORT, which are what sniff, conform and --probe take.

    One host at a time is served over TCP; a second is closed. A host that does not read loses what
    exceeds 64 KiB. 256 probe clients are served, each with lines of at most 1024 bytes; each is
    answered once in turn, and one that leaves 32 KiB unread is closed with a line of JSON that
    says so. 127.0.0.1 is this machine alone; an address that others reach comes with a warning.
    """
    protocol = load_protocol(grammar)
    if list_faults:
        click.echo(listed_faults(protocol))
        return 0
    if list_variants:
        click.echo(listed_variants(protocol))
        return 0
    device = Simulator(protocol, named_device(protocol, fault, variant))
    with Stopper() as stopper:
        try:
            serve(
                device,
                pty=listen is None,
                listen=listen,
                probe_listen=probe_listen,
                announce=lambda line: click.echo(line),
                stop=stopper,
                note=note,
            )
        except ValueError as error:
            raise click.UsageError(str(error)) from error
    return 0
