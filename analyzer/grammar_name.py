"""The type of an argument that names a grammar; shells complete it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem


class GrammarName(click.Path):
    """The name of a grammar that the kit has, or the file of another one."""

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem[str]]:
        """The names that begin so, and files."""
        from click.shell_completion import CompletionItem

        from bilprov.analyzer.grammar_file import SHIPPED

        names = [CompletionItem(name) for name in SHIPPED if name.startswith(incomplete)]
        return names + super().shell_complete(ctx, param, incomplete)
