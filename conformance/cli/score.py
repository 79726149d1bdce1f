"""`bilprov lab score`: runs the suite against every faulty device, and shows what it catches."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import click
import msgspec

from bilprov.analyzer.cli.command import command, family_protocol, flag, option
from bilprov.captures.text import quantity
from bilprov.conformance.api import Options
from bilprov.conformance.cases.levels import LEVELS
from bilprov.conformance.cli.options import complete_faults, seed_option
from bilprov.conformance.cli.outputs import Outputs, outputs_option, write_each
from bilprov.conformance.mutation.score import Score, cause_score, chosen_faults, is_random
from bilprov.conformance.mutation.score import score as score_of
from bilprov.spec.protocol import Protocol

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

_SHOWN = 4  # faults named behind a case group


class ScoreOptions(msgspec.Struct, frozen=True):
    """The options of `lab score`."""

    at: tuple[str, ...] = option(
        "--level",
        multiple=True,
        metavar="LEVEL",
        type=click.Choice(list(LEVELS)),
        help="Only this level; repeatable.",
    )
    drawn: int = option(
        "--random",
        type=click.IntRange(0),
        default=300,
        metavar="N",
        help="How many random faults, random:1 to random:N.",
    )
    fault_seed: int | None = option(
        type=click.IntRange(0),
        metavar="S",
        help="Only random faults, random:S.1 to random:S.N, of wider families.",
    )
    seed: int = seed_option(help="The suite's seed.")
    only: tuple[str, ...] = option(
        multiple=True,
        metavar="GLOB",
        shell_complete=complete_faults,
        help="Only faults of these names.",
    )
    causes: bool = flag("Score the causes instead: whether they name what was planted.")
    pairs: int = option(
        type=click.IntRange(0),
        default=0,
        metavar="N",
        help="With --causes: also N pairs of faults of different families, drawn by the seed.",
    )
    outputs: dict[str, str] = outputs_option(["json"], "Everything as JSON; - is standard output.")
    jobs: int | None = option(
        type=click.IntRange(1), metavar="N", help="Processes; all cores if left out."
    )


@command(ScoreOptions, only_with={"causes": ("pairs",)})
def score(options: ScoreOptions) -> int:
    """Examples:
      bilprov lab score --level smoke --random 0

    The suite runs in virtual time. Shows how many of each family are caught at each level, what
    survives, and which faults a group of cases catches alone. A random fault counts if it failed,
    or if a separate search distinguishes it from a conforming device. Exit code: 0 everything is
    caught that must be, 1 something is not.
    """
    from rich.console import Console

    from bilprov.conformance.cli.progress import counted

    protocol, at, only = family_protocol("lab score"), options.at, options.only
    faults = chosen_faults(protocol, options.drawn, only, options.fault_seed)
    if not faults:
        none = f"matches {' or '.join(only)}" if only else "is left with --random 0"
        raise click.UsageError(f"no fault {none}; see simulate --list-faults")
    outputs = Outputs(options.outputs)
    outputs.require_writable()
    console = Console(stderr=outputs.onto_stdout, highlight=False, soft_wrap=True)
    if options.causes:
        return _causes(options, protocol, list(faults), outputs, console)
    jobs = options.jobs or os.cpu_count() or 1
    with counted(len(faults) * max(1, len(at))) as told:
        found = score_of(protocol, faults, at=at, seed=options.seed, jobs=jobs, progress=told)
    try:
        write_each((output.path, _as_json(found)) for output in outputs)
    finally:
        _show(found, console)
    return 1 if found.failures else 0


def _causes(
    options: ScoreOptions,
    protocol: Protocol,
    names: list[str],
    outputs: Outputs,
    console: Console,
) -> int:
    """Score the causes and show what came out; returns the exit code."""
    from rich.text import Text

    from bilprov.conformance.cli.progress import counted

    level = options.at[0] if options.at else Options().level
    jobs = options.jobs or os.cpu_count() or 1
    with counted(len(names) + options.pairs) as told:
        found = cause_score(
            protocol, names, options.pairs, level, seed=options.seed, jobs=jobs, progress=told
        )
    write_each((output.path, _as_json(found)) for output in outputs)
    for one in (*found.failing, *found.pairs):
        if one.causes != 1 + (one in found.pairs) or one.named < one.of or not one.shown:
            words = f"{one.name}: {quantity(one.causes, 'cause')}, {one.named} of {one.of} named"
            line = "shown" if one.shown else "not shown by its line"
            console.print(Text(f"{words}, {line}; {one.first}"))
    for sentence in found.sentences():
        console.print(sentence)
    return 0


def _as_json(found: msgspec.Struct) -> str:
    """The score on one line."""
    return msgspec.json.encode(found).decode() + "\n"


def _show(found: Score, console: Console) -> None:
    from rich.text import Text

    console.print(_matrix(found))
    last = found.levels[-1]
    survivors = found.survivors(last)
    shown = [name for name in survivors if not is_random(name) or found.can_show(name)]
    if shown:
        console.print(Text(f"\n{last} does not catch", "bold"))
    verdicts = {name: result.verdict for name, result in found.at(last).items()}
    for name in shown:
        family, doc = found.faults[name]
        console.print(Text(f"  {name} ({family}), {verdicts[name]}: {doc}"))
        console.print(Text(f"      {found.searches[name]}", "dim"))
    if len(shown) < len(survivors):
        alike = ", ".join(name for name in survivors if name not in shown)
        console.print(Text(f"\nnot counted, since no search distinguishes them: {alike}", "dim"))
    console.print(Text(f"\nwhat a group of cases catches alone ({last})", "bold"))
    for group, names in sorted(found.alone(last).items()):
        if names:
            more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
            console.print(Text(f"  {group} ({len(names)}): {', '.join(names[:_SHOWN])}{more}"))
    idle = sorted(group for group, names in found.alone(last).items() if not names)
    if idle:
        console.print(Text(f"  nothing alone: {', '.join(idle)}", "dim"))
    console.print()
    for level in found.levels:
        caught, of = found.share(level, drawn=False)
        if of:
            text = f"{level}: {caught} of {of} named faults that can show, {_percent(caught, of)}"
            console.print(Text(text, "green" if caught == of else ""))
        failed, of = found.share(level, drawn=True)
        if of:
            text = (
                f"{level}: failed {failed} of {of} that can be told apart, {_percent(failed, of)}"
            )
            console.print(Text(text, "green" if failed == of else ""))
    if found.told_apart:
        console.print(
            f"{last}, the others: {found.passed} passed, {found.inconclusive} inconclusive"
        )
    if found.soak:
        console.print(Text(f"not counted, a soak alone shows them: {', '.join(found.soak)}", "dim"))
    for sentence in found.failures:
        console.print(Text(sentence, "bold red"))


def _percent(part: int, of: int) -> str:
    return f"{100 * part / of:.1f} %"


def _matrix(found: Score) -> Table:
    from rich.table import Table

    table = Table("family", *found.levels)
    for column in table.columns[1:]:
        column.justify = "right"
    for family in found.families:
        cells = [found.caught(family, level) for level in found.levels]
        table.add_row(family, *(f"{caught} of {of}" for caught, of in cells))
    table.add_section()
    table.add_row("bytes sent", *(f"{found.bytes[level]:,}" for level in found.levels))
    return table
