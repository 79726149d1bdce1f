"""The frame of a self-contained page: its head, the style that all pages share, and its policy.

The page has a Content-Security-Policy that lets only its own script and style run, by their hashes.
"""

from __future__ import annotations

import base64
import hashlib
from pathlib import Path

from bilprov.analyzer.html.markup import Safe, joined, tag

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
