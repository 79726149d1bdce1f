"""Impaired lines: faults are seeded, keep order and time, and the command applies the same ones."""

from __future__ import annotations

import os
import select
import signal
import socket
import termios
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bilprov.analyzer.taps.relay import ImpairedDirection, Noise
from bilprov.analyzer.transport.port import open_port
from tests.support.commands import Running, running
from tests.support.robots import PATIENCE

pytestmark = pytest.mark.waits

ALL = bytes(range(256))
MS = 1_000_000
NEVER = 1 << 62

rates = st.floats(0, 1 / 3)
noises = st.builds(Noise, rates, rates, rates)
chunked = st.lists(st.binary(max_size=20), max_size=20)


def passed(direction: ImpairedDirection, pieces: Iterable[bytes]) -> bytes:
    for piece in pieces:
        direction.put(piece, 0)
    return direction.take(NEVER)


# what happens to a byte


@given(noises, st.integers(), chunked)
def test_the_same_seed_and_bytes_give_the_same_faults_in_whatever_pieces_they_come(
    noise: Noise, seed: int, pieces: list[bytes]
) -> None:
    whole, split = (
        ImpairedDirection(noise, seed, "A to B", delay=5 * MS, jitter=3 * MS) for _ in range(2)
    )

    assert passed(whole, [b"".join(pieces)]) == passed(split, pieces)
    assert whole.account() == split.account()


@given(noises, st.integers(), st.binary(max_size=300))
def test_the_account_holds(noise: Noise, seed: int, data: bytes) -> None:
    direction = ImpairedDirection(noise, seed, "A to B")
    arrived = passed(direction, [data])

    assert direction.came == len(data)
    assert len(arrived) == direction.came - direction.dropped + direction.doubled
    assert direction.account().startswith(
        f"A to B: {len(data)} bytes, {direction.dropped} dropped, "
    )
    if not direction.dropped and not direction.doubled:
        bits = [(a ^ b).bit_count() for a, b in zip(data, arrived, strict=True)]
        assert set(bits) <= {0, 1}
        assert sum(bits) == direction.flipped


@pytest.mark.parametrize(
    ("noise", "arrived"),
    [
        (Noise(), b"abc"),
        (Noise(dropped=1.0), b""),
        (Noise(doubled=1.0), b"aabbcc"),
    ],
)
def test_a_dropped_byte_is_missing_and_a_doubled_one_comes_twice(
    noise: Noise, arrived: bytes
) -> None:
    assert passed(ImpairedDirection(noise, 1, "A to B"), [b"abc"]) == arrived


def test_both_directions_and_every_seed_have_chances_of_their_own() -> None:
    noise = Noise(0.1, 0.1, 0.1)
    directions = [
        ImpairedDirection(noise, seed, way) for seed in (1, 2) for way in ("A to B", "B to A")
    ]

    assert len({passed(direction, [ALL]) for direction in directions}) == 4


def test_faults_come_as_often_as_told_and_a_flip_changes_any_one_bit() -> None:
    direction = ImpairedDirection(Noise(0.02, 0.05, 0.1), 1, "A to B", delay=1)
    passed(direction, [ALL * 80])

    told = {"flipped": 0.02, "dropped": 0.05, "doubled": 0.1, "delayed": 0.95}
    for harm, rate in told.items():
        assert getattr(direction, harm) / direction.came == pytest.approx(rate, rel=0.15), harm
    flipped = passed(ImpairedDirection(Noise(flipped=1.0), 1, "A to B"), [ALL])
    changes = {before ^ after for before, after in zip(ALL, flipped, strict=True)}
    assert changes == {1 << bit for bit in range(8)}


# when it arrives


@given(
    st.integers(),
    st.lists(st.tuples(st.integers(0, 20 * MS), st.binary(min_size=1, max_size=5)), max_size=30),
    st.integers(0, 9 * MS),
    st.integers(0, 9 * MS),
)
def test_order_is_kept_and_nothing_waits_longer_than_its_delay(
    seed: int, pieces: list[tuple[int, bytes]], delay: int, jitter: int
) -> None:
    direction = ImpairedDirection(Noise(), seed, "A to B", delay=delay, jitter=jitter)
    now, came, arrived = 0, list[int](), list[int]()
    sent = b"".join(data for _, data in pieces)
    got = bytearray()

    def advance(until: int) -> None:
        while direction.deadline is not None and direction.deadline <= until:
            at = direction.deadline
            assert direction.take(at - 1) == b""
            data = direction.take(at)
            assert data
            got.extend(data)
            arrived.extend([at] * len(data))

    for pause, data in pieces:
        now += pause
        advance(now)
        direction.put(data, now)
        came.extend([now] * len(data))
    advance(NEVER)

    assert got == sent
    for before, after in zip(came, arrived, strict=True):
        assert delay <= after - before <= delay + jitter
    if delay:
        assert direction.delayed == len(sent)


# the command


class Wire:
    """Our side of an end: a descriptor to write and to read until enough has come."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor

    def say(self, data: bytes) -> None:
        while data:
            select.select([], [self.descriptor], [], PATIENCE)
            data = data[os.write(self.descriptor, data) :]

    def hear(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            assert select.select([self.descriptor], [], [], PATIENCE)[0], f"only {data!r} came"
            more = os.read(self.descriptor, 1 << 16)
            assert more, f"only {data!r} came"
            data += more
        return data


def served_by(line: Running, count: int = 2) -> list[str]:
    names = [line.stdout.readline().decode().strip() for _ in range(count)]
    assert all(names), line.stderr.read().decode()
    return names


def both_ways(a: Wire, b: Wire) -> None:
    a.say(ALL)
    assert b.hear(256) == ALL
    b.say(ALL[::-1])
    assert a.hear(256) == ALL[::-1]


CLEAN = "256 bytes, 0 dropped, 0 flipped, 0 doubled, 0 delayed"


@pytest.mark.parametrize(
    ("how", "delay"),
    [(signal.SIGTERM, []), (signal.SIGINT, ["--delay", "2", "--jitter", "1"])],
)
def test_every_byte_passes_between_two_ptys(how: signal.Signals, delay: Sequence[str]) -> None:
    with running("lab", "line", *delay, "pty", "pty") as line:
        near, far = served_by(line)
        # As a program opens them that sets nothing: a cooked pty would eat 0x03 and 0x11.
        ends = [os.open(path, os.O_RDWR | os.O_NOCTTY) for path in (near, far)]
        both_ways(*map(Wire, ends))
        code, out, err = line.end(how)
        for end in ends:
            os.close(end)
    told = CLEAN.replace("0 delayed", "256 delayed") if delay else CLEAN
    assert (code, out) == (0, b"")
    assert err.decode() == f"A to B: {told}; B to A: {told}\n"


def test_every_byte_passes_between_two_devices_that_were_cooked() -> None:
    descriptors = [*os.openpty(), *os.openpty()]
    (near, a, far, b), names = descriptors, [os.ttyname(fd) for fd in descriptors[1::2]]
    try:
        assert all(termios.tcgetattr(fd)[3] & termios.ICANON for fd in (a, b))
        with running("lab", "line", *names, "--seed", "2") as line:
            assert line.stderr.readline().decode() == f"{names[0]} and {names[1]} are joined\n"
            both_ways(Wire(near), Wire(far))
            code, out, err = line.end()
    finally:
        for descriptor in descriptors:
            os.close(descriptor)
    assert (code, out) == (0, b"")
    assert err.decode() == f"A to B: {CLEAN}; B to A: {CLEAN}\n"


def test_the_command_does_what_its_seed_says_and_accounts_for_it() -> None:
    noise = ["--drop", ".1", "--flip", ".05", "--double", "2e-1", "--delay", "3"]
    there, back = (
        ImpairedDirection(Noise(0.05, 0.1, 0.2), 7, way, delay=3 * MS)
        for way in ("A to B", "B to A")
    )
    expected = passed(there, [ALL * 4]), passed(back, [ALL * 4])
    for piece in (1024, 7):
        with running("lab", "line", *noise, "--seed", "7", "pty", "pty") as line:
            near, far = served_by(line)
            with open_port(near) as port, open_port(far) as peer:
                a, b = Wire(port.fileno() or -1), Wire(peer.fileno() or -1)
                for at in range(0, 1024, piece):
                    a.say((ALL * 4)[at : at + piece])
                    b.say((ALL * 4)[at : at + piece])
                heard = b.hear(len(expected[0])), a.hear(len(expected[1]))
                assert heard == expected
                _, _, err = line.end()
        assert err.decode() == f"{there.account()}; {back.account()}\n"


def test_who_does_not_read_holds_up_nobody() -> None:
    with running("lab", "line", "pty", "pty") as line:
        near, far = served_by(line)
        with open_port(near) as client, open_port(far) as port:
            Wire(client.fileno() or -1).say(bytes(200_000))
            port.write(b"still here")
            assert Wire(client.fileno() or -1).hear(10) == b"still here"
            assert select.select([line.stderr], [], [], PATIENCE)[0]
            assert b"nobody reads what goes from A to B" in line.stderr.readline()
            assert line.end()[0] == 0


@contextmanager
def served_socket() -> Iterator[tuple[str, socket.socket]]:
    """A TCP server as a device that a line opens: its URL, and what accepts the line."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"socket://127.0.0.1:{server.getsockname()[1]}", server


@pytest.mark.parametrize("lost", ["A", "B"])
def test_a_lost_end_is_two_and_its_last_bytes_arrive(lost: str) -> None:
    with served_socket() as (name, server), served_socket() as (other, far):
        ends = [name, other] if lost == "A" else [other, name]
        with running("lab", "line", *ends, "--delay", "50") as line:
            device, client = server.accept()[0], far.accept()[0]
            assert line.stderr.readline().endswith(b"are joined\n")
            with device, client:
                both_ways(Wire(client.fileno()), Wire(device.fileno()))
                device.sendall(b"last words")
                device.close()
                assert Wire(client.fileno()).hear(10) == b"last words"
                code, out, err = line.result()
    account, why = err.decode().splitlines()
    assert (code, out) == (2, b"")
    assert f"{lost} to {'B' if lost == 'A' else 'A'}: 266 bytes, 0 dropped" in account
    assert "266 delayed" in account
    assert why == (
        f"bilprov: {name} was closed by the other side; is the program that serves it running?"
    )


# the suite over the line
