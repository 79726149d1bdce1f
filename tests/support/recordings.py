"""Recordings for tests: runs recorded in virtual time, and forged copies of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
from mcap.reader import make_reader

from bilprov.analyzer.client.operations import Link, LinkListener
from bilprov.captures import topics
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk
from bilprov.captures.writer import CaptureWriter
from bilprov.conformance.api import Options, run_suite
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import Environment, Observability, Target
from bilprov.conformance.report.run_report import Report
from bilprov.conformance.runner.listeners.recorder import RunRecorder
from bilprov.spec.protocol import Protocol, grammar_hash
from tests.support.messages import Message, messages
from tests.support.robots import CountingLink

WALL = 1_790_000_000_000_000_000


def recorded(
    path: Path,
    protocol: Protocol,
    *only: str,
    device: Any = None,
    options: Options | None = None,
    interrupted: Callable[[], bool | str] = lambda: False,
    broken: Callable[[int], None] = lambda asks: None,
    observability: Observability | None = None,
) -> Report:
    """Record a run in virtual time into a new file; gives what came out of it."""
    device = device or Simulator(protocol)
    environment = Environment(
        virtual=True,
        observability=observability or Observability(hasattr(device, "look")),
        power=hasattr(device, "power_cycle"),
        device="sim",
        link={"kind": "virtual", "probe": "sim"},
        lossless=getattr(device, "lossless", False) is True,
    )

    def connect(listener: LinkListener | None) -> Link:
        return CountingLink(device, broken, listener)

    target = Target(protocol, environment, connect, interrupted)
    with RunRecorder(str(path), target, start_wall=WALL) as recorder:
        return run_suite(target, options or Options(only=only), [recorder])


def attachments_of(path: Path) -> dict[str, bytes]:
    """What is attached, as the official reader reads it."""
    with path.open("rb") as file:
        return {a.name: a.data for a in make_reader(file).iter_attachments()}


def forged(
    path: Path,
    to: Path,
    change: Callable[[Message], Message | None] = lambda message: message,
    grammar: str = "",
    **attached: bytes,
) -> Path:
    """The same recording written anew, hash and all, with messages or attachments changed.

    A `grammar` stands in the metadata; as the attachment `grammar_py` older recordings have it.
    """
    capture = open_capture(path)
    kinds = {topic.name: topics.CAR_SHAPES.get(topic.value, topic.value) for topic in topics.TOPICS}
    metadata = {k: v for k, v in capture.contents.metadata.items() if k != topics.START_KEY}
    older = attached.get("grammar_py", b"").decode()
    if grammar or older:
        metadata[topics.GRAMMAR_HASH] = grammar_hash(grammar or older)
        metadata[topics.GRAMMAR_TEXT] = grammar
    others = attachments_of(path) | {n.replace("_", "."): data for n, data in attached.items()}
    with CaptureWriter(to, start_wall=capture.start, metadata=metadata, version="0.1.0") as out:
        for name, data in others.items():
            if data:
                out.attach(name, "", data, 0)
        for was in messages(capture):
            message = change(was)
            if message is None:
                continue
            if isinstance(message.value, bytes):
                side = "host" if message.topic == topics.HOST_RAW else "device"
                out.chunk(Chunk(message.t, side, message.value))  # type: ignore[arg-type]
            else:
                value = msgspec.convert(message.value, kinds[message.topic])
                out.write(value, message.t)
    return to
