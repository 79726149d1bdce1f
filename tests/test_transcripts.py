"""The golden outputs: command lines, and word by word what they print and which files they make.

A page of `tests/transcripts/` holds sections. Each is played in an empty folder, in this process;
the first characters of a line give its meaning:

    == TITLE            begins a section; `(slow)` in its title leaves it to `make whole`
    @ NAME              a file that a test writes, with the lines `: TEXT` below as its content;
                        of a capture they are `KEY = VALUE` (metadata) and `SECONDS SIDE HEX`
    @ NAME -> NAME      a link
    & FAULT             a simulated device is served for the section, as PORT with the probe PROBE;
                        the name of a fault or of a legal variant, or `none`
    $ COMMAND | FILTER  what is run, `NAME=VALUE` of its environment first; a filter of FILTERS
                        condenses its standard output
    < TEXT              its standard input, with Python's escapes
    > TEXT, ! TEXT      its standard output, its standard error
    ? STATUS            its exit status, unless it is 0
    + NAME, | TEXT      a file that it made or changed, and what is in it
    # TEXT              a comment

A file of the fixture `given` is there where a section names it. What follows `$` is written by
hand, what is expected by `make transcripts`.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import re
import shlex
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from difflib import unified_diff
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from bilprov.analyzer.version import kit_version
from bilprov.captures.schemas import Chunk, Line
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.catalogue import find_fault
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.captures import write_capture
from tests.support.commands import command
from tests.support.decoding import Event
from tests.support.drawn_grammars import drawn
from tests.support.grammars import wide_grammar
from tests.support.robots import served_here

PAGES = sorted((ROOT / "tests" / "transcripts").glob("*.txt"))
LONGEST = 60  # lines of a made file that are shown
START = 1_700_000_000_000_000_000  # ns; when the captures of `@` begin, 2023-11-14T22:13:20Z

TODAY = datetime.now(UTC)

# What differs from run to run, from machine to machine or from version to version.
CHANGING = [
    (rf"\b{re.escape(kit_version())}\b", "VERSION"),
    (rf"(host `?|hostname=\"|recorded on +){re.escape(socket.gethostname())}\b", r"\1HOST"),
    (r"\b[0-9a-f]{64}\b", "SHA256"),
    (r"\bsha256-[\w+/]{43}=", "sha256-HASH"),
    (r"Python [\d.]+\S*, platform [^,\n]+, pyserial [\d.]+, construct [\d.]+", "VERSIONS"),
    *((rf"{TODAY + timedelta(n):%Y-%m-%d}[T ][\d:.]+(?=[+Z ])", "NOW") for n in (0, 1)),
    (r"ports here: [^;]+(; did you mean [^;]+)?;", "ports here: PORTS;"),
    (r"(?<=took\" value=\")\d+\.\d s", "T s"),
    (r"\btook (`?)\d+\.\d s", r"took \1T s"),
]
# What is sent to a device is timed by a real clock, and on a busy machine it answers late.
LATE = (r"  answered after [\d.]+ ms, \d+ ms is the deadline", "")
TIMED = [(r"(?m)^ *\d+\.\d{6}(?= )", "T"), (r" *\b\d+\.\d{3} ms", " N ms"), LATE]


def sections() -> dict[str, list[str]]:
    """The lines of each section, by the page's name and the section's title."""
    found: dict[str, list[str]] = {}
    for page in PAGES:
        for part in page.read_text(encoding="utf-8").split("\n\n"):
            lines = part.strip("\n").split("\n")
            found[f"{page.stem}: {lines[0].removeprefix('== ')}"] = lines
    return found


SECTIONS = sections()


@pytest.fixture(scope="module")
def given(grammar_text: str, horn_text: str) -> dict[str, bytes]:
    """The content of the files that are there where a section names them."""
    samples = ROOT / "captures" / "samples"
    sample, older = (samples / "examples.mcap").read_bytes(), samples / "older"
    return {
        "examples.mcap": sample,
        "cut-off.mcap": sample[:9000],
        "killed.mcap": sample[: int.from_bytes(sample[-28:-20], "little") - 13],  # without its end
        "damaged.mcap": sample[:6000] + bytes(64) + sample[6064:],
        "conform.mcap": gzip.decompress((older / "conform.mcap.gz").read_bytes()),
        "old-horn.txt": (older / "horn-grammar.txt").read_bytes(),
        **{file.name: file.read_bytes() for file in older.glob("*.*") if file.suffix != ".gz"},
        "horn.py": horn_text.encode(),
        **{file.name: file.read_bytes() for file in (ROOT / "examples").glob("*.py")},
        "wide.py": wide_grammar(grammar_text).encode(),
        "drawn.py": drawn(1).text.encode(),
    }


def keys(text: str) -> list[str]:
    """The keys of each object in JSON or JSON lines, in their order, by the object's path."""
    found: dict[str, dict[str, None]] = {}

    def walk(value: Any, path: str) -> None:
        if isinstance(value, dict):
            found.setdefault(path, {}).update(dict.fromkeys(value))
            for key, below in value.items():
                walk(below, f"{path}.{key}")
        for below in value if isinstance(value, list) else ():
            walk(below, f"{path}[]")

    at, decoder = 0, json.JSONDecoder()
    while at < len(text.rstrip()):
        value, at = decoder.raw_decode(text, at + len(text[at:]) - len(text[at:].lstrip()))
        walk(value, "")
    return [f"{path or '.'}: {', '.join(names)}" for path, names in found.items()]


def digest(lines: list[str]) -> str:
    """How many lines, and a hash that shows whether any of them has changed."""
    return f"{len(lines)} lines, {hashlib.sha256(chr(10).join(lines).encode()).hexdigest()[:16]}"


def families(text: str) -> list[str]:
    """The first part of the ids of cases, with the count and a hash of the ids that have it."""
    ids = [line.split()[0] for line in text.splitlines()]
    names = dict.fromkeys(ident.split("/")[0] for ident in ids)
    return [f"{name}: {digest([i for i in ids if i.split('/')[0] == name])}" for name in names]


FILTERS: dict[str, Callable[[str], list[str]]] = {
    "keys": keys,
    "families": families,
    "head": lambda text: text.splitlines()[:3],
    "digest": lambda text: [digest(text.splitlines())],
}


def capture_lines(path: Path) -> Iterator[str]:
    """The topics of a capture with their encodings, schemas and counts, and its metadata's keys."""
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary
        assert summary.statistics
        for channel in sorted(summary.channels.values(), key=lambda channel: channel.topic):
            schema = summary.schemas.get(channel.schema_id)
            form = ["no schema"]
            if schema:
                form = [schema.name, schema.encoding, digest([schema.data.decode()])[9:]]
            count = summary.statistics.channel_message_counts.get(channel.id, 0)
            yield f"{channel.topic}  {channel.message_encoding}  {'  '.join(form)}  {count}"
        for metadata in reader.iter_metadata():
            yield f"metadata {metadata.name}: {', '.join(metadata.metadata)}"
        for attached in reader.iter_attachments():
            yield f"attachment {attached.name}"


def file_lines(path: Path) -> list[str]:
    """What a transcript shows of a file that a command made."""
    if path.suffix == ".mcap":
        return list(capture_lines(path))
    content = path.read_bytes()
    if path.suffix == ".json":
        return steady("\n".join(keys(content.decode())), path.parent).split("\n")
    if b"\0" in content or path.suffix == ".html":
        return [f"begins with {content[:16]!r}"]
    lines = steady(content.decode(), path.parent).splitlines()
    return lines if len(lines) <= LONGEST else [*lines[:10], f"... {digest(lines)}"]


def write(path: Path, lines: list[str]) -> None:
    """Write a file of a section: a capture from its events, any other as it stands."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if " -> " in path.name:
        link, _, target = path.name.partition(" -> ")
        path.with_name(link).symlink_to(target)
        return
    if path.suffix != ".mcap":
        path.write_bytes("".join(f"{line}\n" for line in lines).encode())
        return
    metadata = dict(line.split(" = ", 1) for line in lines if " = " in line)
    events: list[Event] = []
    for seconds, side, rest in (f"{line}  ".split(" ", 2) for line in lines if " = " not in line):
        t = round(float(seconds) * 1e9)
        if side in ("host", "device"):
            events.append(Chunk(t, side, bytes.fromhex(rest)))  # type: ignore[arg-type]
        else:
            events.append(Line(t, side, "", rest.strip()))  # type: ignore[arg-type]
    write_capture(path, events, metadata, START)


def steady(text: str, folder: Path, changing: list[tuple[str, str]] = CHANGING) -> str:
    """A text without what differs from run to run."""
    text = text.replace(str(folder), "DIR").replace(str(ROOT), "ROOT")
    for pattern, word in changing:
        text = re.sub(pattern, word, text)
    return text


def states(folder: Path) -> dict[Path, tuple[int, int]]:
    """When each file was written, and its size."""
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    return {file: (file.stat().st_mtime_ns, file.stat().st_size) for file in files}


def ran(line: str, stdin: str, folder: Path, names: dict[str, str]) -> Iterator[str]:
    """What a transcript shows of a command below its line. `names` are PORT and PROBE."""
    said, *filters = line.split(" | ")
    for name, device in names.items():
        said = said.replace(name, device)
    before = states(folder)
    words = shlex.split(said)
    program = words.index("bilprov")
    done = command(
        *words[program + 1 :],
        stdin=stdin.encode().decode("unicode_escape").encode("latin-1"),
        cwd=folder,
        **{"TZ": "UTC"} | dict(word.split("=", 1) for word in words[:program]),
    )
    for mark, stream in (">", done.stdout), ("!", done.stderr):
        text = stream.decode(errors="backslashreplace").replace("\r", "\\r")
        text = steady(text, folder, CHANGING + TIMED * bool(re.search(r"\bsend (sim|PORT)", line)))
        if mark == ">" and filters:
            text = steady("\n".join(FILTERS[filters[0]](text)), folder)
        for name, device in names.items():
            text = text.replace(device, name)
        yield from (f"{mark} {shown}".rstrip() for shown in text.splitlines())
    if done.returncode:
        yield f"? {done.returncode}"
    for file in (file for file, state in states(folder).items() if before.get(file) != state):
        yield f"+ {file.relative_to(folder)}"
        yield from (f"| {shown}".rstrip() for shown in file_lines(file))


def played(
    lines: list[str], folder: Path, given: dict[str, bytes], protocol: Protocol
) -> list[str]:
    """The section with what its commands print and make now."""
    for name in (name for name in given if any(name in line for line in lines)):
        (folder / name).write_bytes(given[name])
    entries: list[list[str]] = []
    for line in (line for line in lines if line[:1] not in tuple(">!?+|")):
        if line[:1] in (":", "<"):
            entries[-1].append(line)
        else:
            entries.append([line])
    shown: list[str] = []
    names: dict[str, str] = {}
    with ExitStack() as stack:
        for head, *more in entries:
            shown += [head, *more]
            kind, text, below = head[:1], head[2:], [line[2:] for line in more]
            if kind == "@":
                write(folder / text, below)
            elif kind == "&":
                fault = find_fault(protocol, text) if text != "none" else None
                served = served_here(Simulator(protocol, fault), pty=True)
                names = dict(zip(("PORT", "PROBE"), stack.enter_context(served), strict=True))
            elif kind == "$":
                shown += ran(text, "\n".join(below), folder, names)
    return shown


def marked(name: str) -> Any:
    """A section as a row of the test, with the marks of what it takes."""
    waits = any(re.search(r"^& |\b(send|sniff) sim\b", line) for line in SECTIONS[name])
    marks = [pytest.mark.waits] * waits
    if name.endswith("(slow)"):
        marks += [pytest.mark.slow, pytest.mark.sample(0)]
    return pytest.param(name, marks=marks, id=name.removesuffix(" (slow)"))


@pytest.mark.parametrize("name", [marked(name) for name in SECTIONS])
def test_commands_print_what_they_printed(
    name: str,
    tmp_path: Path,
    given: dict[str, bytes],
    protocol: Protocol,
    request: pytest.FixtureRequest,
) -> None:
    expected = SECTIONS[name]

    found = played(expected, tmp_path, given, protocol)

    if request.config.getoption("--rewrite-transcripts"):
        page = ROOT / "tests" / "transcripts" / f"{name.partition(':')[0]}.txt"
        text = page.read_text(encoding="utf-8")
        assert text.count("\n".join(expected)) == 1
        page.write_text(text.replace("\n".join(expected), "\n".join(found)), encoding="utf-8")
        return
    change = "\n".join(unified_diff(expected, found, "expected", "found", lineterm="", n=1))
    assert not change, change


def test_a_page_is_small_enough_to_be_read() -> None:
    assert [page.name for page in PAGES if page.stat().st_size > 100_000] == []
