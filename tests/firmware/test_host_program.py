"""The reference firmware as a program on the host."""

from __future__ import annotations

import os
import random
import select
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import pytest

from bilprov.spec.codec import judge
from bilprov.spec.framing import Framer
from bilprov.spec.protocol import Protocol
from tests.support.firmware import built, make, needs
from tests.support.robots import PATIENCE
from tests.vectors import FRAMES, FrameVector

pytestmark = pytest.mark.waits

HOST = needs("gcc", "make", package="gcc make")

SANITIZERS = "-fsanitize=address,undefined -fno-sanitize-recover=all"


class Robot:
    """A process that is a robot: standard input is its line, standard output its answers."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdin is not None
        assert process.stdout is not None
        self.process = process
        self._line: IO[bytes] = process.stdin
        self._answers = process.stdout.fileno()

    def send(self, data: bytes) -> None:
        self._line.write(data)

    def hang_up(self) -> None:
        self._line.close()

    def answers(self, count: int) -> bytes:
        """So many answers, or fewer if no more come."""
        heard = b""
        while len(heard) < count and select.select([self._answers], [], [], PATIENCE)[0]:
            data = os.read(self._answers, count - len(heard))
            if not data:
                break
            heard += data
        return heard


@contextmanager
def robot(*words: str | Path) -> Iterator[Robot]:
    """A robot that runs until the context is left."""
    with subprocess.Popen(
        words,
        bufsize=0,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as process:
        try:
            yield Robot(process)
        finally:
            process.kill()


# -- the host -------------------------------------------------------------------------------------


@pytest.fixture
def program() -> Path:
    """The robot as a program, watched by sanitizers that end it at the first fault they see."""
    file = built(SANITIZERS, "host")
    code = file.read_bytes()
    assert b"__asan_init" in code  # they are at work
    assert b"__ubsan_handle" in code
    return file


def answers_of(program: Path, data: bytes, tmp_path: Path) -> bytes:
    """What the program answers to bytes that all lie ready; it must end well and report nothing."""
    line = tmp_path / "line"
    line.write_bytes(data)
    with line.open("rb") as file:
        done = subprocess.run(
            [program], stdin=file, capture_output=True, timeout=PATIENCE, check=False
        )
    assert (done.returncode, done.stderr) == (0, b"")
    return done.stdout


@HOST
@pytest.mark.parametrize("vector", FRAMES, ids=lambda vector: vector.frame.hex())
def test_the_program_answers_the_frames_of_the_document(
    program: Path, vector: FrameVector, tmp_path: Path
) -> None:
    assert answers_of(program, vector.frame, tmp_path) == bytes([vector.code])


@HOST
def test_the_program_answers_every_header_with_all_its_data_as_the_grammar_judges(
    program: Path, protocol: Protocol, tmp_path: Path
) -> None:
    frames = [
        bytes([header]) + bytes([fill]) * protocol.lengths[header]
        for header in range(256)
        for fill in range(256)
    ]
    expected = [judge(protocol, frame).response.code for frame in frames]

    answers = answers_of(program, b"".join(frames), tmp_path)

    assert len(answers) == len(frames)
    triples = zip(frames, answers, expected, strict=True)
    assert [(f.hex(), a, e) for f, a, e in triples if a != e] == []


@HOST
@pytest.mark.parametrize("seed", range(4))
def test_the_program_answers_random_bytes_frame_by_frame(
    program: Path, protocol: Protocol, seed: int, tmp_path: Path
) -> None:
    data = random.Random(seed).randbytes(1 << 16)
    framer = Framer(protocol.lengths, None)
    frames = [*framer.feed(data, 0), *framer.drop(0, "truncated")]
    expected = bytes(judge(protocol, frame.data).response.code for frame in frames)

    answers = answers_of(program, data, tmp_path)

    assert len(answers) == len(expected)
    assert answers == expected


@HOST
def test_the_program_answers_a_frame_that_lacks_data_and_takes_the_next_byte_for_a_header(
    program: Path,
) -> None:
    with robot(program) as host:
        host.send(b"\x81")
        assert host.answers(1) == b"\x04"
        host.send(b"\x20")
        assert host.answers(1) == b"\x00"

        host.hang_up()
        assert host.answers(1) == b""
        assert host.process.wait(PATIENCE) == 0


@HOST
def test_the_program_tells_what_the_robot_does_when_it_is_asked(program: Path) -> None:
    done = subprocess.run(
        [program, "-v"],
        input=b"\x11\x7f\x20\x41\xff\x81\x05\x90",
        capture_output=True,
        timeout=PATIENCE,
        check=False,
    )

    assert (done.returncode, done.stdout) == (0, b"\x00\x00\x00\x00\x01")
    lines = done.stderr.decode().splitlines()
    begin = lines.index("left 127 right 127")
    assert lines[begin:] == ["left 127 right 127", "left 127 right 0", "light 5", "left 0 right 0"]


@HOST
@pytest.mark.parametrize("words", [("-x",), ("-v", "-v")])
def test_the_program_tells_how_it_is_used(program: Path, words: tuple[str, ...]) -> None:
    done = subprocess.run(
        [program, *words], input=b"\x90", capture_output=True, timeout=PATIENCE, check=False
    )

    assert (done.returncode, done.stdout) == (2, b"")
    assert len(done.stderr.splitlines()) == 1
    assert b"usage: " in done.stderr


@HOST
def test_a_planted_bug_is_never_kept_from_an_earlier_build(tmp_path: Path) -> None:
    def program(bugs: str) -> bytes:
        make(tmp_path, "host", f"BUGS={bugs}")
        return (tmp_path / "host.elf").read_bytes()

    clean = program("")
    built_at = (tmp_path / "host.elf").stat().st_mtime_ns

    assert program("") == clean
    assert (tmp_path / "host.elf").stat().st_mtime_ns == built_at  # nothing is built anew in vain
    assert program("-DBUG_LIGHT_MASKED") != clean
    assert program("") == clean
