"""The reference firmware as a program on the host."""

from __future__ import annotations

import random
import subprocess
from pathlib import Path
from tempfile import TemporaryFile

import pytest

from bilprov.spec.codec import judge
from bilprov.spec.framing import Framer
from bilprov.spec.protocol import Protocol
from tests.support.firmware import built, make, needs
from tests.support.robots import PATIENCE

pytestmark = pytest.mark.waits

HOST = needs("gcc", "make", package="gcc make")

SANITIZERS = "-fsanitize=address,undefined -fno-sanitize-recover=all"


@pytest.fixture
def program() -> Path:
    """The robot as a program, watched by sanitizers that end it at the first fault they see."""
    file = built(SANITIZERS, "host")
    code = file.read_bytes()
    assert b"__asan_init" in code  # they are at work
    assert b"__ubsan_handle" in code
    return file


def ran(program: Path, data: bytes, *words: str) -> tuple[int, bytes, bytes]:
    """How the program ends that is given these bytes all at once, its answers, what else it says.

    The bytes are a file's, so that all lie ready.
    """
    with TemporaryFile() as line:
        line.write(data)
        line.seek(0)
        done = subprocess.run(
            [program, *words], stdin=line, capture_output=True, timeout=PATIENCE, check=False
        )
    return done.returncode, done.stdout, done.stderr


@HOST
def test_the_program_answers_every_header_with_any_data_as_the_grammar_judges(
    program: Path, protocol: Protocol
) -> None:
    frames = [
        bytes([header]) + bytes([fill]) * protocol.lengths[header]
        for header in range(256)
        for fill in range(256)
    ]
    framer = Framer(protocol, None)
    records = framer.feed(random.Random(1).randbytes(1 << 17), 0) + framer.drop(0, "truncated")
    frames += [record.data for record in records]
    expected = bytes(judge(protocol, frame).response.code for frame in frames)

    assert ran(program, b"".join(frames)) == (0, expected, b"")


@HOST
def test_the_program_answers_a_frame_that_lacks_data_and_takes_the_next_byte_for_a_header(
    program: Path,
) -> None:
    with subprocess.Popen(
        [program], bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as robot:
        assert robot.stdin is not None
        assert robot.stdout is not None
        for said, answer in ((b"\x81", b"\x04"), (b"\x20", b"\x00")):
            robot.stdin.write(said)
            assert robot.stdout.read(1) == answer
        robot.stdin.close()
        assert robot.stdout.read() == b""
        assert robot.wait(PATIENCE) == 0


@HOST
def test_the_program_tells_what_the_robot_does_when_it_is_asked(program: Path) -> None:
    code, answers, said = ran(program, b"\x11\x7f\x20\x41\xff\x81\x05\x90", "-v")

    assert (code, answers) == (0, b"\x00\x00\x00\x00\x01")
    lines = said.decode().splitlines()
    begin = lines.index("left 127 right 127")
    assert lines[begin:] == ["left 127 right 127", "left 127 right 0", "light 5", "left 0 right 0"]


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
