"""What may come next in a filter at a cursor: for the screen's filter line, and for shells."""

from __future__ import annotations

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bilprov.analyzer.filters.completion import completions
from bilprov.analyzer.filters.fields import fields_of
from bilprov.analyzer.filters.syntax import place_at_end
from bilprov.spec.protocol import Protocol
from tests.support.expressions import expressions


def offered(text: str, protocol: Protocol) -> list[str]:
    """The texts that a cursor at the end is offered, with what stands before them."""
    found = completions(text, len(text), protocol)
    return [text[: one.start] + one.text for one in found]


@pytest.mark.parametrize(
    ("text", "whole"),
    [
        ("na", ["name"]),
        ("NA", ["name"]),
        ("name ", ["name ==", "name !=", "name in", "name contains"]),
        ("name == fo", ["name == Forward"]),
        ("name==fo", ["name==Forward"]),
        ("direction == ", ["direction == host", "direction == device"]),
        ("direction ==", ["direction ==host", "direction ==device"]),
        ("speed > 3", ["speed > 3 and", "speed > 3 or"]),
        ("speed > ", []),
        ("name in ", ["name in {"]),
        ("name in {sp", ["name in {Speed"]),
        ("rgb in 1..", []),
        ("id in 1..ro", ["id in 1..RotateRight", "id in 1..RotateLeft"]),
        ("name in {Speed, ro", ["name in {Speed, RotateRight", "name in {Speed, RotateLeft"]),
        ("name in {Speed ", ["name in {Speed ,", "name in {Speed }"]),
        ("speed > 3 ", ["speed > 3 and", "speed > 3 or"]),
        ("(speed > 3 ", ["(speed > 3 and", "(speed > 3 or", "(speed > 3 )"]),
        ("faults contains lo", ["faults contains 'lost bytes'"]),
        ("faulty and not str", ["faulty and not strength"]),
        ("state.moving == ", ["state.moving == true", "state.moving == false"]),
        ("fields.s", ["fields.speed", "fields.strength"]),
        ("name == 'Speed'", ["name == 'Speed' and", "name == 'Speed' or"]),
        ("(faulty)", [f"(faulty) {word}" for word in ("==", "!=", "and", "or")]),
        ("data[0] ", [f"data[0] {s}" for s in ("==", "!=", "<", "<=", ">", ">=", "in", "&")]),
        ("sped ", []),
        ("name == Horn and) ", []),
        ("'lo", []),
        ("x" * 2000, []),
    ],
)
def test_what_may_come_next(protocol: Protocol, text: str, whole: list[str]) -> None:
    assert offered(text, protocol) == whole


def test_an_empty_line_is_offered_every_name_once(each_protocol: Protocol) -> None:
    names = [name for name in fields_of(each_protocol) if not name.startswith("fields.")]

    assert offered("", each_protocol) == [*names, "not"]
    assert all(one.says for one in completions("", 0, each_protocol))


def test_the_names_of_another_grammar_are_offered(horn: Protocol) -> None:
    assert offered("name == ho", horn) == ["name == Horn"]
    assert offered("so", horn) == ["sound"]
    assert completions("id == ho", 8, horn)[0].says == "id 9"


def test_what_stands_behind_the_cursor_does_not_matter(protocol: Protocol) -> None:
    assert completions("name == fo and faulty", 10, protocol)[0].text == "Forward"


@given(data=st.data())
def test_what_is_offered_leads_on_to_a_filter(each_protocol: Protocol, data: st.DataObject) -> None:
    text = data.draw(expressions(each_protocol))
    cursor = data.draw(st.integers(0, len(text)))

    found = offered(text[:cursor], each_protocol)
    for whole in found[:2] + found[-3:]:
        assert place_at_end(whole) is not None, whole


@settings(max_examples=40)
@given(data=st.data())
def test_a_filter_can_be_typed_by_what_is_offered(
    each_protocol: Protocol, data: st.DataObject
) -> None:
    """Wherever nothing is offered, or a number may come, one is typed."""
    text = ""
    for _ in range(data.draw(st.integers(1, 12))):
        found = offered(text, each_protocol)
        if not found or re.search(r"(\d|[<>=.])$", text):
            typed = "11 " if re.search(r"(data|hex|bytes)\W+(not )?\w*\W*$", text) else "1 "
            text += "'a' " if "reason" in text[-12:] else typed
            continue
        text = data.draw(st.sampled_from(found)) + " "

    assert place_at_end(text) is not None, text
