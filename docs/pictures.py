"""Draws the README's pictures: the screen over a drive, a faulty robot's summary and its page.

The page is taken by Chromium (apt-get install chromium); the same browser and fonts give the same
picture again.
"""

from __future__ import annotations

import asyncio
import io
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from urllib.parse import quote

from rich.console import Console

from bilprov.analyzer.columns.decoder import Part, Records
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.screen.browser import Browser, Told
from bilprov.analyzer.screen.feeds import Feed
from bilprov.analyzer.screen.recording import Recording
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.captures.schemas import MS, Chunk
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.report.html.page import as_html
from bilprov.conformance.report.summary import show
from bilprov.spec.protocol import Protocol
from examples.demo import examples

_LATENCY = int(0.4 * MS)
_STEP = 12 * MS
_SCREEN = (110, 36)  # columns and lines of the screen's picture
_WIDTH, _HEIGHT = 1120, 900  # pixels of the page's picture
_PATIENCE = 120  # s for the browser


def drive_parts(protocol: Protocol) -> list[Part]:
    """The decoded parts of a drive: the document's examples, driven on the simulator."""
    device = Simulator(protocol, latency=_LATENCY)
    session = Session(protocol, skew=0)
    parts: list[Part] = []
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
    """The screen of `browse` over that drive, as SVG: the last fault is chosen."""
    parts = drive_parts(protocol)

    def add(feed: Feed[None]) -> None:
        for part in parts:
            feed.recording.add(part)

    byte_time = line_settings(protocol).byte_time
    feed = Feed(Recording(protocol), add, stays=True)
    screen = Browser(feed, Told("drive.mcap", 0, byte_time))

    async def taken() -> str:
        async with screen.run_test(size=_SCREEN) as pilot:
            feed.join()
            screen.tick()
            await pilot.press("end", "N", "enter", "down", "escape")
            await pilot.pause()
            return screen.export_screenshot(title="bilprov browse", simplify=True)

    return asyncio.run(taken())


def draw(folder: Path) -> None:
    """Write the pictures as SVG files into the folder."""
    protocol = load_protocol()
    (folder / "browse.svg").write_text(browse_picture(protocol), encoding="utf-8")
    console = Console(
        record=True, width=104, file=io.StringIO(), force_terminal=True, highlight=False
    )
    fault = fault_bank(protocol)["restarts-by-itself"]
    options = Options(only=("bad-data/*", "unused-id/9/*"))
    report = conform(Simulator(protocol, fault), options=options, fault=fault.name)
    show(report, console)
    console.save_svg(str(folder / "conform.svg"), title="bilprov conform", unique_id="conform")
    failed = next(result.id for result in report.results if result.verdict is Verdict.FAIL)
    take(as_html([report], protocol), failed, folder / "report.png")


def take(page: str, case: str, picture: Path) -> None:
    """Take a picture of a report's page with one case open. Raises OSError without Chromium."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        raise FileNotFoundError("no Chromium to take the page's picture: apt-get install chromium")
    with tempfile.TemporaryDirectory() as place:
        (Path(place) / "report.html").write_text(page, encoding="utf-8")
        # The browser takes its picture from the top: what scrolls must be a frame in the page.
        frame = Path(place) / "frame.html"
        frame.write_text(
            "<!doctype html><body style='margin: 0'><iframe style='border: 0; display: block' "
            f"width={_WIDTH} height={_HEIGHT} src='report.html#case={quote(case, safe='')}'>",
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
