"""The option `--format text|json` of the text commands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import rich_click as click


def output_format(command: Callable[..., Any]) -> Callable[..., Any]:
    """The option that every command with machine output has."""
    return click.option(
        "--format",
        "style",
        type=click.Choice(["text", "json"]),
        default="text",
        show_default=True,
        help="For people or for programs.",
    )(command)
