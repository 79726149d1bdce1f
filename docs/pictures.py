"""Draws the pictures of README and docs: a drive live and as a plot, a report, a port.

Pages are taken by Chromium (apt-get install chromium); the same browser and fonts give the same
picture again.
"""

from __future__ import annotations

import asyncio
import io
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from random import Random

from rich.console import Console, RenderableType
from rich.padding import Padding
from rich.text import Text

from bilprov.analyzer.cli.stats import plot
from bilprov.analyzer.decode.batch import Batch, Records
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.doctor.examination import examined, heard
from bilprov.analyzer.doctor.finding import INDENT, Finding, Grade, conclusion, drawn, title
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.output.console import heading
from bilprov.analyzer.screen.browser import Browser
from bilprov.analyzer.screen.feeds import DRAW_EVERY, Feed, Told
from bilprov.analyzer.screen.recording import Recording
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.machine import Machine
from bilprov.analyzer.version import kit_version
from bilprov.captures.schemas import MS, Chunk, Line
from bilprov.captures.writer import CaptureWriter
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.report.html.page import as_html
from bilprov.conformance.report.summary import show
from bilprov.spec.codec import build, raw_frame
from bilprov.spec.motion import MOTIONS, Moment
from bilprov.spec.protocol import Protocol
from examples.demo import examples
from tests.support.machines import FakeMachine

_LATENCY = int(0.4 * MS)
_STEP = 300 * MS
_EXPORTED_BLACK = "#4b4e55"  # a grey, in which the chosen row can hardly be read
_WIDTH, _HEIGHT = 1120, 840  # pixels of a page's picture
_BEGUN = 1_790_000_000_000_000_000  # ns since 1970: when the drive of the plot is said to begin
_SCREEN = (112, 32)  # columns and lines of the screen's picture
_PATIENCE = 120  # s for the browser


def drive_parts(protocol: Protocol) -> list[Batch]:
    """The decoded parts of a drive: the document's examples, driven on the simulator."""
    device = Simulator(protocol, latency=_LATENCY)
    session = Session(protocol, skew=0)
    parts: list[Batch] = []
    now = 0
    # As printed first and as meant last, so that the picture ends with the robot under way.
    for _, frames in reversed(examples(protocol)[:-1]):
        for frame in frames:
            events = [Chunk(now, "host", frame)]
            device.receive(frame, now)
            while (due := device.deadline()) is not None:
                now = due
                data = device.advance(now)
                if data:
                    events.append(Chunk(now, "device", data))
            parts.append(Records([record for event in events for record in session.feed(event)]))
            now += _STEP
    return parts


def browse_picture(protocol: Protocol) -> str:
    """The screen of `replay` over that drive, as SVG: the last fault is chosen."""
    recording = Recording(protocol)
    for part in drive_parts(protocol):
        recording.add(part)
    feed: Feed = Feed(recording, lambda feed: None, stays=True)
    screen = Browser(feed, Told("drive.mcap", 0, line_settings(protocol)))

    async def taken() -> str:
        async with screen.run_test(size=_SCREEN) as pilot:
            await pilot.press("end", "N")
            await pilot.pause(2 * DRAW_EVERY)  # the figures are drawn by the clock
            svg = screen.export_screenshot(title="bilprov replay", simplify=True)
            return svg.replace(_EXPORTED_BLACK, "#000000")

    return asyncio.run(taken())


def doctor_picture(protocol: Protocol, machine: Machine, port: str) -> Iterator[RenderableType]:
    """What `ports` reports of an adapter on whose line another baud rate is."""
    opened = Finding("opening", Grade.FINE, f"opened with {line_settings(protocol)}")
    framing = Line(1, "framing", "host", "31 counted by the driver")
    events: list[Chunk | Line] = [Chunk(0, "host", bytes(40)), framing]
    traffic = heard(protocol, {"host": port}, events, 2)
    findings = [*examined(port, machine, [port]), opened, *traffic]
    yield heading(title(port, machine))
    for finding in findings:
        yield drawn(finding)
        if finding.command:
            yield Padding(Text(finding.command, "bold"), (0, 0, 0, INDENT))
    yield conclusion([port], findings)


def drive(protocol: Protocol) -> list[Chunk]:
    """A minute of driving about on the simulator: smooth, with now and then a frame gone wrong."""
    random, device = Random(5), Simulator(protocol, latency=_LATENCY)
    events: list[Chunk] = []
    now = busy = 0

    def say(frame: bytes, pause: int) -> None:
        nonlocal now, busy
        now = max(now + pause, busy)
        events.append(Chunk(now, "host", frame))
        device.receive(frame, now)
        while (due := device.deadline()) is not None:
            if answer := device.advance(due):
                busy = due + int(random.lognormvariate(0, 0.6) * MS)
                events.append(Chunk(busy, "device", answer))

    moments = {spec: protocol.car.moment(spec.effect) for spec in protocol.instructions}
    moves = [spec for spec, moment in moments.items() if moment in MOTIONS]
    sets = [spec for spec, moment in moments.items() if moment is Moment.SETTING]
    turns = [spec for spec in sets if spec.effect.sets("steering")]
    speed = next(spec for spec in sets if spec.effect.sets("speed"))
    while now < 60_000 * MS:
        say(build(protocol, random.choice(moves).name), 300 * MS)
        top = random.randrange(90, 256)
        for value in range(20, top, 9):
            say(build(protocol, speed.name, {speed.fields[0].name: value}), 40 * MS)
        for _ in range(random.randrange(4)):
            turn = random.choice(turns)
            value = random.randrange(40, 256)
            say(build(protocol, turn.name, {turn.fields[0].name: value}), 500 * MS)
        if random.random() < 0.3:
            say(raw_frame(protocol, random.choice(protocol.unused_ids), 0), 200 * MS)
        for value in range(top, 20, -15):
            say(build(protocol, speed.name, {speed.fields[0].name: value}), 40 * MS)
        say(build(protocol, protocol.stop.name), 200 * MS)
    return events


def plot_picture(protocol: Protocol, picture: Path) -> None:
    """Take a picture of the plot of a drive. Raises OSError without Chromium."""
    with tempfile.TemporaryDirectory() as place:
        file, page = Path(place) / "drive.mcap", Path(place) / "drive.html"
        about = {"attached": "no", "heard": "host device"}
        version = kit_version()
        with CaptureWriter(file, start_wall=_BEGUN, metadata=about, version=version) as writer:
            for event in drive(protocol):
                writer.chunk(event)
        plot.main([str(file), "--html", str(page)], standalone_mode=False, obj=None)
        text = page.read_text(encoding="utf-8")
        take(text, re.findall(r'href="#(t=\d+)"', text)[3], picture)  # at one of the anomalies


def draw(folder: Path) -> None:
    """Write the pictures as SVG files into the folder."""
    protocol = load_protocol()
    (folder / "browse.svg").write_text(browse_picture(protocol), encoding="utf-8")
    console = Console(
        record=True, width=104, file=io.StringIO(), force_terminal=True, highlight=False
    )
    with tempfile.TemporaryDirectory() as place:
        machine = FakeMachine(Path(place))
        machine.run(812, "ModemManager")
        console.print(*doctor_picture(protocol, machine, machine.adapter()), sep="\n")
    console.save_svg(str(folder / "doctor.svg"), title="bilprov ports", unique_id="doctor")
    fault = fault_bank(protocol)["restarts-by-itself"]
    options = Options(only=("bad-data/*", "unused-id/9/*"))
    report = conform(Simulator(protocol, fault), options=options, fault=fault.name)
    show(report, console)
    console.save_svg(str(folder / "conform.svg"), title="bilprov conform", unique_id="conform")
    take(as_html([report], protocol), "", folder / "report.png")
    plot_picture(protocol, folder / "plot.png")


def take(page: str, fragment: str, picture: Path) -> None:
    """Take a picture of a page at a fragment of its address. Raises OSError without Chromium."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        raise FileNotFoundError("no Chromium to take the page's picture: apt-get install chromium")
    with tempfile.TemporaryDirectory() as place:
        (Path(place) / "page.html").write_text(page, encoding="utf-8")
        # The browser takes its picture from the top: what scrolls must be a frame in the page.
        frame = Path(place) / "frame.html"
        frame.write_text(
            "<!doctype html><body style='margin: 0'><iframe style='border: 0; display: block' "
            f"width={_WIDTH} height={_HEIGHT} src='page.html#{fragment}'>",
            encoding="utf-8",
        )
        subprocess.run(
            [
                *(chromium, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"),
                *("--no-first-run", "--disable-background-networking", "--disable-sync"),
                *("--disable-component-update", "--disable-quic", "--disable-dev-shm-usage"),
                "--force-prefers-reduced-motion",  # else it is taken while the page still scrolls
                f"--user-data-dir={place}/profile",
                f"--window-size={_WIDTH},{_HEIGHT}",
                f"--screenshot={picture.resolve()}",
                frame.as_uri(),
            ],
            check=True,
            timeout=_PATIENCE,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
