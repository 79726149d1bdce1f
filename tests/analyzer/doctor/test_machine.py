"""What a machine tells of its ports: adapters from made-up trees, processes and ptys for real."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from bilprov.analyzer.transport.machine import Machine
from bilprov.analyzer.transport.port import open_pty
from tests.support import ROOT
from tests.support.machines import FakeMachine

# Programs that do something to a pty and wait.
OPENS = "import os, sys; os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print(flush=True)"
SERVES = "import os; master, slave = os.openpty(); print(os.ttyname(slave), flush=True)"
# Who holds a pty, as somebody sees it who may look into nobody else's processes.
AS_NOBODY = """
import os, sys
from bilprov.analyzer.transport.machine import Machine
if os.geteuid() == 0:
    os.setgroups([]); os.setegid(65534); os.seteuid(65534)
(held,) = Machine().held(sys.argv[1]).values()
print(*(process.pid for process in held.holders), held.unseen > 0)
"""


@pytest.fixture
def machine(tmp_path: Path) -> FakeMachine:
    return FakeMachine(tmp_path)


@contextmanager
def program(code: str, *arguments: str) -> Iterator[tuple[int, str]]:
    """Run Python code until the block ends; gives its process id and the first line it printed."""
    with subprocess.Popen(
        [sys.executable, "-c", f"{code}\nimport sys; sys.stdin.read()", *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    ) as running:
        assert running.stdout is not None
        line = running.stdout.readline().strip()
        yield running.pid, line
        running.communicate()


# The adapter


def test_a_lasting_name_leads_to_the_same_adapter(machine: FakeMachine) -> None:
    port = machine.adapter("ttyACM0", "2341:0043", driver="cdc_acm", latency=None)
    lasting = machine.by_id(port)
    assert machine.device(lasting) == port
    assert machine.usb(lasting) == machine.usb(port) is not None
    assert machine.driver(port) == "cdc_acm"
    assert machine.latency_timer(port) is None


def test_a_port_of_the_mainboard_is_no_usb_device(machine: FakeMachine) -> None:
    chip = "/sys/devices/pnp0/00:05"
    port = f"{chip}/00:05:0/00:05:0.0"
    machine.write("/dev/ttyS0")
    machine.write(f"{port}/uevent")
    machine.link("/sys/class/tty/ttyS0/device", port)
    for folder in (port, f"{chip}/00:05:0"):
        machine.link(f"{folder}/subsystem", "/sys/bus/serial-base")
        machine.link(f"{folder}/driver", "/sys/bus/serial-base/drivers/port")
    machine.link(f"{chip}/driver", "/sys/bus/pnp/drivers/serial")
    assert machine.usb("/dev/ttyS0") is None
    assert machine.driver("/dev/ttyS0") == "serial"


def test_a_name_without_a_chip_behind_it_is_told_from_a_port(machine: FakeMachine) -> None:
    machine.write("/sys/class/tty/ttyS0/type", "4\n")
    machine.write("/sys/class/tty/ttyS9/type", "0\n")
    assert [machine.no_hardware(f"/dev/ttyS{number}") for number in (0, 9)] == [False, True]


def test_where_a_system_has_no_such_files_nothing_is_known(tmp_path: Path) -> None:
    bare = Machine(tmp_path)
    port = "/dev/cu.usbserial-1"
    assert bare.usb(port) is bare.latency_timer(port) is None
    assert bare.driver(port) == bare.by_id(port) == ""
    assert bare.properties(port) == {}
    assert bare.taken_for_braille() is None
    assert bare.held(port)[port].holders == ()
    assert not bare.running("ModemManager")
    assert bare.owner(port) is None


# Who holds it


def test_links_in_a_circle_lead_to_no_device(tmp_path: Path) -> None:
    circle = tmp_path / "circle"
    circle.symlink_to("circle")
    assert Machine().device(str(circle)) == str(circle)


def test_holders_of_several_ports_are_found_at_once(machine: FakeMachine) -> None:
    machine.run(42, "minicom", "/dev/null", "/dev/ttyUSB0", line="minicom\0-D\0/dev/ttyUSB0\0")
    machine.run(43, "socat", "/dev/ttyUSB1", "/dev/ttyUSB0")
    machine.run(44, "bash", "/dev/pts/1")
    held = machine.held("/dev/ttyUSB0", "/dev/ttyUSB1", "/dev/ttyUSB2")
    assert [[one.pid for one in held[name].holders] for name in held] == [[42, 43], [43], []]
    assert str(held["/dev/ttyUSB0"].holders[0]) == "minicom -D /dev/ttyUSB0 (pid 42)"


@pytest.mark.waits
def test_a_program_that_has_a_pty_open_is_named() -> None:
    with open_pty() as pty, program(OPENS, pty.name) as (pid, _):
        held = Machine().held(pty.name)[pty.name]
        assert [one.pid for one in held.holders] == [pid]
        assert held.own
        assert held.holders[0].name.startswith("python")
        assert Machine().is_own(pid)


@pytest.mark.waits
def test_the_program_at_the_other_end_of_a_pty_is_no_holder() -> None:
    with program(SERVES) as (_, name):
        held = Machine().held(name)[name]
        assert held.holders == ()


@pytest.mark.waits
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody else")
def test_other_users_files_are_seen_by_nobody() -> None:
    with open_pty() as pty, program(OPENS, pty.name):
        python = [sys.executable, "-c", AS_NOBODY, pty.name]
        child = subprocess.run(python, capture_output=True, text=True, check=True, cwd=ROOT)
    assert child.stdout.split() == ["True"]
