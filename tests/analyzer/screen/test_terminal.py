"""The screen in a real terminal (tmux): what it shows at each size, and how it is left."""

from __future__ import annotations

import os
import resource
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from bilprov.analyzer.transport.port import PtyPair, open_pty
from bilprov.captures.reader import open_capture
from bilprov.captures.schemas import Chunk
from bilprov.captures.writer import CaptureWriter
from tests.support import ROOT
from tests.support.screens import Tmux, terminal
from tests.support.terminals import CONTINUE, CTRL_Z, as_job

pytestmark = pytest.mark.waits

SAMPLE = ROOT / "captures" / "samples" / "examples.mcap"
SIZES = [(40, 10), (80, 24), (132, 43), (200, 60)]
ECHO = "typed-in-the-shell"


def left(tmux: Tmux, code: int = 0) -> list[str]:
    """Wait for the command's end, and type into the shell: no key has reached it before."""
    tmux.wait(f"ended {code}")
    tmux.press(ECHO, "Enter")
    # the terminal's echo, and cat's
    shown = tmux.wait(lambda lines: sum(ECHO in line for line in lines) == 2)
    at = next(at for at, line in enumerate(shown) if f"ended {code}" in line)
    assert [line for line in shown[at + 1 :] if line] == [ECHO, ECHO]
    return shown[:at]


def test_a_capture_shows_what_fits_at_each_size_and_gives_the_terminal_back(tmp_path: Path) -> None:
    with terminal(tmp_path, SIZES[0], "replay", str(SAMPLE)) as tmux:
        tmux.wait("84 rows")
        tmux.press("n", "n")
        for columns, rows in SIZES:

            def fits(shown: list[str], columns: int = columns, rows: int = rows) -> bool:
                return (
                    len(shown) == rows
                    and any("ff" in line and "unused 15" in line for line in shown)
                    and any("┌──" in line for line in shown) == (columns >= 110)
                    and shown[0].startswith("examples.mcap")
                    and len(shown[0]) == columns
                    and shown[0].endswith("84 rows")
                    and shown[-1].endswith("q quit")
                )

            tmux.resize((columns, rows))
            tmux.wait(fits)
        tmux.press("q", "j", "j", "Enter", "x")
        left(tmux)


@contextmanager
def sniffed(
    folder: Path, size: tuple[int, int], *words: str, **environment: str
) -> Iterator[tuple[Tmux, PtyPair, PtyPair]]:
    """The screen of `sniff` on two taps, which other programs write to."""
    with (
        open_pty() as host,
        open_pty() as device,
        terminal(folder, size, "sniff", host.name, device.name, *words, **environment) as tmux,
    ):
        yield tmux, host, device


def talk(
    host: PtyPair, device: PtyPair, tmux: Tmux, shows: str | Callable[[list[str]], bool]
) -> None:
    """Say a frame now and then until the screen shows the words or satisfies the test."""

    def say() -> None:
        os.write(host.master, b"\x11\x50")
        os.write(device.master, b"\0")

    tmux.wait(shows, say)


def test_sniff_follows_the_line_at_each_size_and_finishes_its_capture(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with sniffed(tmp_path, SIZES[0], "-w", str(path)) as (tmux, host, device):
        tmux.wait("q quit")
        for size in SIZES:

            def follows(shown: list[str], rows: int = size[1]) -> bool:
                return (
                    len(shown) == rows
                    and any("following" in line for line in shown)
                    and any("Speed speed=80" in line for line in shown)
                    and shown[-1].endswith("q quit")
                )

            tmux.resize(size)
            talk(host, device, tmux, follows)
        tmux.press("q", "q", "j")
        assert any(" answer" in line for line in left(tmux))
    assert not open_capture(path).unfinished


def test_a_session_without_a_file_is_saved_if_asked(tmp_path: Path) -> None:
    with sniffed(tmp_path, (80, 24)) as (tmux, host, device):
        tmux.wait("q quit")
        talk(host, device, tmux, "Speed speed=80")
        tmux.press("q")
        tmux.wait("Save the capture")
        tmux.press("kept.mcap")  # in place of the name that is proposed
        tmux.wait("kept.mcap")
        tmux.press("Enter")
        assert any("kept.mcap" in line for line in left(tmux))
    capture = open_capture(tmp_path / "kept.mcap")
    assert not capture.unfinished
    host_bytes = b"".join(
        event.data for event in capture if isinstance(event, Chunk) and event.direction == "host"
    )
    assert host_bytes
    assert host_bytes == b"\x11\x50" * (len(host_bytes) // 2)


def pid_of(words: str) -> int:
    """The process whose command line has these words."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            line = (folder / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if b"bilprov" in line and words.encode() in line:
            return int(folder.name)
    raise AssertionError(words)


@pytest.mark.sample(1)
@pytest.mark.parametrize("how", ["C-c", signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_every_way_out_leaves_a_sane_terminal_and_a_finished_capture(
    tmp_path: Path, how: str | signal.Signals
) -> None:
    path = tmp_path / "run.mcap"
    with sniffed(tmp_path, (80, 24), "-w", str(path)) as (tmux, host, device):
        tmux.wait("q quit")
        talk(host, device, tmux, "Speed speed=80")
        if isinstance(how, str):
            tmux.press(how)
        else:
            os.kill(pid_of(str(path)), how)
        left(tmux)
    assert not open_capture(path).unfinished


def test_ctrl_z_suspends_the_screen_which_goes_on_where_it_was() -> None:
    with as_job("-m", "bilprov", "replay", str(SAMPLE)) as job:
        job.wait_for(" quit")
        job.type("/faulty" + CTRL_Z)  # also while a line is typed
        job.wait_for("Stopped")
        job.type(CONTINUE)
        job.wait_for("Enter filters")
        job.type("\rq")
        job.wait_for("ended with 0")


def test_an_unplugged_tap_is_told_on_the_screen_and_in_the_last_line(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with sniffed(tmp_path, (100, 30), "-w", str(path)) as (tmux, host, device):
        tmux.wait("q quit")
        talk(host, device, tmux, "Speed speed=80")
        device.close()
        tmux.wait("listening goes on without the device")
        os.write(host.master, b"\x11\x51")
        tmux.wait("Speed speed=81")
        host.close()
        tmux.wait(host.name)
        tmux.wait("unplugged")
        tmux.press("q")
        assert any("kept in" in line for line in left(tmux, code=2))
    assert not open_capture(path).unfinished


def test_a_full_disk_is_told_on_the_screen_which_goes_on_and_in_the_last_line(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.mcap"
    with sniffed(tmp_path, (100, 30), "-w", str(path)) as (tmux, host, device):
        tmux.wait("q quit")
        talk(host, device, tmux, "Speed speed=80")
        tmux.wait("run.mcap")
        size = path.stat().st_size
        resource.prlimit(pid_of(str(path)), resource.RLIMIT_FSIZE, (size, size))
        talk(host, device, tmux, "disk full: what was captured until")
        os.write(host.master, b"\x11\x51")
        tmux.wait("Speed speed=81")
        tmux.press("q")
        assert any("bilprov: disk full" in line for line in left(tmux, code=2))
    assert open_capture(path).damage == ()


def test_keys_typed_before_the_screen_is_there_are_a_filter_as_well(tmp_path: Path) -> None:
    with terminal(tmp_path, (80, 24), "replay", str(SAMPLE)) as tmux:
        tmux.press("/", "l", "a")
        tmux.wait("filter / la")
        tmux.press("t", "?", "q")
        tmux.wait("filter / lat?q")
        tmux.press("Escape")
        tmux.wait("q quit")
        tmux.press("q")
        left(tmux)


def test_plain_means_lines_on_a_terminal(tmp_path: Path) -> None:
    with terminal(tmp_path, (100, 50), "replay", "--plain", "--rate", "0", str(SAMPLE)) as tmux:
        assert any("→ 20" in line for line in left(tmux))


def test_without_colours_and_without_utf_8_it_is_readable(tmp_path: Path) -> None:
    with terminal(
        tmp_path,
        (80, 24),
        *("replay", str(SAMPLE)),
        NO_COLOR="1",
        PYTHONIOENCODING="ascii",
    ) as tmux:
        tmux.wait("84 rows")
        tmux.press("n")
        tmux.wait(" > 40 ")
        coloured = "\n".join(tmux.lines("-e"))
        assert coloured.isascii()
        assert "\x1b[7m" in coloured  # the chosen row
        assert not any(f"\x1b[{code}m" in coloured for code in range(30, 38))
        tmux.press("q")
        left(tmux)


def test_a_capture_without_traffic_can_be_browsed(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    with CaptureWriter(path, start_wall=0, metadata={}, version="1"):
        pass
    with terminal(tmp_path, (80, 24), "replay", str(path)) as tmux:
        tmux.wait("holds no traffic")
        tmux.press("n", "End", "Enter", "t", "y", "r", "e", "e", ":", "5", "Enter", "/")
        tmux.wait("filter /")
        tmux.press("faulty", "Enter")
        tmux.wait("  0 of 0")
        tmux.press("q")
        left(tmux)


BREAKING = """
from bilprov.analyzer.screen.frame_list import FrameList

def fails(*arguments):
    raise ValueError("a row that cannot be drawn")

FrameList._what = fails
"""


@pytest.mark.parametrize("named", [True, False])
def test_a_screen_that_fails_ends_no_recording(tmp_path: Path, named: bool) -> None:
    (tmp_path / "sitecustomize.py").write_text(BREAKING)
    places = f"{ROOT / 'src'}{os.pathsep}{tmp_path}"
    words = ["-w", "run.mcap"] if named else []
    with sniffed(tmp_path, (100, 30), *words, PYTHONPATH=places) as (tmux, host, device):
        talk(host, device, tmux, "the screen has failed; listening goes on without it")
        for _ in range(3):
            os.write(host.master, b"\x11\x51")
            time.sleep(0.05)
        os.kill(pid_of(host.name), signal.SIGINT)
        shown = left(tmux, code=2)
        assert any("a row that cannot be drawn" in line for line in shown)
        assert not any("│" in line for line in shown)
    (path,) = tmp_path.glob("*.mcap")
    events = open_capture(path)
    assert not events.unfinished
    heard = b"".join(e.data for e in events if isinstance(e, Chunk) and e.direction == "host")
    assert heard.endswith(b"\x11\x51" * 3)
