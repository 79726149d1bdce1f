"""Ports: real ptys and sockets, every byte value, and one sentence for each kind of failure."""

from __future__ import annotations

import errno
import os
import select
import shutil
import socket
import subprocess
import sys
import termios
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial
import serial.rfc2217

from bilprov.analyzer.transport.errors import LinkError, link_lost, opening_failed
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.machine import Machine
from bilprov.analyzer.transport.port import Port, PtyPair, open_port, open_pty
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.wires import master_gives, read_from
from tests.vectors import LINE

pytestmark = pytest.mark.waits

ALL = bytes(range(256))
# A child that may not open what its owner root may.
AS_NOBODY = """
import os, sys
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import LineSettings
from bilprov.analyzer.transport.port import open_port
if os.geteuid() == 0:
    os.setgroups([]); os.setegid(65534); os.seteuid(65534)
try:
    open_port(sys.argv[1], LineSettings(9600, "N", 1))
except LinkError as error:
    print(error)
"""


@pytest.fixture
def pty() -> Iterator[PtyPair]:
    with open_pty() as pair:
        yield pair


@pytest.fixture
def port(pty: PtyPair) -> Iterator[Port]:
    with open_port(pty.name) as opened:
        yield opened


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as made:
        yield made


def url(listener: socket.socket, scheme: str = "socket") -> str:
    return f"{scheme}://127.0.0.1:{listener.getsockname()[1]}"


def refusal(name: str, settings: LineSettings | None = None) -> str:
    with pytest.raises(LinkError) as caught:
        open_port(name, settings)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# Line settings


def test_a_port_whose_link_is_removed_is_what_it_was(tmp_path: Path) -> None:
    link = tmp_path / "robot"
    with open_pty() as pair:
        link.symlink_to(pair.name)
        with open_port(str(link)) as port:
            link.unlink()
            assert port.byte_time == 0


@pytest.mark.parametrize(
    ("settings", "text", "byte_time"),
    [
        (LineSettings(115200, "N", 1), "115200 8N1", 86_806),
        (LineSettings(9600, "N", 1.5), "9600 8N1.5", 1_093_750),
        (LineSettings(1_000_000, "O", 2), "1000000 8O2", 12_000),
    ],
)
def test_line_settings_say_themselves_and_their_byte_time(
    settings: LineSettings, text: str, byte_time: int
) -> None:
    assert str(settings) == text
    assert settings.byte_time == byte_time


@pytest.mark.parametrize(
    ("settings", "options"),
    [
        (LineSettings(115200, "N", 1), ""),
        (LineSettings(1_000_000, "N", 1.0), "--baud 1000000"),
        (LineSettings(115200, "E", 1.5, echo=True), "--parity E --stopbits 1.5 --echo"),
    ],
)
def test_line_settings_are_options_where_they_differ_from_the_grammars(
    protocol: Protocol, settings: LineSettings, options: str
) -> None:
    assert settings.options(protocol) == options


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"baud": 0}, "baud is 0, allowed are whole numbers from 1"),
        ({"parity": "X"}, "parity is 'X', allowed are N, E, O, M and S"),
        ({"stopbits": 3}, "stopbits is 3, allowed are 1, 1.5 and 2"),
    ],
)
def test_line_settings_that_no_line_has_are_refused(wrong: dict[str, int], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence.replace(".", r"\.")):
        LineSettings(**({"baud": 9600, "parity": "N", "stopbits": 1} | wrong))  # type: ignore[arg-type]


def test_a_port_without_settings_is_set_as_the_grammar_says() -> None:
    with open_pty() as pair, open_port(pair.name) as port:
        assert str(port.settings) == f"{LINE['baud']} 8{LINE['parity']}{LINE['stopbits']}"


# Bytes


@pytest.mark.parametrize("name", ["{}", "spy://{}"])
def test_every_byte_passes_a_pty_unchanged_both_ways(pty: PtyPair, name: str) -> None:
    with open_port(name.format(pty.name)) as port:
        port.write(ALL)
        assert master_gives(pty, 256) == ALL
        assert pty.write_some(ALL) == 256
        assert read_from(port, 256) == ALL


def test_a_pty_is_raw_before_anybody_opens_it(pty: PtyPair) -> None:
    slave = os.open(pty.name, os.O_RDWR | os.O_NOCTTY)
    try:
        assert pty.write_some(ALL) == 256
        got = b""
        while len(got) < 256:
            got += os.read(slave, 256)
        assert got == ALL
        assert pty.read() == b""  # no echo
    finally:
        os.close(slave)
    assert pty.read() == b""  # the last close is no error


def test_every_byte_passes_a_socket_unchanged_without_delay_until_its_peer_closes(
    listener: socket.socket,
) -> None:
    with open_port(url(listener)) as port:
        with listener.accept()[0] as peer:
            port.write(ALL)
            assert peer.recv(256, socket.MSG_WAITALL) == ALL
            peer.sendall(ALL)
        with socket.socket(fileno=os.dup(port.fileno() or -1)) as same:
            assert same.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        assert read_from(port, 256) == ALL
        with pytest.raises(LinkError):
            read_from(port, 1)
        port.close()  # twice, with the end of the block


def test_a_loop_passes_every_byte_that_fits() -> None:
    with open_port("loop://") as port:
        assert not select.select([port], [], [], 0)[0]
        assert port.read(ready=True) == b""  # where others took what was there
        port.write(ALL)
        assert read_from(port, 256) == ALL
        assert port.read() == b""
        with pytest.raises(LinkError, match="took no byte"):
            port.write(bytes(1 << 20))


class Redirector:
    """A small rfc2217 server: what comes out of the telnet layer goes back in."""

    def __init__(self, peer: socket.socket) -> None:
        self.peer = peer

    def write(self, data: bytes) -> None:
        self.peer.sendall(data)

    def run(self) -> None:
        with serial.serial_for_url("loop://", timeout=0) as line, self.peer:
            manager = serial.rfc2217.PortManager(line, self)  # type: ignore[arg-type]
            seen = 0
            while seen < 256 and (data := self.peer.recv(4096)):
                for byte in manager.filter(data):
                    seen += 1
                    self.write(b"".join(manager.escape(byte)))


def test_every_byte_passes_rfc2217_and_none_is_lost_when_the_peer_goes(
    listener: socket.socket,
) -> None:
    def answer() -> None:
        Redirector(listener.accept()[0]).run()

    thread = threading.Thread(target=answer)
    thread.start()
    with open_port(url(listener, "rfc2217")) as port:
        port.write(ALL)
        thread.join()
        assert read_from(port, 256) == ALL
        with pytest.raises(LinkError, match="closed by the other side"):
            read_from(port, 1)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_an_rfc2217_peer_that_breaks_the_telnet_layer_is_lost(listener: socket.socket) -> None:
    def answer() -> None:
        peer = listener.accept()[0]
        line = serial.serial_for_url("loop://", timeout=0)
        manager = serial.rfc2217.PortManager(line, Redirector(peer))  # type: ignore[arg-type]
        with peer, line:
            while b"x" not in b"".join(manager.filter(peer.recv(4096))):
                pass
            peer.sendall(b"x\xff\xf0")  # the end of an option that has not begun
            peer.recv(1)

    thread = threading.Thread(target=answer)
    thread.start()
    with open_port(url(listener, "rfc2217")) as port:
        port.write(b"x")
        assert read_from(port, 1) == b"x"
        with pytest.raises(LinkError, match="closed by the other side"):
            read_from(port, 1)
    thread.join()


def test_a_break_does_not_throw_away_pending_bytes(pty: PtyPair) -> None:
    slave = os.open(pty.name, os.O_RDWR | os.O_NOCTTY)
    try:
        attributes = termios.tcgetattr(slave)
        attributes[0] |= termios.BRKINT | termios.IXON
        termios.tcsetattr(slave, termios.TCSANOW, attributes)
        with open_port(pty.name):
            assert not termios.tcgetattr(slave)[0] & (termios.BRKINT | termios.IXON)
    finally:
        os.close(slave)


# The end of a line


def test_an_unplugged_port_gives_its_last_bytes_and_then_says_so() -> None:
    pty = open_pty()
    with open_port(pty.name) as port:
        pty.close()
        select.select([port], [], [])
        with pytest.raises(LinkError, match=f"^{pty.name} disappeared while it was in use"):
            port.read()
        with pytest.raises(LinkError, match="disappeared"):
            port.write(b"x")


def test_a_device_that_does_not_read_ends_a_write(port: Port) -> None:
    with pytest.raises(LinkError, match="took no byte for 1 s; does anything read"):
        port.write(bytes(1 << 20))


def test_a_write_that_fits_exactly_is_no_timeout(pty: PtyPair) -> None:
    # pyserial's own write fails here: it waits for room that it does not need.
    with open_port(pty.name) as port:
        room = 0
        while count := port.write_some(bytes(4096)):
            room += count
    with open_pty() as other, open_port(other.name) as port:
        port.write(bytes(room))
        assert master_gives(other, room) == bytes(room)


def test_closing_twice_is_as_good_as_once_and_a_closed_port_says_so(pty: PtyPair) -> None:
    port = open_port(pty.name)
    port.close()
    port.close()
    for use in (port.read, port.fileno, lambda: port.write(b"x"), port.error_counts):
        with pytest.raises(LinkError, match=f"^{pty.name} is closed$"):
            use()
    with open_port(pty.name):  # the lock is gone
        pass


# What cannot be opened


def test_a_port_in_use(pty: PtyPair, port: Port) -> None:
    already = f"{pty.name} is open in this program already; a port is opened once"
    assert refusal(pty.name) == refusal(f"spy://{pty.name}") == already


def test_a_port_in_use_by_another_program_says_which_and_how_to_end_it(pty: PtyPair) -> None:
    code = (
        "import sys; from bilprov.analyzer.transport.port import open_port\n"
        "port = open_port(sys.argv[1]); print(flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, pty.name],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        cwd=ROOT,
    ) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        with pytest.raises(LinkError) as caught:
            open_port(pty.name)
        assert caught.value.command == f"kill {holder.pid}"
        assert f"(pid {holder.pid}); close it there, or end it: kill" in str(caught.value)
        holder.communicate()


ALONE = (
    "it belongs to {owner} alone; until it is plugged in again this lets everybody: "
    "sudo chmod a+rw {name}"
)
GROUP = (
    "it belongs to root and the group dialout; join the group, then log in again: "
    "sudo usermod -aG dialout $USER"
)


@pytest.mark.parametrize(
    ("mode", "group", "why"),
    [(0, 0, ALONE), (0o660, 0, ALONE), (0o660, "dialout", GROUP)],  # nobody should join root's
)
def test_a_port_without_permission_says_who_may_and_which_group_to_join(
    pty: PtyPair, mode: int, group: int | str, why: str
) -> None:
    if os.geteuid() == 0:
        shutil.chown(pty.name, group=group)
    elif group:
        pytest.skip("only root can give a pty to another group: sudo make test brings it")
    Path(pty.name).chmod(mode if os.geteuid() == 0 else 0)
    python = [sys.executable, "-c", AS_NOBODY, pty.name]
    done = subprocess.run(python, capture_output=True, text=True, check=True, cwd=ROOT)

    because = why.format(owner=Path(pty.name).owner(), name=pty.name)
    assert done.stdout == f"permission to open {pty.name} is denied: {because}\n"


def test_a_url_is_no_path_also_where_the_working_folder_is_gone(
    listener: socket.socket, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    with open_port(url(listener)) as port:
        assert Machine().least_pause(port.name) == 0


@pytest.mark.parametrize("number", [errno.ENXIO, errno.ENODEV, errno.EIO])
def test_numbers_of_a_device_that_is_not_there_mean_one_thing(number: int) -> None:
    error = OSError(number, "x")
    assert "no device behind it" in str(opening_failed("/dev/ttyUSB0", error, ""))
    assert "/dev/ttyUSB0 disappeared" in str(link_lost("/dev/ttyUSB0", error))


@pytest.mark.parametrize("parity", ["E", "O"])
def test_a_pty_is_opened_again_and_again_with_the_parity_of_a_line(parity: str) -> None:
    with open_pty() as pty:
        for _ in range(3):
            with open_port(pty.name, LineSettings(19200, parity, 1)) as port:
                assert str(port.settings) == f"19200 8{parity}1"
