"""The screen over damaged traffic of grammars that are not the car's: every row, key and pane."""

from __future__ import annotations

from pathlib import Path

import pytest

from bilprov.analyzer.decode.records import DeviceRecord
from bilprov.analyzer.decode.stream import StreamDecoder
from bilprov.analyzer.screen.browser import Browser
from bilprov.analyzer.screen.details import details
from bilprov.analyzer.screen.frame_list import words_of
from bilprov.analyzer.screen.keys import ORDINARY, REFUSAL
from bilprov.captures.schemas import MS, Chunk
from bilprov.spec.codec import build, judge, raw_frame
from bilprov.spec.protocol import Protocol, load
from bilprov.spec.replies import build_reply
from tests.support.framed_traffic import FRAMED, odd_traffic
from tests.support.screens import browser, operated, text_of
from tests.support.traffic import told

KEYS = (
    *("enter", "j", "j", "k", "h", "l", "escape", "t", "t", "t", "r", "r", "j"),
    *("n", "N", "e", "e", "y", "question_mark", "escape", "f", "f", "G"),
)


def on_screen(protocol: Protocol, odd: float = 0.5) -> Browser:
    events = odd_traffic(protocol, count=12, odd=odd)
    return browser(protocol, told(StreamDecoder(protocol), events, [len(events)]))


def unused(protocol: Protocol, length: int) -> bytes:
    """A frame of an unused ID with so many data bytes."""
    return raw_frame(protocol, protocol.unused_ids[0], length, bytes(range(200, 200 + length)))


@pytest.mark.slow
@pytest.mark.sample(1)
@pytest.mark.parametrize("size", [(100, 30), (80, 24)])
@pytest.mark.parametrize("grammar", FRAMED)
async def test_every_row_can_be_chosen_and_looked_into(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, grammar: str, size: tuple[int, int]
) -> None:
    monkeypatch.chdir(tmp_path)

    screen = on_screen(load(FRAMED[grammar]))
    async with operated(screen, size) as pilot:
        for row in range(screen.frames.count):
            await pilot.press("j")
            assert screen.frames.cursor == min(row + 1, screen.frames.count - 1)
        await pilot.press("g", *KEYS)
        await pilot.press("x", *"rows.csv", "enter")
        await screen.workers.wait_for_complete()
        assert len(text_of(screen)) == size[1]
    assert (tmp_path / "rows.csv").read_text()


def test_an_answer_shows_its_fields_and_what_it_answers() -> None:
    protocol = load(FRAMED["roboclaw"])
    asked = build(protocol, "MainBattery", {"address": 0x80})
    answer = build_reply(protocol, judge(protocol, asked), {"voltage": 123})
    events = [Chunk(0, "host", asked), Chunk(MS, "device", answer)]
    (batch,) = told(StreamDecoder(protocol), events, [2])
    record = batch.records()[1]
    assert isinstance(record, DeviceRecord)
    shown = {line.label: line.text for line in details(protocol, record, state=False)}
    assert shown["voltage"] == "0000 0000 0111 1011  123  tenths of a volt"
    assert shown["answers"] == f"{asked.hex(' ')}  @128 MainBattery"


@pytest.mark.parametrize(
    ("grammar", "words"),
    [("modbus_rtu", " --grammar modbus-rtu"), ("roboclaw", " --grammar FILE.py")],
)
async def test_a_copied_frame_names_its_grammar(grammar: str, words: str) -> None:
    screen = on_screen(load(FRAMED[grammar], "in a.mcap"), odd=0)
    async with operated(screen) as pilot:
        await pilot.press("j", "y")
        assert screen.said.startswith("copied: bilprov send PORT '")
        assert screen.said.endswith(f"'{words}")


async def test_the_bytes_have_room_for_a_frame_where_there_is_some() -> None:
    protocol = load(FRAMED["roboclaw"])
    asked = build(protocol, "ForwardM1", {"address": 0x80, "speed": 64})
    screen = browser(protocol, told(StreamDecoder(protocol), [Chunk(0, "host", asked)], [1]))

    async with operated(screen, (100, 30)):
        assert any(f" {asked.hex(' ')} " in line for line in text_of(screen))


async def test_a_long_frame_is_shown_whole_on_a_wide_screen_and_cut_on_a_small_one(
    protocol: Protocol,
) -> None:
    frame = unused(protocol, protocol.data_lengths[-1])
    screen = browser(protocol, told(StreamDecoder(protocol), [Chunk(0, "host", frame)], [1]))

    async with operated(screen, (200, 30)) as pilot:
        assert any(f" {frame.hex(' ')} " in line for line in text_of(screen))
        await pilot.resize_terminal(80, 24)
        await pilot.pause()
        assert any(f" {frame[:3].hex(' ')} " in line for line in text_of(screen))


async def test_a_latency_is_shown_whole_or_not_at_all() -> None:
    protocol = load(FRAMED["modbus_rtu"])
    asked = build(protocol, "ReadHoldingRegisters", {"address": 247, "start": 0, "quantity": 2})
    answer = build_reply(protocol, judge(protocol, asked), {"values": (0, 0)})
    events = [Chunk(0, "host", asked), Chunk(13 * MS, "device", answer)]
    screen = browser(protocol, told(StreamDecoder(protocol), events, [2]))

    async with operated(screen, (80, 24)) as pilot:
        assert not any("13." in line.split("values=0 0")[-1] for line in text_of(screen)[:4])
        await pilot.resize_terminal(120, 30)
        await pilot.pause()
        assert any("values=0 0   13.00 ms" in line for line in text_of(screen))


def test_data_without_a_field_are_one_line_that_lights_them_all(protocol: Protocol) -> None:
    frame = unused(protocol, 3)
    (batch,) = told(StreamDecoder(protocol), [Chunk(0, "host", frame)], [1])
    lines = list(details(protocol, batch.records()[0], state=False))
    (data,) = [line for line in lines if line.label == "data"]
    assert data.text.startswith("c8 c9 ca  taken because")
    assert data.group
    assert (data.group.byte, data.group.size) == (1, 3)


def test_a_damaged_answer_tells_what_is_wrong_with_it() -> None:
    protocol = load(FRAMED["roboclaw"])
    asked = build(protocol, "MainBattery", {"address": 0x80})
    events = [Chunk(0, "host", asked), Chunk(MS, "device", b"\0\x7b\0\0")]
    (batch,) = told(StreamDecoder(protocol), events, [2])
    _, why = words_of(batch.records()[1])
    assert why.startswith("crc is 00 00, right is ")
    lines = details(protocol, batch.records()[1], state=False)
    assert sum(why in line.text for line in lines) == 1


def test_the_code_of_an_answer_that_refuses_has_its_sign(protocol: Protocol) -> None:
    events = [Chunk(0, "host", b"\x90"), Chunk(MS, "device", b"\1")]
    (batch,) = told(StreamDecoder(protocol), events, [2])
    looks = [(one.label, one.look) for one in details(protocol, batch.records()[1], state=False)]
    assert looks[0] == ("code", REFUSAL)
    assert {look for _, look in looks[1:]} == {ORDINARY}


async def test_a_grammar_without_a_state_has_no_line_of_it() -> None:
    protocol = load(FRAMED["modbus_rtu"])
    asked = build(protocol, "ReadCoils", {"address": 1, "start": 0, "quantity": 8})
    (batch,) = told(StreamDecoder(protocol), [Chunk(0, "host", asked)], [1])
    assert "state" not in {one.label for one in details(protocol, batch.records()[0], state=True)}
    screen = browser(protocol, [batch])

    async with operated(screen):
        assert not screen.car.display
        assert screen.figures.region.y == screen.frames.region.y
