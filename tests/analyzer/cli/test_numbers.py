"""What is not a number is refused by every option that takes one, in one sentence."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module

import click
import pytest

from bilprov.__main__ import COMMANDS
from bilprov.analyzer.cli.options import Finite
from tests.support.commands import command


def _walk(name: tuple[str, ...], one: click.Command) -> Iterator[tuple[tuple[str, ...], str, bool]]:
    """Each option that takes a number with a fraction: its command, its name, whether a Finite."""
    for parameter in one.params:
        fraction = isinstance(parameter.type, click.FloatRange | click.types.FloatParamType)
        if fraction and isinstance(parameter, click.Option):
            yield name, parameter.opts[0], isinstance(parameter.type, Finite)
    if isinstance(one, click.Group):
        context = click.Context(one)
        for below in one.list_commands(context):
            inner = one.get_command(context, below)
            assert inner is not None
            yield from _walk((*name, below), inner)


OPTIONS = [
    option
    for name, row in COMMANDS.items()
    for option in _walk((name,), getattr(import_module(row.module), row.attribute))
]


def test_the_walk_meets_the_options() -> None:
    met = {(words[0], option) for words, option, _ in OPTIONS}
    assert {("conform", "--budget"), ("conform", "--silence"), ("sniff", "--duration")} <= met


@pytest.mark.parametrize(("words", "option", "finite"), OPTIONS)
def test_what_is_no_number_is_refused(words: tuple[str, ...], option: str, finite: bool) -> None:
    assert finite
    for value in ("nan", "inf", "-inf", "1e400"):
        done = command(*words, f"{option}={value}")
        assert done.returncode == 2
        (told,) = done.stderr.decode().splitlines()
        assert option in told


@pytest.mark.parametrize("option", ["--silence", "--deadline", "--truncation-timeout"])
def test_a_time_of_no_nanosecond_is_refused(option: str) -> None:
    done = command("conform", "sim", f"{option}=1e-9")
    assert done.returncode == 2
    assert b"0.001" in done.stderr
