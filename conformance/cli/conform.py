"""`bilprov conform`: tests a device, and writes the report in the formats asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, TypeVar

import rich_click as click
from rich.console import Console

from bilprov.analyzer.cli.confirm import confirm_motion
from bilprov.analyzer.cli.options import line_options, note
from bilprov.analyzer.cli.streams import promise_verdict
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.ports import open_port
from bilprov.analyzer.transport.signals import undisturbed
from bilprov.conformance.api import (
    Options,
    estimated_seconds,
    opening_and_reading_cases,
    planned,
    select_cases,
)
from bilprov.conformance.cases.levels import LEVELS, STANDARD
from bilprov.conformance.cases.selection import matching, shard_named
from bilprov.conformance.cli.begin import Begin
from bilprov.conformance.cli.job import SIM, ConformRun
from bilprov.conformance.cli.options import (
    expect_failures_option,
    expected_file,
    named_device,
    read_profile,
    update_expected_option,
    with_expected,
)
from bilprov.conformance.cli.outputs import (
    Output,
    deliver,
    onto_standard_output,
    output_options,
    require_writable,
)
from bilprov.conformance.dut.boards.target import board_named
from bilprov.conformance.dut.power import by_command
from bilprov.conformance.dut.probes import open_probe
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.oracle.choices import parse_allowed
from bilprov.conformance.oracle.profile_file import profile_text
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.report.summary import show
from bilprov.spec.protocol import Protocol

Command = TypeVar("Command", bound=Callable[..., Any])


def _milliseconds(name: str, text: str) -> Callable[[Command], Command]:
    kind = click.FloatRange(0, 60_000, min_open=True)
    return click.option(name, metavar="MS", type=kind, help=text)


@click.command()
@click.argument("target", metavar="PORT|sim|emulator:KIND:FIRMWARE")
@click.option(
    "--probe",
    help="What sees a stop: tcp:HOST:PORT, exec:COMMAND, modem:LINE, ask, none (a port's unless "
    "given) or sim (the target sim's own).",
)
@click.option("--power", metavar="exec:COMMAND", help="A command that switches it off and on.")
@click.option("--only", multiple=True, metavar="GLOB", help="Only these cases; * crosses /.")
@click.option("--shard", metavar="I/N", help="Run the I-th of N equal shares; see bilprov merge.")
@click.option("--list", "listing", is_flag=True, help="List the cases and send nothing.")
@click.option("--fail-fast", is_flag=True, help="End after the first failure.")
@click.option(
    "--level",
    type=click.Choice(list(LEVELS)),
    default=STANDARD.name,
    show_default=True,
    help="; ".join(f"{level.name}: {level.promise}" for level in LEVELS.values()) + ".",
)
@click.option("--soak", metavar="N", type=click.IntRange(0), default=0, help="And N faults more.")
@click.option(
    "--budget",
    metavar="S",
    type=click.FloatRange(1, 86_400),
    help="Drop the cases that add least a second, and say which.",
)
@click.option(
    "--allow",
    multiple=True,
    metavar="NAME=VALUE",
    help="Accept a choice that fails otherwise: led-upper=ignore, led-id=ID, version=1.0, "
    "unused-length=header-only, pipelining=no.",
)
@click.option(
    "--profile",
    "profile_path",
    metavar="FILE.toml",
    help="Hold the device to this profile; a file that is not there is written from this run.",
)
@click.option("--seed", type=int, default=1, show_default=True, help="How data and motions rotate.")
@click.option("--strict", is_flag=True, help="Count non-strict as failed.")
@_milliseconds("--deadline", "How soon an answer is due: later is slow, and non-strict.")
@_milliseconds("--silence", "How long the line is listened to after an answer.")
@_milliseconds("--truncation-timeout", "The pause that ends a frame; measured unless given.")
@output_options()
@expect_failures_option
@update_expected_option
@click.option("--record", metavar="FILE.mcap", help="Record the run into a new capture.")
@click.option(
    "--fault", metavar="NAME", help="With sim: misbehave in this way; random:SEED draws one."
)
@click.option("--variant", metavar="NAME", help="With sim: read the document so.")
@line_options
@click.option("--yes", is_flag=True, help="The robot may move: do not ask.")
@click.option("-v", "--verbose", is_flag=True, help="List every case that did not pass.")
@click.pass_obj
def conform(
    grammar: str | None,
    target: str,
    probe: str | None,
    power: str | None,
    only: tuple[str, ...],
    shard: str | None,
    listing: bool,
    fail_fast: bool,
    level: str,
    soak: int,
    budget: float | None,
    allow: tuple[str, ...],
    profile_path: str | None,
    seed: int,
    strict: bool,
    deadline: float | None,
    silence: float | None,
    truncation_timeout: float | None,
    outputs: list[Output],
    expect_failures: str | None,
    update_expected: bool,
    record: str | None,
    fault: str | None,
    variant: str | None,
    baud: int | None,
    parity: str | None,
    stopbits: str | None,
    yes: bool,
    verbose: bool,
) -> int:
    """Test a device against the document: its answers, its safety stop, its state.

    PORT is a path or a pyserial URL of a device that will move; sim is the built-in simulator, in
    virtual time; emulator:simavr:FILE.elf and emulator:qemu:FILE.elf run a board's firmware.
    Exit code: 0 conforms, 1 does not, 2 the port or the probe cannot be used, 3 nothing failed but
    something could not be judged. Where a file or something for the screen could not be written,
    the run goes on to its end and the exit code is 2.
    """
    protocol = load_protocol(grammar)
    options = Options(
        only,
        seed,
        strict,
        fail_fast,
        deadline,
        silence,
        truncation_timeout,
        level,
        soak,
        allow,
        budget,
    )
    given = read_profile(protocol, profile_path, allow)
    options = replace(options, profile=given)
    settings = line_settings(protocol, None, None, None)
    try:
        board = board_named(target)
        if target != SIM and not board:  # the simulator and emulated boards have their own line
            settings = line_settings(protocol, baud, parity, stopbits)
        parse_allowed(protocol, allow)
        options = replace(options, shard=shard_named(shard) if shard is not None else None)
        cases = select_cases(protocol, options, settings)
    except ValueError as error:
        raise click.UsageError(str(error)) from error
    virtual = target == SIM or bool(board and board.virtual)
    if listing:
        chosen = matching(only or "*")
        for case in filter(
            lambda case: chosen(case.id), (*opening_and_reading_cases(protocol), *cases)
        ):
            click.echo(f"{case.id:28} {case.clause:20} {case.requirement}")
        return 0
    promise_verdict()
    if (virtual or board) and probe not in (None, SIM):
        raise click.UsageError(
            f"the target {target} brings its own probe; --probe {probe} is for ports"
        )
    if target != SIM and (fault or variant):
        option = "--fault" if fault else "--variant"
        raise click.UsageError(f"{option} is for the target sim; start `bilprov simulate {option}`")
    if power is not None and (virtual or board or not power.startswith("exec:")):
        raise click.UsageError(f"--power {power}: it takes exec:COMMAND, and is for ports")
    fresh = profile_path if not given else None
    require_writable(outputs)
    known = expected_file(protocol, options, expect_failures, settings, update=update_expected)
    switch = by_command(power.removeprefix("exec:")) if power else None
    job = ConformRun(protocol, options, record, switch)
    count = planned(protocol, options, cases)
    begin = Begin()
    with ExitStack() as stack:
        if board:
            report = job.on_board(stack, board, target, count)
        elif virtual:
            device = Simulator(protocol, named_device(protocol, fault, variant))
            report = job.on_simulator(stack, device, count)
        else:
            port = stack.enter_context(open_port(target, settings))
            seconds = estimated_seconds(protocol, cases, options, settings)
            probe = "none" if probe is None else probe
            eye = open_probe(probe, port)
            if eye:
                stack.callback(eye.close)
            what = f"the robot at {target} will drive and turn for about {seconds:.0f} s"
            confirm_motion(what, yes=yes)
            note(f"{count} cases, about {seconds:.0f} s; what goes wrong may add a few")
            begin = Begin()  # the time until the user confirmed does not count
            report = job.on_port(stack, port, eye, probe, count)
    report = begin.told(report)
    onto_stdout = onto_standard_output(outputs)
    if fresh is not None and not report.unusable:
        outputs.append(Output("--profile", fresh, _profile))
    # What can be written is, even if something else fails: the robot should not drive again for it.
    try:
        with undisturbed(again=False):
            report = with_expected(report, known, expect_failures)
    finally:
        try:
            deliver(outputs, [report], protocol)
        finally:
            console = Console(stderr=onto_stdout, highlight=False, soft_wrap=True)
            show(report, console, everything=verbose)
    if fresh is not None and not report.unusable:
        note(f"{fresh}: the profile of this device; give it again with --profile")
    if job.broken:
        raise job.broken
    return report.exit


def _profile(reports: Sequence[Report], protocol: Protocol) -> str:
    (report,) = reports
    return profile_text(report.grammar, report.profile)
