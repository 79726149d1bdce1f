"""The completion scripts of bash, zsh and fish, and the way completions are handed to each.

They are click's own, with three differences: a value that goes on (`rgb=`, `tcp:`) gets no blank
behind it; in bash values with blanks, colons and `=` complete inside and outside of quotes; and in
fish a value may have commas.
"""

from __future__ import annotations

import os
import re
from typing import Any

from click.shell_completion import (
    BashComplete,
    CompletionItem,
    FishComplete,
    ZshComplete,
    add_completion_class,
    split_arg_string,
)

GOES_ON = ("=", ":", "/")
"""The ends of values that are not complete."""

_OTHER = {"'": '"', '"': "'"}
_SAFE = frozenset("%+,-./0123456789:=@ABCDEFGHIJKLMNOPQRSTUVWXYZ_abcdefghijklmnopqrstuvwxyz")

# Bash cuts words at = and : too. It tells what it will put the answer in place of ($2), and the
# line, from which the whole word can be told.
_BASH = """\
%(complete_func)s() {
    local type value
    compopt +o nospace
    while IFS=, read -r type value; do
        case $type in
            dir) compopt -o dirnames ;;
            file) compopt -o default ;;
            part) COMPREPLY+=("$value"); compopt -o nospace ;;
            plain) COMPREPLY+=("$value") ;;
        esac
    done < <(COMP_LINE="${COMP_LINE:0:COMP_POINT}" COMP_CURRENT="$2" \
%(complete_var)s=bash_complete "$1" 2>/dev/null)
}

complete -o nosort -F %(complete_func)s %(prog_name)s
"""


class Bash(BashComplete):
    """Completion for bash."""

    source_template = _BASH

    def get_completion_args(self) -> tuple[list[str], str]:
        """The words of the line before the last one, and the last one as far as it is typed."""
        line = os.environ["COMP_LINE"]
        words = split_arg_string(line)
        whole = not line[-1:].isspace() or len(split_arg_string(f"{line}x")) == len(words)
        self._typed = words.pop() if words[1:] and whole else ""
        return words[1:], self._typed

    def format_completion(self, item: CompletionItem[Any]) -> str:
        """The type, and what takes the place of the part of the word that bash replaces."""
        value = str(item.value)
        if item.type != "plain":
            return f"{item.type},{value}"
        current, quote = os.environ["COMP_CURRENT"], _open_quote(os.environ["COMP_LINE"])
        before = self._typed[: len(self._typed) - len(current)]
        if not self._typed.endswith(current) or not value.startswith(before):
            before = ""
        kind = "part" if value.endswith(GOES_ON) else "plain"
        rest = _requoted(value, quote)[len(before) :]
        if quote == '"':  # in which bash runs $(...) and what stands in backticks
            rest = re.sub(r"([$`\\])", r"\\\1", rest)
        if not quote and not set(rest) <= _SAFE:
            rest = f"'{rest}'"
        return f"{kind},{rest}"


def _requoted(value: str, quote: str) -> str:
    """A value in which no quotes are like the one around it, which is `'` unless one is open."""
    around = quote or "'"
    return "".join(_OTHER[char] if char == around else char for char in value)


def _open_quote(line: str) -> str:
    """The quote that is open at the end of a line, empty if none is."""
    quote, escaped = "", False
    for char in line:
        if escaped:
            escaped = False
        elif char == "\\" and quote != "'":
            escaped = True
        elif char in "'\"" and quote in ("", char):
            quote = "" if quote else char
    return quote


class Zsh(ZshComplete):
    """Completion for zsh."""

    source_template = ZshComplete.source_template.replace(
        'elif [[ "$type" == "dir" ]]',
        'elif [[ "$type" == "part" ]]; then\n            compadd -U -S "" -- "$key"\n'
        '        elif [[ "$type" == "dir" ]]',
    )

    def format_completion(self, item: CompletionItem[str]) -> str:
        """The type, the value and its help, a line each."""
        if item.type == "plain" and item.value.endswith(GOES_ON):
            return f"part\n{item.value}\n_"
        item.value = _requoted(item.value, _open_quote(os.environ["COMP_WORDS"]))
        return super().format_completion(item)


class Fish(FishComplete):
    """Completion for fish, which puts no blank behind a value that goes on."""

    source_template = FishComplete.source_template.replace(
        'string split ","', 'string split --max 1 ","'
    )

    def format_completion(self, item: CompletionItem[str]) -> str:
        """The type, the value and its help on a line."""
        item.value = _requoted(item.value, _open_quote(os.environ["COMP_CWORD"]))
        return super().format_completion(item)


def register() -> None:
    """Let click use these classes."""
    for shell in (Bash, Zsh, Fish):
        add_completion_class(shell)
