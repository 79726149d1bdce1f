"""Builds HTML from foreign text, escaped so that it cannot become markup or script.

A page is self-contained, has the style that all pages share, and a Content-Security-Policy that
lets only its own script and style run, by their hashes.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from string import Template

from bilprov.captures.text import escape_controls


class Safe(str):
    """Markup that is already safe to write out."""

    __slots__ = ()


def text(value: object) -> Safe:
    """A value as text, escaped."""
    return value if isinstance(value, Safe) else Safe(html.escape(escape_controls(str(value))))


def tag(name: str, *content: object, **attributes: object) -> Safe:
    """An element; content that is not Safe is escaped, and so is every attribute's value.

    An attribute whose value is None or False is left out, one that is True stands alone; a trailing
    underscore of its name is dropped, other underscores become dashes.
    """
    told = "".join(
        f" {key.rstrip('_').replace('_', '-')}" + ("" if value is True else f'="{text(value)}"')
        for key, value in attributes.items()
        if value is not None and value is not False
    )
    return Safe(f"<{name}{told}>{joined(content)}</{name}>")


def joined(parts: Iterable[object]) -> Safe:
    """Parts one after another."""
    return Safe("".join(text(part) for part in parts))


def filled(template: Path, **parts: object) -> Safe:
    """What a template file holds, each $name replaced by that part; parts not Safe are escaped."""
    return Safe(_read(template).substitute({name: text(part) for name, part in parts.items()}))


@cache
def _read(template: Path) -> Template:
    return Template(template.read_text(encoding="utf-8"))


def bar(width: int, parts: Iterable[tuple[str, str, str]]) -> Safe:
    """A strip, `width` units wide; a part is where it begins, its width, and what it shows."""
    rects = (
        tag("rect", x=x, y="0", width=size, height="8", class_=f"b-{name}")
        for x, size, name in parts
    )
    return tag(
        "svg", *rects, viewBox=f"0 0 {width} 8", preserveAspectRatio="none", class_="bar",
        aria_hidden="true",
    )  # fmt: skip


def json_block(ident: str, value: object) -> Safe:
    """A value as JSON inside a page; nothing in it can end the block or a line of script."""
    written = json.dumps(value, separators=(",", ":"))  # ASCII only: no U+2028 either
    for sign in "<>&":
        written = written.replace(sign, f"\\u{ord(sign):04x}")
    return Safe(f'<script type="application/json" id="{ident}">{written}</script>')


_STYLE = Path(__file__).parent / "assets" / "page.css"


def html_page(title: str, body: Safe, *, style: str, script: str) -> str:
    """A whole page, whose own style comes after the shared one; the script runs at its end."""
    style = _STYLE.read_text(encoding="utf-8") + style
    policy = (
        f"default-src 'none'; script-src '{_hash(script)}'; style-src '{_hash(style)}'; "
        "base-uri 'none'; form-action 'none'"
    )
    head = joined(
        [
            Safe('<meta charset="utf-8">'),
            Safe(f'<meta http-equiv="Content-Security-Policy" content="{policy}">'),
            Safe('<meta name="viewport" content="width=device-width, initial-scale=1">'),
            Safe('<meta name="color-scheme" content="light dark">'),
            tag("title", title),
            tag("style", Safe(style)),
        ]
    )
    page = tag("html", tag("head", head), tag("body", body, tag("script", Safe(script))), lang="en")
    return f"<!doctype html>\n{page}\n"


def _hash(content: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}"
