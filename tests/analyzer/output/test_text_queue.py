"""The queue between a line's reader and a stream that may be slower."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import suppress
from io import TextIOWrapper

import pytest

from bilprov.analyzer.output import outputs
from bilprov.analyzer.output.outputs import TextQueue

Pipe = tuple[int, TextIOWrapper]


@pytest.fixture
def pipe() -> Iterator[Pipe]:
    """A pipe's reading end, and a stream that writes to it."""
    ours, theirs = os.pipe()
    stream = os.fdopen(theirs, "w")
    yield ours, stream
    os.close(ours)  # first: what is written to a full pipe then fails, and does not wait
    with suppress(BrokenPipeError):
        stream.close()


def _read(ours: int, size: int) -> bytes:
    taken = bytearray()
    while len(taken) < size:
        taken += os.read(ours, 1 << 16)
    return bytes(taken)


def _nobody_reads(ours: int) -> None:
    nowhere = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nowhere, ours)
    os.close(nowhere)


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


@pytest.mark.waits
def test_a_full_queue_makes_the_writer_wait(pipe: Pipe, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outputs, "MOST_WAITING", 100_000)
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


def test_what_the_stream_raises_is_raised_in_the_writers_thread(pipe: Pipe) -> None:
    ours, stream = pipe
    queue = TextQueue(stream)
    queue.write("x" * 200_000)  # more than the pipe takes, so it is under way
    _nobody_reads(ours)

    with pytest.raises(BrokenPipeError):
        queue.close()
    queue.close()
