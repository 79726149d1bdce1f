"""What is not a number is refused by every option that takes one, in one sentence."""

from __future__ import annotations

from collections.abc import Iterator

import click
import pytest

from bilprov.__main__ import COMMANDS
from bilprov.analyzer.cli.options import Finite
from tests.support.commands import command, command_named


def _fractions(name: str) -> Iterator[tuple[str, str, bool]]:
    """Each option of a command that takes a number with a fraction, and whether it is a Finite."""
    for parameter in command_named(name)[0].params:
        fraction = isinstance(parameter.type, click.FloatRange | click.types.FloatParamType)
        if fraction and isinstance(parameter, click.Option):
            yield name, parameter.opts[0], isinstance(parameter.type, Finite)


OPTIONS = [option for name in COMMANDS for option in _fractions(name)]


def test_the_walk_meets_the_options() -> None:
    met = {(name, option) for name, option, _ in OPTIONS}
    assert {("conform", "--deadline"), ("capture cut", "--start"), ("sniff", "--duration")} <= met


@pytest.mark.parametrize(("name", "option", "finite"), OPTIONS)
def test_what_is_no_number_is_refused(name: str, option: str, finite: bool) -> None:
    assert finite
    for value in ("nan", "inf", "-inf", "1e400"):
        done = command(*name.split(), f"{option}={value}")
        assert done.returncode == 2
        (told,) = done.stderr.decode().splitlines()
        assert option in told
