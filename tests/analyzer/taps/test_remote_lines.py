"""Robots on remote lines: a pty behind ser2net (raw TCP, RFC 2217) and socat."""

from __future__ import annotations

import os
import select
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path

import pytest

from bilprov.analyzer.transport.port import open_port
from tests.support.commands import running
from tests.support.robots import PATIENCE

pytestmark = pytest.mark.waits

INSTALL = "apt-get install ser2net socat"
ALL = bytes(range(256))


def tool(name: str) -> str:
    """The tool's path; where it is missing the test is skipped."""
    # ser2net lives where only root looks.
    found = shutil.which(name, path=os.environ.get("PATH", "") + ":/usr/sbin:/sbin")
    if found is None:
        pytest.skip(INSTALL)
    return found


@contextmanager
def tool_running(*words: str, ready: Callable[[], bool]) -> Iterator[None]:
    """Run a tool until the block ends; begin once it is ready."""
    with subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as process:
        try:
            give_up = time.monotonic() + PATIENCE
            while not ready():
                assert process.poll() is None, process.stdout and process.stdout.read()
                assert time.monotonic() < give_up, f"{words[0]} is never ready"
                time.sleep(0.01)
            yield
        finally:
            process.kill()


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def listens(port: int) -> bool:
    """Whether somebody listens; asking by connecting would take the only place."""
    table = Path("/proc/net/tcp").read_text(encoding="ascii")
    return f":{port:04X} 00000000:0000 0A " in table


SER2NET = """\
%YAML 1.1
---
connection: &robot
  accepter: {accepter},127.0.0.1,{port}
  connector: serialdev,{device},115200n81,local
  options:
    chardelay: false
"""
RAW = "tcp(nodelay)"
RFC2217 = "telnet(rfc2217,mode=server),tcp(nodelay)"


@contextmanager
def behind_ser2net(device: str, folder: Path, accepter: str) -> Iterator[str]:
    """The device behind ser2net; gives the URL to open."""
    program, port, file = tool("ser2net"), free_port(), folder / "ser2net.yaml"
    file.write_text(SER2NET.format(accepter=accepter, port=port, device=device), encoding="utf-8")
    raw, remote = f"socket://127.0.0.1:{port}", f"rfc2217://127.0.0.1:{port}?ign_set_control"
    # In the foreground, without a lock file.
    with tool_running(program, "-n", "-u", "-c", str(file), ready=lambda: listens(port)):
        yield raw if accepter == RAW else remote


@contextmanager
def behind_socat(device: str, folder: Path) -> Iterator[str]:
    """The device behind a second pty, joined to its own by socat."""
    path = folder / "robot"
    ends = f"PTY,rawer,link={path}", f"OPEN:{device},rawer"
    with tool_running(tool("socat"), *ends, ready=path.exists):
        yield str(path)


Behind = Callable[[str, Path], AbstractContextManager[str]]
LINES: dict[str, Behind] = {
    "raw TCP": partial(behind_ser2net, accepter=RAW),
    "RFC 2217": partial(behind_ser2net, accepter=RFC2217),
    "socat": behind_socat,
}


@pytest.mark.parametrize("name", LINES)
def test_every_byte_passes_both_ways(name: str, tmp_path: Path) -> None:
    """Between two programs of ours: one on the device's pty, one behind the line."""
    with running("lab", "line", "pty", "pty") as line:
        device, other = (line.stdout.readline().decode().strip() for _ in range(2))
        with LINES[name](device, tmp_path) as url, open_port(url) as near, open_port(other) as far:
            for here, there in ((near, far), (far, near)):
                here.write(ALL)
                heard = b""
                while len(heard) < len(ALL):
                    ready = select.select([there], [], [], PATIENCE)[0]
                    assert ready, f"only {heard!r} came"
                    heard += there.read()
                assert heard == ALL
