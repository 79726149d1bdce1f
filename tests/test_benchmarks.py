"""The bench: its traffic, its peers, its table and its plot; no test says how fast anything is."""

from __future__ import annotations

import json
import re
from collections import Counter
from itertools import islice
from pathlib import Path
from xml.etree import ElementTree

import pytest

from benchmarks import product
from benchmarks.ceiling import Ceiling, Judged
from benchmarks.commands import medians
from benchmarks.peers import Construct, json_written, raw_written, read_by_mcap
from benchmarks.plot import as_svg
from benchmarks.report import Goal, Machine, Row, as_json, as_markdown, between_markers
from benchmarks.traffic import FAULTY, Traffic, blocks, reads, traffic, waited
from bilprov.analyzer.api import decode
from bilprov.captures.reader import open_capture
from bilprov.captures.topics import START_KEY
from bilprov.spec.codec import judge, raw_frame
from bilprov.spec.fields import Outcome
from bilprov.spec.motion import VARIABLES
from bilprov.spec.protocol import Protocol, load
from tests.support.firmware import needs

CC = needs("cc", package="gcc libc6-dev")
SIZE = 10_000  # bytes


@pytest.fixture(params=["car", "horn", "wide"])
def grammar(request: pytest.FixtureRequest, grammar_text: str, horn_text: str) -> Protocol:
    """The protocol, one with another instruction, and one with wide fields and two of them."""
    wide = grammar_text.replace(
        '"speed" / Ranged(Byte, 0, 255) * "speed that the other instructions use",',
        '"speed" / Ranged(Int16ub, 3, 900) * "how fast", "mode" / Ranged(Byte, 1, 2) * "how",',
    ).replace("import BitsInteger,", "import Int16ub, BitsInteger,")
    strength = '"strength" / Ranged(Byte, 0, 255) * "steering strength",'
    wide = wide.replace(strength, f'{strength} "how" / Ranged(Byte, 5, 6) * "how",', 1)
    assert (wide.count("Int16ub"), wide.count('"how"')) == (2, 3)
    return load({"car": grammar_text, "horn": horn_text, "wide": wide}[request.param])


def frames_of(protocol: Protocol, said: Traffic) -> list[bytes]:
    return [record.data for record in decode(said.host, protocol=protocol)]


def test_five_percent_of_the_frames_are_faulty(grammar: Protocol) -> None:
    block = next(blocks(grammar, seed=1))

    faulty = [frame for frame, _ in block if not judge(grammar, frame).valid]
    assert len(faulty) == FAULTY * len(block)


def test_the_answer_drawn_with_a_frame_is_the_one_that_is_due(grammar: Protocol) -> None:
    for frame, answer in next(blocks(grammar, seed=2))[:5_000]:
        assert answer[0] == judge(grammar, frame).response.code


def test_every_instruction_and_every_kind_of_fault_is_drawn(grammar: Protocol) -> None:
    judged = [judge(grammar, frame) for frame, _ in next(blocks(grammar, seed=3))]

    assert {j.instruction.name for j in judged if j.valid and j.instruction} == set(grammar.by_name)
    assert {j.outcome for j in judged} == set(Outcome)


def test_a_horn_is_drawn_where_the_grammar_has_one(horn: Protocol, protocol: Protocol) -> None:
    sounded = raw_frame(horn, 9, 1, b"\3")
    drawn = [frame for frame, _ in next(blocks(horn, seed=1))]

    assert sounded in drawn
    assert judge(horn, sounded).valid
    assert not judge(protocol, sounded).valid


def test_the_same_seed_gives_the_same_traffic_and_another_seed_another(protocol: Protocol) -> None:
    assert traffic(protocol, SIZE, 1) == traffic(protocol, SIZE, 1)
    assert traffic(protocol, SIZE, 1) != traffic(protocol, SIZE, 2)


def test_two_blocks_have_different_frames(protocol: Protocol) -> None:
    first, second = islice(blocks(protocol, seed=1), 2)

    assert first != second


def test_the_first_frames_are_whole_and_each_has_its_answer(grammar: Protocol) -> None:
    said = traffic(grammar, 1).first(grammar, SIZE)

    assert SIZE <= len(said.host) < SIZE + grammar.longest_frame
    assert said.frames == len(frames_of(grammar, said))


@pytest.mark.parametrize("size", [1, 16, 4096])
def test_reads_are_the_traffic_and_no_answer_comes_before_its_frame(
    grammar: Protocol, size: int
) -> None:
    said = traffic(grammar, 1).first(grammar, SIZE)
    chunks = list(reads(said, grammar, size, byte_time=1_000, start=7))
    host = b"".join(chunk.data for chunk in chunks if chunk.direction == "host")
    device = b"".join(chunk.data for chunk in chunks if chunk.direction == "device")

    assert (host, device) == (said.host, said.device)
    assert [chunk.t for chunk in chunks] == sorted(chunk.t for chunk in chunks)
    heard = answered = 0
    ends = [0]
    for frame in frames_of(grammar, said):
        ends.append(ends[-1] + len(frame))
    for chunk in chunks:
        if chunk.direction == "host":
            heard += len(chunk.data)
        else:
            answered += len(chunk.data)
            assert ends[answered] <= heard


@pytest.mark.parametrize("together", [1, 7])
def test_a_host_that_waits_sends_whole_frames_and_has_each_answered(
    grammar: Protocol, together: int
) -> None:
    chunks = list(waited(grammar, 100, together, pause=1_000_000))

    assert [chunk.t for chunk in chunks] == sorted(chunk.t for chunk in chunks)
    for sent, answered in zip(chunks[::2], chunks[1::2], strict=True):
        frames = [record.data for record in decode(sent.data, protocol=grammar)]
        assert (sent.direction, answered.direction) == ("host", "device")
        assert answered.data == bytes(judge(grammar, frame).response.code for frame in frames)
    sizes = [len(chunk.data) for chunk in chunks[1::2]]
    assert (sizes[0], sum(sizes)) == (together, 100)


def test_a_capture_of_a_waiting_host_by_the_library_is_read_as_one_of_ours(
    protocol: Protocol, tmp_path: Path
) -> None:
    path = tmp_path / "waited.mcap"
    about = product.metadata(protocol) | {START_KEY: "0"}

    assert raw_written(path, waited(protocol, 300), about, size=1_000) == 300

    capture = open_capture(path)
    counts = capture.contents.counts
    assert (counts["/host/raw"], counts["/device/raw"]) == (300, 300)
    assert not capture.damage
    assert not capture.unfinished
    assert capture.metadata["grammar_sha256"] == protocol.sha256


def expected(protocol: Protocol, said: Traffic) -> Judged:
    """What the interpreted grammar says, frame by frame."""
    state = protocol.power_on
    codes = bytearray()
    for frame in frames_of(protocol, said):
        judged = judge(protocol, frame)
        codes.append(judged.response.code)
        effect = protocol.on_fault
        if judged.valid and judged.instruction:
            effect = judged.instruction.effect
        state = effect.apply(state, dict(judged.fields))
    return Judged(bytes(codes), tuple(getattr(state, name) for name in VARIABLES))


@CC
def test_the_c_loop_says_what_the_grammar_says(grammar: Protocol, tmp_path: Path) -> None:
    ceiling = Ceiling(grammar, tmp_path, 2 * SIZE)

    for size in (1, 10, 100, SIZE):
        said = traffic(grammar, 1, seed=size).first(grammar, size)
        assert ceiling.judged(said.host) == expected(grammar, said)


@CC
def test_the_c_loop_goes_on_where_a_buffer_ended(grammar: Protocol, tmp_path: Path) -> None:
    said = traffic(grammar, 1).first(grammar, SIZE)
    ceiling = Ceiling(grammar, tmp_path, 2 * SIZE)
    whole = ceiling.decode(said.host)
    ceiling.reset()
    count, used = ceiling.decode(said.host[: SIZE // 2])
    more, rest = ceiling.decode(said.host[used:])

    assert (count + more, used + rest) == whole == (said.frames, len(said.host))


def test_construct_says_what_the_grammar_says(grammar: Protocol) -> None:
    said = traffic(grammar, 1).first(grammar, SIZE // 4)

    assert Construct(grammar).judged(said.host) == expected(grammar, said)


def test_the_plain_writers_keep_every_frame_and_every_byte(
    protocol: Protocol, tmp_path: Path
) -> None:
    said = traffic(protocol, 1).first(protocol, SIZE // 4)
    chunks = list(reads(said, protocol, 64, byte_time=1_000))

    as_messages, raw = tmp_path / "json.mcap", tmp_path / "raw.mcap"
    assert json_written(as_messages, Construct(protocol), chunks) == said.frames
    assert raw_written(raw, chunks) == said.frames
    told = [json.loads(message) for message in read_by_mcap(as_messages, "/frame")]
    assert bytes.fromhex("".join(one["hex"] for one in told)) == said.host
    answers = Counter(one["answer"] for one in told)
    assert answers == Counter(protocol.codes[code].name for code in said.device)
    assert b"".join(read_by_mcap(raw)) == said.host
    assert open_capture(raw).contents.counts["/host/raw"] == len(chunks) - len(
        [chunk for chunk in chunks if chunk.direction == "device"]
    )


def test_the_median_of_interleaved_rounds_is_told() -> None:
    order: list[str] = []
    figures = iter([5.0, 1.0, 1.0, 2.0, 9.0, 3.0])

    def measured(name: str) -> float:
        order.append(name)
        return next(figures)

    found = medians(3, {"a": lambda: measured("a"), "b": lambda: measured("b")})
    assert "".join(order) == "ababab"
    assert found == {"a": 5, "b": 2}


MACHINE = Machine("a CPU", 2, "Linux", "3.11", "cc 12", 0.5, {"mcap": "1.6.0"}, "today")
ROWS = (
    Row(
        "columns",
        "bytes to `columns`",
        "frames/s",
        20e6,
        {"construct": 50e3, "C loop": 200e6},
        {"MB at peak": 120},
        {"MB of another's": 9},
        (Goal("400 x construct", 400, 400), Goal("0.12 x C loop", 0.1, 0.12)),
    ),
    Row("line", "a full line", "% of a core", 30, {"bare reader": 5}, goals=()),
    Row("late", "not | there", note="no <such> command", state="skipped"),
)


def test_a_goal_is_reached_at_its_limit() -> None:
    assert Goal("at least", 400, 400).reached
    assert not Goal("at least", 399, 400).reached
    assert Goal("at most", 6, 6, at_most=True).reached
    assert not Goal("at most", 6.1, 6, at_most=True).reached


def test_the_table_has_a_row_for_each_work_with_ratios_and_what_was_reached() -> None:
    lines = as_markdown(ROWS, MACHINE, "quick").splitlines()

    assert len(lines) == 2 + len(ROWS) + 2
    columns = lines[2]
    for told in (
        "20 M frames/s",
        "120 MB at peak |",
        "9 MB of another's |",
        "400 x construct",
        "0.1 x C loop",
    ):
        assert told in columns
    assert "400 x construct: yes, 400" in columns
    assert "0.12 x C loop: **no**, 0.1" in columns
    assert "6 x bare reader" in lines[3]
    assert "skipped: no <such> command" in lines[4]
    assert "a CPU" in lines[-1]
    assert "mcap 1.6.0" in lines[-1]


def test_the_json_holds_every_figure_ratio_and_goal() -> None:
    told = json.loads(json.dumps(as_json(ROWS, MACHINE, "full")))

    row = told["rows"][0]
    assert row["ratios"] == {"construct": 400, "C loop": 0.1}
    assert [goal["reached"] for goal in row["goals"]] == [True, False]
    assert told["rows"][2]["state"] == "skipped"
    assert told["machine"]["cores"] == 2


def test_the_table_stands_between_the_markers_and_nothing_else_changes() -> None:
    text = "before\n<!-- bench -->\nold\n<!-- /bench -->\nafter\n"

    assert between_markers(text, "new\n") == text.replace("old", "new")
    with pytest.raises(ValueError, match="no <!-- bench -->"):
        between_markers("no markers", "new\n")


def bars(svg: str) -> dict[str, float]:
    """The widths of the plot's bars by their names."""
    found = re.findall(r'text-anchor="end">([^<]+)</text>\n<rect.* width="([\d.]+)" height', svg)
    return {name: float(width) for name, width in found}


def test_the_plot_has_a_bar_for_each_peer_as_long_as_the_logarithm_of_its_ratio() -> None:
    svg = as_svg(ROWS)

    ElementTree.fromstring(svg)
    widths = bars(svg)
    assert list(widths) == ["bilprov", "C loop"]  # construct is 1, the other rows have none
    assert widths["C loop"] / widths["bilprov"] == pytest.approx(3.602 / 2.602, abs=0.01)
    assert svg.count('class="goal"') == 1
    assert "prefers-color-scheme: dark" in svg


def test_a_work_slower_than_construct_has_a_bar_to_the_other_side() -> None:
    slow = Row(
        "slow", "slow", "frames/s", 5, {"construct": 50}, goals=(Goal("2 x construct", 0.1, 2),)
    )

    (rect,) = re.findall(r'class="ours" x="([\d.]+)" y="\d+" width="([\d.]+)"', as_svg([slow]))
    one = re.search(r'class="one" x1="([\d.]+)"', as_svg([slow]))
    assert one
    assert float(rect[0]) + float(rect[1]) == pytest.approx(float(one[1]), abs=0.2)


def test_a_plot_without_rows_is_still_a_picture() -> None:
    ElementTree.fromstring(as_svg([]))
