"""A capture carries its grammar, and every command decodes it by that one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from bilprov import read_capture
from bilprov.analyzer.decode.records import HostRecord
from bilprov.analyzer.replay.recorder import RecordWriter, session_metadata
from bilprov.captures import topics
from bilprov.captures.reader import open_capture, open_indexed
from bilprov.captures.schemas import MS, Chunk
from bilprov.captures.storage.records import STRING_BYTES
from bilprov.spec.protocol import GrammarError, Protocol, grammar_hash, load
from tests.support.commands import Done, command
from tests.support.grammars import RELAY
from tests.support.robots import sentence
from tests.support.screens import terminal

START = 1_790_000_000_000_000_000

# Two instructions, the second out of its range, with their answers.
TRAFFIC = [(0, "host", "11 05"), (1, "device", "00"), (9, "host", "11 10"), (10, "device", "02")]

READERS = {
    "replay": ("replay", "{}", "--rate", "0"),
    "judge": ("replay", "{}", "--rate", "0", "--judge"),
    "stats": ("stats", "{}", "--json", "-"),
    "stats of two": ("stats", "{}", "{}", "--json", "-"),
    "export to CSV": ("export", "{}", "--format", "csv", "-o", "-"),
    "diff": ("capture", "diff", "{}", "{}"),
}
COPIES = {
    "cut": ("capture", "cut", "{}", "new.mcap", "--start", "0.005"),
    "cut with a filter": ("capture", "cut", "{}", "new.mcap", "--filter", "mask == 5"),
    "repair": ("capture", "repair", "{}", "new.mcap"),
    "decode": ("capture", "decode", "{}", "new.mcap"),
    "join": ("capture", "join", "{}", "later.mcap", "-o", "new.mcap"),
}


def about(protocol: Protocol, changes: Mapping[str, str | None] | None = None) -> dict[str, str]:
    """The metadata of a recording, with entries changed, or left out where they are None."""
    both: tuple[str, str] = ("host", "device")
    metadata: dict[str, str | None] = {
        **session_metadata(protocol, ports={}, line="", timeout=50 * MS, skew=0, heard=both),  # type: ignore[arg-type]
        **(changes or {}),
    }
    return {key: text for key, text in metadata.items() if text is not None}


def write(path: Path, metadata: Mapping[str, str], later: int = 0) -> Path:
    """A capture of the traffic, `later` seconds later than another."""
    with RecordWriter(path, START + later * 1_000_000_000, metadata) as out:
        for t, side, data in TRAFFIC:
            out.chunk(Chunk(t * MS, side, bytes.fromhex(data)))  # type: ignore[arg-type]
    return path


@pytest.fixture(scope="module")
def relay() -> Protocol:
    return load(RELAY, "relay.py")


@pytest.fixture
def file(tmp_path: Path, relay: Protocol) -> Path:
    (tmp_path / "relay.py").write_text(RELAY, encoding="utf-8")
    write(tmp_path / "later.mcap", about(relay), later=3)
    return write(tmp_path / "relay.mcap", about(relay))


@pytest.fixture
def told(tmp_path: Path, relay: Protocol) -> Callable[..., Path]:
    """Makes a capture whose metadata say something else."""
    return lambda **changes: write(tmp_path / "told.mcap", about(relay, changes))


def given(words: tuple[str, ...], path: Path, *more: str) -> Done:
    """Run a command on a file, in the file's folder."""
    return command(*(word.format(path.name) for word in words), *more, cwd=path.parent)


def names(path: Path, protocol: Protocol | None = None) -> list[str]:
    """The names of the instructions in a capture, as Python reads it."""
    records = read_capture(path, protocol)
    return [str(record.value.name) for record in records if isinstance(record, HostRecord)]


# -- read by it -----------------------------------------------------------------------------------


@pytest.mark.waits
def test_the_screen_decodes_a_capture_by_the_grammar_in_it(file: Path) -> None:
    with terminal(file.parent, (120, 30), "relay.mcap") as tmux:
        tmux.wait("4 rows")
        shown = tmux.wait(lambda lines: "Relays" in (text := "\n".join(lines)) and "q quit" in text)
        assert "mask=5" in "\n".join(shown)
        assert "another grammar" not in "\n".join(shown)


def test_a_text_of_any_lines_comes_back_as_it_was(tmp_path: Path, relay: Protocol) -> None:
    text = RELAY.replace("\n", "\r\n") + '# \\n \\x41 "\t\u2028 Ö\r\n'
    path = write(tmp_path / "a.mcap", about(load(text)))
    indexed = open_indexed(path)

    assert indexed
    assert indexed.grammar_text == open_capture(path).grammar_text == text
    assert topics.GRAMMAR_TEXT not in open_capture(path).metadata
    assert set(names(path)) == {"Relays"}


# -- what is not in the file, or cannot be used ---------------------------------------------------


def test_python_warns_of_a_grammar_that_is_not_there(told: Callable[..., Path]) -> None:
    with pytest.warns(UserWarning, match="recorded with another grammar"):
        names(told(grammar_text=None))


def test_one_capture_may_carry_the_grammar_of_another(
    file: Path, told: Callable[..., Path]
) -> None:
    made = given(COPIES["join"], told(grammar_text=None))

    assert made.returncode == 0
    assert names(file.with_name("new.mcap")) == ["Relays"] * 4


EVIL = "\nopen('witness', 'w')\n"


@pytest.mark.parametrize("name", ["judge", "stats of two", "export to CSV", "diff", *COPIES])
def test_a_text_that_does_more_than_declare_is_not_run(
    file: Path, told: Callable[..., Path], name: str
) -> None:
    text = RELAY + EVIL
    path = told(grammar_text=text, grammar_sha256=grammar_hash(text))
    later = file.with_name("later.mcap")
    later.unlink()
    write(later, {}, later=3)

    refused = given((READERS | COPIES)[name], path)

    assert refused.returncode == 2
    assert "told.mcap is not run, because it does more than declare" in sentence(refused)
    assert "--grammar FILE.py" in sentence(refused)
    assert not path.with_name("witness").exists()
    assert not path.with_name("new.mcap").exists()
    with pytest.raises(GrammarError, match="does more than declare"):
        names(path)
    asked = given(("replay", "{}", "--rate", "0", "--grammar", "relay.py"), path)
    assert b"Relays mask=5" in asked.stdout


@pytest.mark.parametrize(
    ("text", "piece"),
    [
        (RELAY.replace("2: Answer(", "1: Answer("), "told.mcap"),
        (RELAY.replace("relays=From", "lamp=From"), "told.mcap"),
        (RELAY.replace("Timing,", "Timing, Tempo,"), "it imports Tempo from bilprov.spec.fields"),
        ("", "which is not in it"),
    ],
    ids=["a code twice", "no such variable", "a word of another version", "nothing"],
)
def test_a_text_that_is_no_grammar_is_one_sentence(
    told: Callable[..., Path], text: str, piece: str
) -> None:
    path = told(grammar_text=text, grammar_sha256=grammar_hash(text))

    refused = given(COPIES["repair"], path)

    assert refused.returncode == 2
    assert piece in sentence(refused)
    assert "--grammar FILE.py" in sentence(refused)


@pytest.mark.parametrize("wrong", ["0, 14", "0, )("])
def test_a_text_that_is_not_what_its_hash_tells_is_damaged(
    told: Callable[..., Path], wrong: str
) -> None:
    path = told(grammar_text=RELAY.replace("0, 15", wrong))

    refused = given(READERS["stats"], path)

    assert refused.returncode == 2
    assert "the grammar in told.mcap is damaged" in sentence(refused)
    checked = command("capture", "check", str(path))
    assert checked.returncode == 2
    assert b"its grammar is damaged (the hash is another)" in checked.stdout


def test_a_text_too_long_for_the_metadata_is_left_out(tmp_path: Path) -> None:
    long = load(f"{RELAY}#{'x' * STRING_BYTES}\n", "long.py")
    path = write(tmp_path / "a.mcap", about(long))

    assert open_capture(path).grammar_text == ""
    assert b"recorded with another grammar" in given(READERS["replay"], path).stderr
