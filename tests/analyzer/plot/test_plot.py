"""`bilprov plot`: the page's values are the recording's, and it is used in a real Chromium."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable
from itertools import accumulate
from pathlib import Path
from random import Random
from typing import Any

import pytest
from msgspec.structs import replace

from bilprov.analyzer.decode.records import Record, serious_faults
from bilprov.analyzer.totals import timeline
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk
from bilprov.spec.codec import build, judge
from bilprov.spec.motion import Motion
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.captures import write_capture
from tests.support.chromium import INSTALL, Page, chromium
from tests.support.commands import command
from tests.support.decoding import MS, Event, capture_session, decoded, devices, hosts
from tests.support.surfaces import Seen

pytestmark = pytest.mark.waits

EXAMPLES = str(ROOT / "captures" / "samples" / "examples.mcap")
SECOND = 1_000_000_000  # ns
needs_chromium = pytest.mark.skipif(chromium() is None, reason=INSTALL)
Open = Callable[..., Page]


def written(path: Path, events: list[Event]) -> str:
    about = {"attached": "no", "heard": "host device"}
    return str(write_capture(path, events, about))


def page_of(file: str, *arguments: str) -> str:
    result = command(*arguments, "plot", file, "--html", "-")
    assert result.returncode == 0, result.stderr
    return result.stdout.decode()


def data_of(text: str) -> Any:
    block = text.partition('id="data">')[2].partition("</script>")[0]
    found = json.loads(block)
    for part in ("states", "latencies", "marks"):
        found[part]["t"] = list(accumulate(found[part]["t"]))
    return found


def records_of(file: str, protocol: Protocol) -> list[Record]:
    capture = open_capture(file)
    return decoded(capture_session(capture, protocol), capture.events())


def drive(protocol: Protocol, frames: int, seed: int = 1) -> list[Event]:
    """Frames of all kinds, of which a few are faulty, 20 ms apart, and their right answers."""
    random, events = Random(seed), []
    names = protocol.instructions
    for number in range(frames):
        spec = random.choice(names)
        values = {part.name: random.randint(part.low, part.high) for part in spec.fields}
        frame = build(protocol, spec.name, values)
        if random.random() < 0.03:
            frame = bytes([protocol.header_bytes[protocol.unused_ids[0], 0]])
        t = 3 * SECOND + number * 20 * MS
        events.append(Chunk(t, "host", frame))
        answer = bytes([judge(protocol, frame).response.code])
        events.append(Chunk(t + random.randrange(MS, 9 * MS), "device", answer))
    return events


def exchanges(times: Iterable[int]) -> list[Event]:
    """An instruction and its answer at each of some times (ns)."""
    return [
        Chunk(t, side, data) for t in times for side, data in (("host", b"\x20"), ("device", b"\0"))
    ]


# -- what is in the file --------------------------------------------------------------------------


@pytest.mark.parametrize("frames", [0, 400])
def test_the_values_in_the_page_are_those_of_the_records(
    tmp_path: Path, protocol: Protocol, frames: int
) -> None:
    file = written(tmp_path / "c.mcap", drive(protocol, frames)) if frames else EXAMPLES
    records = records_of(file, protocol)

    text = page_of(file)
    data = data_of(text)

    states = data["states"]
    for record in hosts(records):
        row = max(at for at, t in enumerate(states["t"]) if t <= record.known)
        state = record.state
        motion = list(Motion).index(state.motion)
        assert states["motion"][row] == 2 * motion + state.moving
        assert states["speed"]["last"][row] == state.speed
        assert states["steering"]["last"][row] == state.steering
    latencies = data["latencies"]
    answers = [(r.t, r.latency) for r in devices(records) if r.latency is not None]
    assert list(zip(latencies["t"], latencies["low"], strict=True)) == answers
    faults = [fault for record in records for fault in serious_faults(record)]
    assert data["marks"] == {"t": [fault.t for fault in faults], "n": [1] * len(faults)}
    assert data["steps"] == [0, 0]
    rows = re.findall(r'<a href="#t=(\d+)">[^<]+</a></td><td>([^<]*)</td><td>([^<]*)</td>', text)
    assert [(int(t), kind) for t, kind, _ in rows] == [(f.t, f.kind) for f in faults]
    assert "Every change of the state" in text


@pytest.fixture
def little_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page has room for less, so that a recording need not be as long to be reduced."""
    monkeypatch.setattr(timeline, "MOST", 500)
    monkeypatch.setattr(timeline, "MOST_MARKS", 40)


@pytest.mark.usefixtures("little_room")
def test_a_long_recording_is_reduced_and_says_so(tmp_path: Path, protocol: Protocol) -> None:
    file = written(tmp_path / "c.mcap", drive(protocol, 3000))

    text = page_of(file)

    data = data_of(text)
    assert min(data["steps"]) > 0
    assert "The recording is long: states are reduced" in text
    assert max(data["states"]["speed"]["high"]) == protocol.variables["speed"].high
    assert sum(data["latencies"]["count"]) == 3000
    faults = [f for r in records_of(file, protocol) for f in serious_faults(r)]
    assert sum(data["marks"]["n"]) == len(faults) > len(data["marks"]["n"])
    assert " more</span>" in text


@pytest.mark.slow
def test_a_page_has_two_megabytes_at_most(tmp_path: Path, protocol: Protocol) -> None:
    text = page_of(written(tmp_path / "c.mcap", drive(protocol, 16_000)))

    # Little is reduced, so that it is near the most that a page can hold.
    assert len(data_of(text)["latencies"]["t"]) == 16_000
    assert len(text) < 2_000_000


def test_it_is_one_file_that_asks_no_other_place(tmp_path: Path, protocol: Protocol) -> None:
    text = page_of(written(tmp_path / "c.mcap", drive(protocol, 50)))
    elements = Seen(text).elements

    assert not {tag for tag, _ in elements} & {"link", "img", "iframe", "object", "embed", "base"}
    assert not [attributes for _, attributes in elements if "src" in attributes]
    assert not re.search(r"url\(|@import|https?:", text)
    (policy,) = [a["content"] or "" for _, a in elements if a.get("http-equiv")]
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policy
    assert not [a for _, a in elements if "style" in a or any(key.startswith("on") for key in a)]


def test_the_numbers_are_there_without_any_script(protocol: Protocol) -> None:
    text = page_of(EXAMPLES).partition("<script")[0]

    assert "<noscript>" in text
    assert "41 as expected, 0 not" in text
    for fault in (f for r in records_of(EXAMPLES, protocol) for f in serious_faults(r)):
        assert fault.reason in text
    for spec in protocol.instructions[:2]:
        assert f'<th scope="row">{spec.name}</th>' in text


def test_a_recording_of_nothing_and_times_of_a_forged_one_make_a_page(tmp_path: Path) -> None:
    text = page_of(written(tmp_path / "empty.mcap", []))
    assert "No answer was paired" in text
    assert "None." in text

    times = (0, 1, (1 << 63) + 5)
    data = data_of(page_of(written(tmp_path / "forged.mcap", exchanges(times))))
    assert len(data["latencies"]["t"]) == 3
    assert len(data["folds"]) == 1


@pytest.mark.parametrize(
    ("pauses", "words"),
    [
        ([], []),
        ([9], []),  # shorter than any that is folded
        ([11], ["11 s"]),
        ([11, 27_725], ["11 s", "7 h 42 min"]),
        ([100_000], ["1 d 3 h"]),
        ([60] * 19, ["1 min 0 s"] * 19),
        ([60] * 300, []),  # that is how often something comes here
    ],
)
def test_long_times_without_traffic_are_folded(
    tmp_path: Path, pauses: list[int], words: list[str]
) -> None:
    times = [t * SECOND for t in accumulate([3, *pauses])]

    text = page_of(written(tmp_path / "c.mcap", exchanges(times)))

    folds = data_of(text)["folds"]
    assert [says for *_, says in folds] == words
    assert all(last - first in {pause * SECOND for pause in pauses} for first, last, _ in folds)
    assert ("folded on the time axis" in text) is bool(words)


# -- in the browser -------------------------------------------------------------------------------


@pytest.fixture
def show(page: Page, tmp_path: Path) -> Open:
    """Opens the page about a capture; nothing may complain, nothing else may be asked for."""

    def opened(capture: str, fragment: str = "") -> Page:
        file = tmp_path / "plot.html"
        file.write_text(page_of(capture), encoding="utf-8")
        page.open(file.as_uri() + fragment)
        page.wait("!tools.hidden")
        settle(page)
        assert page.complaints == []
        assert page.requests == [file.as_uri() + fragment]
        return page

    return opened


def settle(page: Page) -> None:
    """Until what is due is drawn."""
    page.eval("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")


def told(page: Page, what: str) -> str:
    return str(page.eval(f"document.querySelector('#readout [data-of={what}]').textContent"))


def seconds(page: Page) -> float:
    return float(told(page, "time").removesuffix(" s"))


def spot(page: Page, share: float, target: str = "#plot") -> tuple[float, float]:
    """A place on the canvas, so far from its left edge to its right, at half its height."""
    x, y = page.eval(
        f"(() => {{ const c = document.querySelector('{target}');"
        "c.scrollIntoView({block: 'center', behavior: 'instant'});"
        "const r = c.getBoundingClientRect();"
        f"return [r.x + r.width * {share}, r.y + r.height / 2] }})()"
    )
    return x, y


def mouse(page: Page, kind: str, at: tuple[float, float], **more: Any) -> None:
    page.call("Input.dispatchMouseEvent", type=kind, x=at[0], y=at[1], **more)
    settle(page)


def time_at(page: Page, share: float) -> float:
    mouse(page, "mouseMoved", spot(page, share))
    return seconds(page)


def span(page: Page) -> float:
    """How many seconds there are between two places."""
    return time_at(page, 0.9) - time_at(page, 0.5)


def press(page: Page, key: str, code: int) -> None:
    """A key that comes to the canvas."""
    page.eval("document.querySelector('#plot').focus()")
    page.press(key, code, key)
    settle(page)


def click(page: Page, button: str) -> None:
    page.click(f"#tools [data-do={button}]")
    settle(page)


def colours(page: Page) -> int:
    """How many colours the canvas shows."""
    return int(
        page.eval(
            "(() => { const c = document.querySelector('#plot');"
            "const d = new Uint32Array("
            "c.getContext('2d').getImageData(0, 0, c.width, c.height).data.buffer);"
            "return new Set(d).size })()"
        )
    )


@pytest.mark.sample(1)
@needs_chromium
@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (400, "dark")])
def test_look_zoom_move_and_read(
    protocol: Protocol, page: Page, show: Open, tmp_path: Path, width: int, scheme: str
) -> None:
    page.size(width)
    page.scheme(scheme)
    show(written(tmp_path / "c.mcap", drive(protocol, 400)))

    # Nothing is wider than the window, the ground is as asked for, and the canvas is not empty.
    red = page.eval("+getComputedStyle(document.body).backgroundColor.match(/\\d+/)[0]")
    assert (red > 128) is (scheme == "light")
    assert colours(page) > 20

    # The wheel zooms at the place where it is turned; a button shows all again.
    whole, held = span(page), time_at(page, 0.7)
    mouse(page, "mouseWheel", spot(page, 0.7), deltaX=0, deltaY=-600)
    assert span(page) < whole / 2
    assert time_at(page, 0.7) == pytest.approx(held, abs=0.05)
    assert page.eval("document.documentElement.scrollWidth") == width
    click(page, "all")
    assert span(page) == pytest.approx(whole, rel=0.01)

    # A drag moves what is under the pointer along.
    click(page, "in")
    held = time_at(page, 0.6)
    mouse(page, "mousePressed", spot(page, 0.6), button="left", clickCount=1)
    for share in (0.7, 0.8):
        mouse(page, "mouseMoved", spot(page, share), button="left", buttons=1)
    mouse(page, "mouseReleased", spot(page, 0.8), button="left", clickCount=1)
    assert time_at(page, 0.8) == pytest.approx(held, abs=whole / 50)

    # Keys do the same.
    before = span(page)
    press(page, "+", 187)
    assert span(page) == pytest.approx(before / 2, rel=0.05)
    press(page, "0", 48)
    assert span(page) == pytest.approx(whole, rel=0.01)
    assert page.eval("document.querySelector('[data-do=all]').disabled")


@needs_chromium
def test_the_line_crosses_a_fold_and_the_times_beside_it_are_the_recordings(
    protocol: Protocol, page: Page, show: Open, tmp_path: Path
) -> None:
    first, second = drive(protocol, 200), drive(protocol, 200, 2)
    later = [replace(event, t=event.t + 3600 * SECOND) for event in second]
    show(written(tmp_path / "c.mcap", [*first, *later]))

    # On both sides of the fold, which stands in the middle, a pixel is as long as on the other.
    early, late = (time_at(page, share + 0.1) - time_at(page, share) for share in (0.2, 0.8))
    assert early == pytest.approx(late, rel=0.03)
    assert time_at(page, 0.45) < 8
    assert time_at(page, 0.65) > 3600

    # Its middle is at the middle of the axis, and stays there while it is zoomed.
    page.eval(f"location.hash = '#t={1805 * SECOND}'")
    settle(page)
    press(page, "+", 187)
    assert 8 < seconds(page) < 3600
    assert time_at(page, 0.99) > 3600


@needs_chromium
def test_two_fingers_zoom_and_the_overview_moves(
    protocol: Protocol, page: Page, show: Open, tmp_path: Path
) -> None:
    page.size(400)
    show(written(tmp_path / "c.mcap", drive(protocol, 400)))
    whole = span(page)

    def fingers(kind: str, *shares: float) -> None:
        points = [{"x": x, "y": y} for x, y in (spot(page, share) for share in shares)]
        page.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)
        settle(page)

    fingers("touchStart", 0.4, 0.6)
    fingers("touchMove", 0.3, 0.7)
    fingers("touchMove", 0.2, 0.8)
    fingers("touchEnd")
    near = span(page)
    assert near == pytest.approx(whole / 3, rel=0.15)

    late = time_at(page, 0.5)
    for kind in ("mousePressed", "mouseReleased"):
        mouse(page, kind, spot(page, 0.9, "#map"), button="left", buttons=1, clickCount=1)
    assert time_at(page, 0.5) > late + near / 2
    assert span(page) == pytest.approx(near, rel=0.01)


@needs_chromium
def test_what_is_told_at_a_time_is_what_the_records_say(
    protocol: Protocol, show: Open, tmp_path: Path
) -> None:
    file = written(tmp_path / "c.mcap", drive(protocol, 300))
    records = records_of(file, protocol)
    page = show(file)

    for record in hosts(records)[::37]:
        page.eval(f"location.hash = '#t={record.known + 10 * MS}'")
        page.wait(
            f"Math.abs({(record.known + 10 * MS) / 1e9} - parseFloat("
            "document.querySelector('[data-of=time]').textContent)) < 0.01"
        )
        assert told(page, "motion").startswith(record.state.motion.replace("_", " "))
        assert ("not moving" in told(page, "motion")) is (
            record.state.motion != Motion.STOPPED and not record.state.moving
        )
        assert told(page, "speed") == str(record.state.speed)
        assert told(page, "steering") == str(record.state.steering)
        last = [r.latency for r in devices(records) if r.t <= record.known + 10 * MS][-1]
        assert float(told(page, "latency").split()[0]) == pytest.approx((last or 0) / MS, rel=1e-3)


@needs_chromium
def test_an_anomaly_is_told_with_its_reason(protocol: Protocol, show: Open, tmp_path: Path) -> None:
    file = written(tmp_path / "c.mcap", drive(protocol, 300))
    faults = [fault for r in records_of(file, protocol) for fault in serious_faults(r)]
    page = show(file)

    for fault in faults[:3]:
        press(page, "n", 78)
        assert fault.reason in told(page, "anomaly")
        assert fault.kind in told(page, "anomaly")
    press(page, "N", 78)
    assert seconds(page) == pytest.approx(faults[1].t / 1e9, abs=0.02)
    page.click("#anomalies tbody tr:nth-child(4) a")
    settle(page)
    assert seconds(page) == pytest.approx(faults[3].t / 1e9, abs=0.02)
    assert page.eval("document.activeElement.id") == "plot"
    click(page, "all")
    click(page, "next")
    assert faults[4].reason in told(page, "anomaly")


@needs_chromium
def test_a_recording_of_nothing_is_shown_without_a_complaint(
    page: Page, show: Open, tmp_path: Path
) -> None:
    show(written(tmp_path / "c.mcap", []))
    click(page, "in")
    assert page.complaints == []


@needs_chromium
@pytest.mark.usefixtures("little_room")  # so that what is told is as long as it gets
@pytest.mark.sample(1)
@pytest.mark.parametrize("width", [1280, 900, 400])
def test_the_read_out_covers_nothing_cuts_nothing_and_moves_nothing(
    protocol: Protocol, page: Page, show: Open, tmp_path: Path, width: int
) -> None:
    page.size(width)
    show(written(tmp_path / "c.mcap", drive(protocol, 1500)))

    def layout() -> dict[str, Any]:
        found: dict[str, Any] = page.eval(
            "(() => { const box = document.querySelector('#readout').getBoundingClientRect();"
            "const canvas = document.querySelector('#plot').getBoundingClientRect();"
            "const cells = [...document.querySelectorAll('#readout dd')];"
            "return { left: box.left, right: box.right, height: box.height,"
            " over: canvas.top - box.bottom, down: canvas.top + scrollY,"
            " words: cells.map(c => c.textContent).join(' | '),"
            " wide: cells.filter(c => c.scrollWidth > c.clientWidth).map(c => c.dataset.of),"
            " high: cells.filter(c => c.scrollHeight > c.clientHeight &&"
            " getComputedStyle(c).overflowY != 'auto').map(c => c.dataset.of),"
            " reaches: cells.every(c => c.getBoundingClientRect().bottom <= box.bottom) } })()"
        )
        return found

    seen = [layout()]
    for place in range(5):
        mouse(page, "mouseMoved", spot(page, 0.2 + place / 7))
        seen.append(layout())
    for _ in range(5):
        press(page, "n", 78)
        seen.append(layout())

    assert len({one["words"] for one in seen}) > 5
    for one in seen:
        assert 0 <= one["left"] < one["right"] <= width
        assert one["over"] >= 0
        assert (one["wide"], one["high"], one["reaches"]) == ([], [], True), one["words"]
    assert len({(one["height"], one["down"]) for one in seen}) == 1
    assert any(" to " in one["words"] for one in seen)
    assert page.complaints == []
