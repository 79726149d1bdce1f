"""Requests and answers on one wire get the directions that they were sent in."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Iterable
from contextlib import closing
from itertools import islice
from pathlib import Path
from random import Random

import pytest

import bilprov
from bilprov.analyzer.decode.records import DeviceRecord
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.taps.half_duplex import HalfDuplex
from bilprov.analyzer.taps.sources import drive
from bilprov.analyzer.transport.port import open_pty
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import MS, Chunk
from bilprov.spec.codec import judge
from bilprov.spec.protocol import Protocol
from tests.analyzer.decode.test_foreign_traffic import TRAFFIC, events
from tests.support.commands import command
from tests.support.framed_traffic import Traffic, exchanges
from tests.support.wireshark import capture_of

TIMEOUT = 50 * MS


def told(protocol: Protocol, chunks: Iterable[Chunk]) -> list[Chunk]:
    """What the wire has, with the directions that are found."""
    wire = HalfDuplex(protocol, TIMEOUT)
    found = [one for chunk in chunks for one in wire.feed(chunk.data, chunk.t)]
    return found + wire.rest()


def by_byte(chunks: Iterable[Chunk]) -> list[tuple[int, str, int]]:
    return [(chunk.t, chunk.direction, byte) for chunk in chunks for byte in chunk.data]


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("name", list(TRAFFIC))
def test_recorded_traffic_is_told_apart(name: str, single: bool) -> None:
    grammar, _ = TRAFFIC[name]
    chunks = list(events(name, single=single))

    assert by_byte(told(load_protocol(grammar), chunks)) == by_byte(chunks)


@pytest.mark.parametrize("name", ["modbus-rtu", "dynamixel1", "examples/relay_board.py"])
def test_drawn_traffic_is_told_apart(name: str) -> None:
    protocol = load_protocol(name)
    chunks = [
        event
        for event in exchanges(protocol, Random(name), 300, Traffic(odd=0, chunk=7))
        if isinstance(event, Chunk)
    ]

    assert by_byte(told(protocol, chunks)) == by_byte(chunks)


@pytest.mark.slow
def test_a_tap_may_join_at_any_byte() -> None:
    chunks = list(events("sr_flowmeter_target_15liter_per_min"))
    wire = b"".join(chunk.data for chunk in chunks)
    third = sum(len(chunk.data) for chunk in chunks[:6])

    for at in range(0, third, 7):
        cut = by_byte(chunks)[at:]
        found = told(load_protocol("modbus-rtu"), [Chunk(t, "host", bytes([b])) for t, _, b in cut])
        assert len(by_byte(found)) == len(wire) - at
        assert by_byte(found)[third - at :] == cut[third - at :], at


def captures(folder: Path) -> tuple[Path, Path]:
    """The same traffic as one tap on its wire recorded it, and as two recorded it."""
    protocol = load_protocol("modbus-rtu")
    chunks = list(events("sr_flowmeter_target_15liter_per_min"))
    wire = [Chunk(chunk.t, "host", chunk.data) for chunk in chunks]
    return (
        capture_of(folder / "wire.mcap", protocol, wire, heard="host"),
        capture_of(folder / "two.mcap", protocol, chunks),
    )


@pytest.mark.parametrize(
    "words",
    [
        "replay FILE --rate 0 --format jsonl",
        "replay FILE --rate 0 --format jsonl --start 1",
        "replay FILE --judge --rate 0 --format jsonl",
        "export FILE --format csv -o -",
    ],
)
def test_a_capture_of_one_tap_is_read_as_one_of_two(words: str, tmp_path: Path) -> None:
    wire, two = captures(tmp_path)

    split = command(*words.replace("FILE", str(wire)).split(), "--half-duplex")
    apart = command(*words.replace("FILE", str(two)).split())

    assert split.stdout == apart.stdout
    assert split.stdout.count(b"\n") > 20
    assert split.returncode == apart.returncode


def test_it_is_counted_plotted_and_copied_with_the_directions_apart(tmp_path: Path) -> None:
    wire, two = captures(tmp_path)
    counts = []
    for file, more in ((wire, ["--half-duplex"]), (two, [])):
        done = command("stats", str(file), "--json", "-", *more)
        counts.append(json.loads(done.stdout)["files"][0]["counts"])
    page = command("plot", str(wire), "--html", "-", "--half-duplex").stdout
    copied = command("capture", "decode", str(wire), str(tmp_path / "new.mcap"), "--half-duplex")

    assert counts[0] == counts[1]
    assert counts[0]["agreeing"] > 10
    assert b"ReadHoldingRegisters" in page
    assert copied.returncode == 0, copied.stderr
    read = [
        by_byte(x for x in bilprov.open_capture(file) if isinstance(x, Chunk))
        for file in (tmp_path / "new.mcap", two)
    ]
    assert read[0] == read[1]
    again = command("stats", str(tmp_path / "new.mcap"), "--half-duplex")
    assert again.returncode == 2
    assert again.stderr.decode().endswith(
        "new.mcap has the directions apart already: --half-duplex is for a capture of one tap\n"
    )


def test_a_grammar_is_checked_against_what_one_tap_recorded(tmp_path: Path) -> None:
    wire, _ = captures(tmp_path)
    alone = command("spec", "check", "modbus-rtu", str(wire))
    split = command("spec", "check", "modbus-rtu", str(wire), "--half-duplex")

    assert (alone.returncode, split.returncode) == (1, 0)
    assert alone.stderr.decode().strip().endswith("--half-duplex decodes all of these bytes")
    assert b"device  1096 of 1096 bytes decode: 66 answers" in split.stdout
    one = command("spec", "check", "modbus-rtu", "11 03 00 6b 00 03 76 88")
    assert (one.returncode, one.stderr) == (1, b"")


@pytest.mark.waits
def test_the_library_listens_to_one_wire() -> None:
    chunks = list(events("sr_flowmeter_target_15liter_per_min"))[:2]
    heard = threading.Event()
    with open_pty() as wire:

        def keep_sending() -> None:
            while not heard.wait(0.3):  # opening a port throws away what was sent before
                for chunk in chunks:
                    os.write(wire.master, chunk.data)

        sender = threading.Thread(target=keep_sending)
        sender.start()
        try:
            with closing(
                bilprov.sniff(wire.name, half_duplex=True, protocol="modbus-rtu")
            ) as records:
                answer = next(one for one in records if isinstance(one, DeviceRecord))
        finally:
            heard.set()
            sender.join()
    assert answer.data == chunks[1].data
    assert answer.agrees
    with pytest.raises(ValueError, match="one wire has both directions: leave out b"):
        next(bilprov.sniff("a", "b", half_duplex=True))


# -- `bilprov sniff sim`: a drive to look at that no device makes ----------------------------------


BYTE_TIME = 86_805
FRAMES = 600


def test_each_frame_is_answered_as_a_conforming_device_does(
    protocol: Protocol, wide: Protocol
) -> None:
    for one in (protocol, wide):
        chunks = list(islice(drive(one, BYTE_TIME), 2 * FRAMES))
        judged = [judge(one, chunk.data) for chunk in chunks[::2]]

        assert [chunk.direction for chunk in chunks] == ["host", "device"] * FRAMES
        answers = [bytes([judgement.response.code]) for judgement in judged]
        assert [chunk.data for chunk in chunks[1::2]] == answers
        faulty = sum(not judgement.valid for judgement in judged)
        assert 0.02 < faulty / FRAMES < 0.2
        assert [c.t for c in chunks] == sorted(c.t for c in chunks)


def test_it_is_the_same_for_the_same_seed_and_another_for_another(protocol: Protocol) -> None:
    def said(seed: int) -> list[bytes]:
        return [chunk.data for chunk in islice(drive(protocol, BYTE_TIME, seed), 40)]

    assert said(1) == said(1) != said(2)


def test_the_host_stops_soon_after_it_has_set_the_robot_moving(protocol: Protocol) -> None:
    state = protocol.power_on
    moving, longest = 0, 0
    for chunk in islice(drive(protocol, BYTE_TIME), 0, 2 * FRAMES, 2):
        judged = judge(protocol, chunk.data)
        effect = judged.instruction.effect if judged.instruction else protocol.on_fault
        effect = effect if judged.valid else protocol.on_fault
        state = effect.apply(state, dict(judged.fields))
        moving = moving + 1 if protocol.directed(state) else 0
        longest = max(longest, moving)

    assert 1 < longest < 8


@pytest.mark.waits
def test_it_is_sniffed_as_a_line_and_recorded_as_what_it_is(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    listened = ("sniff", "sim", "--format", "jsonl", "--count", "6", "-w", str(path))

    result = command(*listened, "--judge")

    rows = [json.loads(line) for line in result.stdout.splitlines()]
    assert result.returncode == 0
    # On a busy machine a row notes that the sniffer was late.
    kinds = [row["kind"] for row in rows if row["kind"] != "fault"]
    assert kinds[:4] == ["instruction", "response"] * 2
    assert rows[-1]["kind"] == "judgement"
    capture = open_capture(path)
    assert capture.metadata["port_simulated"] == "drive"
    assert not {"port_host", "port_device", "port_bridge"} & set(capture.metadata)


def test_it_has_no_other_port_beside_it_and_a_file_of_that_name_comes_first(
    tmp_path: Path,
) -> None:
    for more in (["/dev/x"], ["--bridge", "/dev/x"]):
        result = command("sniff", "sim", *more)
        assert (result.returncode, result.stdout) == (2, b"")
        assert b"name it alone" in result.stderr
    (tmp_path / "sim").touch()
    result = command("sniff", "sim", cwd=tmp_path)
    assert (result.returncode, result.stdout) == (2, b"")
    assert b"sim is not a serial port" in result.stderr
