"""The option `--format` of the commands that print text or JSON."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import rich_click as click


def output_format(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the option `--format` (text or json) to a command, as its argument `style`."""
    return click.option(
        "--format",
        "style",
        type=click.Choice(["text", "json"]),
        default="text",
        show_default=True,
        help="For people or for programs.",
    )(command)
