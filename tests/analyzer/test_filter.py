"""Filter expressions: which lines they let pass, and the messages for invalid ones."""

from __future__ import annotations

import pytest
from bilprov.analyzer.output.filter import FilterError, compile_filter

from bilprov.analyzer.decode.json_lines import JsonLine, json_line
from bilprov.analyzer.decode.session import Session
from bilprov.captures.schemas import Line
from bilprov.spec.protocol import Protocol
from tests.support.decoding import MS, conversation, decoded

TALK = [
    (b"\x11\x7f", b"\0"),
    (b"\x20", b"\0"),
    (b"\x81\x09", b"\0"),
    (b"\x41\x40", b"\0"),
    (b"\x9f" + bytes(15), b"\1"),
]


@pytest.fixture(scope="module")
def lines(protocol: Protocol) -> list[JsonLine]:
    events = [*conversation(TALK), Line(9000 * MS, "break", "host")]
    found = [json_line(record) for record in decoded(Session(protocol), events)]
    return [line for line in found if line is not None]


@pytest.mark.parametrize(
    ("text", "passing"),
    [
        ("name == Speed", ["11 7f"]),
        ("name == 'Speed'", ["11 7f"]),
        ("name in (Speed, Forward)", ["11 7f", "20"]),
        ("speed > 100", ["11 7f"]),
        ("100 < speed <= 127", ["11 7f"]),
        ("fields.speed == 0x7f", ["11 7f"]),
        ("strength != 1", ["41 40"]),
        ("direction == host and not faulty", ["11 7f", "20", "41 40"]),
        ("kind == response and agrees == False", ["00"]),
        ("'disagreeing' in faults", ["00"]),
        ("faults == ('disagreeing',)", ["00"]),
        ("hex == '81 09' or judgement == BAD_HEADER", ["81 09", "9f" + " 00" * 15, "01"]),
        ("'LED' in reason and direction == host", ["81 09"]),
        ("state.motion == forward and direction == host", ["20"]),
        ("state.moving and kind == instruction", ["20"]),
        ("sequence == 4", ["9f" + " 00" * 15]),
        ("answers == 4", ["01"]),
        ("latency >= 0.001 and judgement == BAD_DATA", ["00"]),
        ("kind == fault", [""]),
        ("t > -1 and t < 0.03", ["11 7f", "00"]),
        ("name not in ('Speed', OK) and direction == device", ["01"]),
        (" name ==\nSpeed ", ["11 7f"]),
    ],
)
def test_a_filter_lets_pass_the_lines_that_it_describes(
    protocol: Protocol, lines: list[JsonLine], text: str, passing: list[str]
) -> None:
    test = compile_filter(text, protocol)

    assert [line.hex for line in lines if test(line)] == passing


@pytest.mark.parametrize("text", ["speed == 1 or speed != 1", "speed not in (1, 2)", "speed >= 0"])
def test_comparing_what_a_line_does_not_have_is_false(
    protocol: Protocol, lines: list[JsonLine], text: str
) -> None:
    test = compile_filter(text, protocol)

    assert {line.name for line in lines if test(line)} == {"Speed"}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["does not parse", "column 1", "allowed are"]),
        ("faulty and", ["does not parse", "allowed are"]),
        ("sped > 1", ["column 1", "'sped'", "did you mean speed", "--help"]),
        ("zzz", ["column 1", "'zzz' is no name here; --help says which there are"]),
        ("faulty or nam == Speed", ["column 11", "'nam'"]),
        ("speed", ["column 1", "number", "compare"]),
        ("name", ["text", "compare"]),
        ("speed > 'a'", ["column 9", "text", "number"]),
        ("name == 1", ["never true"]),
        ("name in Speed and speed in 3", ["never true"]),
        ("name in ()", ["one or more values"]),
        ("faults < ('slow',)", ["list of text", "never true"]),
        ("agrees < True", ["truth", "never true"]),
        ("name in (Speed, 1)", ["one kind"]),
        ("speed is 1", ["allowed are"]),
        ("None", ["not allowed"]),
        ("x" * 1001, ["1001 characters", "1000"]),
        ("(" * 400, ["does not parse"]),
        ("a\0b", ["filter"]),
    ],
)
def test_what_is_no_filter_is_said_with_place_and_what_is_allowed(
    protocol: Protocol, text: str, words: list[str]
) -> None:
    with pytest.raises(FilterError) as caught:
        compile_filter(text, protocol)

    sentence = str(caught.value)
    assert all(word in sentence for word in words), sentence
    assert sentence.isprintable()


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')",
        "(1).__class__ == 1",
        "name.__class__ == 'x'",
        "[x for x in (1, 2)]",
        "(lambda: 1)() == 1",
        "9**9**9 > 1",
        "f'{name}' == 'x'",
        "name[0] == 'S'",
        "(name := 'x') == 'x'",
        "speed + 1 > 3",
        "await_ == 1",
        "True if faulty else False",
    ],
)
def test_nothing_but_the_language_is_run(protocol: Protocol, text: str) -> None:
    with pytest.raises(FilterError):
        compile_filter(text, protocol)


def test_another_grammars_fields_and_names_are_known(horn: Protocol, protocol: Protocol) -> None:
    events = conversation([(b"\x91\x02", b"\0"), (b"\x91\x00", b"\0")])
    lines = [json_line(record) for record in decoded(Session(horn), events)]
    test = compile_filter("name == Horn and sound > 1", horn)

    assert [line.hex for line in lines if line and test(line)] == ["91 02"]
    with pytest.raises(FilterError):
        compile_filter("sound > 1", protocol)
