"""A port that was unplugged is found again where it is the same one, and nowhere else."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from bilprov.analyzer.transport.port import open_pty
from bilprov.analyzer.transport.replug import Place
from tests.support.machines import FakeMachine

BY_ID = "/dev/serial/by-id/usb-FTDI_A10K3XYZ-if00-port0"
SERIAL = "/sys/devices/usb1/1-1/serial"


@pytest.fixture
def machine(tmp_path: Path) -> FakeMachine:
    return FakeMachine(tmp_path / "root")


def unplug(machine: FakeMachine, tty: str = "ttyUSB0") -> None:
    machine.file(f"/dev/{tty}").unlink()
    machine.file(BY_ID).unlink()
    for folder in ("/sys/devices", "/sys/bus", "/sys/class/tty"):
        shutil.rmtree(machine.file(folder))
    machine.file("/sys/class/tty").mkdir()


@pytest.mark.parametrize("name", ["/dev/ttyUSB0", BY_ID])
def test_an_adapter_is_found_under_the_path_that_it_gets(machine: FakeMachine, name: str) -> None:
    machine.adapter()
    place = Place(name, machine)
    assert place.lasts
    unplug(machine)
    assert place.found() == ""
    machine.adapter("ttyUSB3")
    assert place.found() == BY_ID


@pytest.mark.parametrize("other", ["serial", "product"])
def test_another_adapter_under_the_same_path_is_not_the_port(
    machine: FakeMachine, other: str
) -> None:
    machine.adapter()
    place = Place("/dev/ttyUSB0", machine)
    unplug(machine)
    machine.adapter(identity="0403:6001" if other == "serial" else "0403:6010")
    if other == "serial":
        machine.write(SERIAL, "B20\n")
    assert place.found() == ""


def test_a_pty_is_found_behind_a_new_link_alone(tmp_path: Path) -> None:
    link = tmp_path / "port"
    with open_pty() as pair, open_pty() as other:
        link.symlink_to(pair.name)
        place = Place(str(link))
        assert place.lasts
        assert place.found() == ""  # the number of a pty is anybody's, so an old link says nothing
        link.unlink()
        assert place.found() == ""
        link.symlink_to(other.name)
        assert place.found() == str(link)
        assert not Place(pair.name).lasts
    assert not Place("socket://127.0.0.1:1").lasts
