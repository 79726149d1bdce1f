"""The queue between a line's reader and a stream that may be slower."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from io import TextIOWrapper
from pathlib import Path

import pytest

from bilprov.analyzer.cli.streams import standard_streams
from bilprov.analyzer.output import text_queue
from bilprov.analyzer.output.text_queue import TextQueue

Pipe = tuple[int, TextIOWrapper]


@pytest.fixture
def pipe() -> Iterator[Pipe]:
    """A pipe's reading end, and a stream that writes to it."""
    ours, theirs = os.pipe()
    stream = os.fdopen(theirs, "w")
    yield ours, stream
    with suppress(BrokenPipeError):
        stream.close()
    os.close(ours)


def _read(ours: int, size: int) -> bytes:
    taken = bytearray()
    while len(taken) < size:
        taken += os.read(ours, 1 << 16)
    return bytes(taken)


def _nobody_reads(ours: int) -> None:
    nowhere = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nowhere, ours)
    os.close(nowhere)


def _write_little(queue: TextQueue, times: int) -> None:
    for _ in range(times):
        queue.write("little\n")
        time.sleep(0.001)


def test_a_little_text_goes_out_at_once_and_by_no_thread(pipe: Pipe) -> None:
    ours, stream = pipe
    with TextQueue(stream) as queue:
        before = threading.active_count()
        queue.write("one\n")

        assert os.read(ours, 100) == b"one\n"
        assert threading.active_count() == before


def test_a_reader_that_pauses_holds_nobody_up_and_misses_nothing(pipe: Pipe) -> None:
    ours, stream = pipe
    texts = [f"{number:06d}\n" * 1000 for number in range(100)]  # more than a pipe holds
    expected = "".join(texts).encode()
    queue = TextQueue(stream)
    for text in texts:
        queue.write(text)
    queue.write("last\n")

    taken = _read(ours, len(expected) + 5)
    queue.close()

    assert taken == expected + b"last\n"
    assert queue.waited_ns == 0


@pytest.mark.waits
def test_a_full_queue_makes_the_writer_wait_and_tells_how_long(
    pipe: Pipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(text_queue, "MOST", 100_000)
    ours, stream = pipe
    texts = ["x" * 50_000] * 8
    queue = TextQueue(stream)
    written = threading.Event()

    def write() -> None:
        for text in texts:
            queue.write(text)
        written.set()

    writer = threading.Thread(target=write)
    writer.start()
    assert not written.wait(0.2)
    taken = _read(ours, 400_000)
    writer.join()
    queue.close()

    assert len(taken) == 400_000
    assert queue.waited_ns > 0


def test_what_the_stream_raises_is_raised_in_the_writers_thread(pipe: Pipe) -> None:
    ours, stream = pipe
    queue = TextQueue(stream)
    queue.write("x" * 200_000)  # more than the pipe takes, so it is under way
    _nobody_reads(ours)

    with pytest.raises(BrokenPipeError):
        queue.close()
    queue.close()


def test_what_the_stream_raised_is_raised_though_it_takes_all_that_follows(
    pipe: Pipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, stream = pipe
    monkeypatch.setattr(sys, "stdout", stream)
    with standard_streams():  # their output is discarded once the reader has gone
        queue = TextQueue(sys.stdout)
        queue.write("x" * 200_000)
        _nobody_reads(ours)

        with pytest.raises(SystemExit):
            _write_little(queue, 1000)
        queue.close()


def test_a_file_is_written_at_once(tmp_path: Path) -> None:
    with (tmp_path / "out").open("w") as stream, TextQueue(stream) as queue:
        queue.write("x" * 100_000)

        assert (tmp_path / "out").stat().st_size == 100_000
