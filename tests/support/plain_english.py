"""Turns of phrase that readers stop at: patterns, checked in whatever text people read.

CONTRIBUTING.md lists them with what to write instead. A test that holds other texts to them, such
as messages or help, calls `turns(text)` on each.
"""

from __future__ import annotations

import re

# Each pattern, with an example of it that CONTRIBUTING.md lists. Programs report, show, print and
# write; they do not talk.
TURNS = {
    r"tells?|told|telling": "tells, told",
    r"says?|said|saying": "says, said",
    r"read out of": "read out of",
    r"(ends?|ended|ending) (with|in) [0-3]\b(?! (ms|s|bytes?|frames?)\b)": "ends with 2",
    r"(a|an|the|each|every|its|one|no|of|few|many) looks?(?! (for|like)\b)(?!ed\b)": "a look",
    r"(one|an?) (object|line|row|message|bit|byte) an? (frame|case|line|byte|part)": (
        "one object a frame"
    ),
    r"anew": "anew",
    r"mend(s|ed|ing)?": "mends",
    r"some \d[\d,.]*": "some 8 minutes",
    r"(every|each|any) (other )?way out": "every way out",
    r"(would|is|are|could|will) else": "would else",
    r"held against": "held against",
    r"that there (is|are)": "all that there is",
    r"so (does|do) (it|every|each|the)": "so does every",
    r"(is|are) no (code|name|value|part|command|capture|row|number|file)s?": "is no code",
    r"heard on": "is heard on",
    r"goes wrong may": "what goes wrong may",
    r"next \w+ but one": "the next section but one",
    r"for the sake of": "for the sake of",
}
_ANY = re.compile(rf"\b(?:{'|'.join(TURNS)})\b", re.IGNORECASE)


def turns(text: str) -> list[str]:
    """The turns in a text that people read, each with some words around it."""
    plain = " ".join(text.split())
    return [plain[max(0, m.start() - 30) : m.end() + 30] for m in _ANY.finditer(plain)]


def prose(page: str) -> str:
    """The prose of a Markdown page: without code, and without what a program wrote."""
    text = re.sub(r"^<!-- .*?^<!-- .*?-->$", "", page, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"^```\w*$.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"`[^`\n]*`", "`code`", text)
