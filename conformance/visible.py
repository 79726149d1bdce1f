"""Makes foreign text safe to show: what controls a terminal or fools a reader becomes visible."""

from __future__ import annotations

import re
from typing import Any

# C0 and C1 controls, halves of surrogate pairs, marks that turn the direction of text or are
# invisible, line and paragraph separators, and what no XML may hold.
_UNSEEN = re.compile(
    "[\x00-\x1f\x7f-\x9f\xad\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ud800-\udfff\ufeff"
    "\ufff9-\ufffb\ufffe\uffff]"
)


def visible(text: str) -> str:
    """The text with each control character, bidi mark and lone surrogate as an escape: `\\x1b`."""
    return _UNSEEN.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def all_visible(value: Any) -> Any:
    """A value made of dicts and lists, with every string in it made visible."""
    if isinstance(value, str):
        return visible(value)
    if isinstance(value, dict):
        return {all_visible(key): all_visible(inner) for key, inner in value.items()}
    return [all_visible(inner) for inner in value] if isinstance(value, list | tuple) else value
