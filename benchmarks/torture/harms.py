"""The harms in the order in which docs/RELIABILITY.md has them, and that page."""

from __future__ import annotations

from collections.abc import Mapping

from benchmarks.torture import changes, damage, exits, floods, hostile, kills, noise, unplugs

_HEAD = """# Reliability

What was done to bilprov, how often, and what was lost. `make torture` does it all again and
writes this page, on two cores in two to three hours; the command under each table does that part
alone. Where something was lost that may not be, the row says **no**. [captures.md](captures.md)
has the limits.
"""

_CAPTURES = damage.HARM, changes.HARM, hostile.HARM, kills.HARM
_DEVICES = unplugs.HARM, *exits.HARMS, floods.HARM, noise.HARM
HARMS = {harm.name: harm for harm in _CAPTURES + _DEVICES}


def page(done: Mapping[str, str], before: str = "") -> str:
    """The page with the sections of what was done, by name; of other harms those of `before`."""
    sections = {part.partition("\n")[0]: part for part in before.split("\n## ")[1:]}
    sections |= {HARMS[name].title: section for name, section in done.items()}
    titles = [harm.title for harm in HARMS.values()]
    return "\n## ".join([_HEAD, *(sections[title] for title in titles if title in sections)])
