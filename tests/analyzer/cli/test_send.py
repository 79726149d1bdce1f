"""`bilprov send`: what it sends and shows, and that it leaves the device at rest."""

from __future__ import annotations

import json
import signal
from contextlib import ExitStack
from pathlib import Path

import pytest

from benchmarks.adapter import Adapter
from bilprov.analyzer.client.rest import stops
from bilprov.analyzer.replay.comparison import UNANSWERED_STOPS
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.replug import Place
from bilprov.analyzer.transport.signals import Stopper
from bilprov.conformance.cli.shell.items import _resumed
from bilprov.conformance.dut.simulator import Event, Fault, Reaction, Simulator
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.spec.protocol import Protocol
from tests.support.commands import command, running
from tests.support.robots import PATIENCE, ProbeServer, plugged, served_here, simulate, until
from tests.support.wires import json_lines

pytestmark = pytest.mark.waits

BACK = "was lost and is there again, and the robot was stopped there first"


@pytest.mark.parametrize(
    ("more", "number", "status", "told"),
    [
        (["Stop"], signal.SIGINT, 1, "2 of 3 instructions were sent"),
        ([], signal.SIGINT, 1, "stopped before the end"),
        ([], signal.SIGQUIT, 131, "stopped before the end"),
    ],
)
def test_a_signal_ends_a_pause_and_what_was_not_done_is_told(
    protocol: Protocol, more: list[str], number: signal.Signals, status: int, told: str
) -> None:
    device = Simulator(protocol)
    with (
        served_here(device) as (port, _),
        running("send", port, "Speed 9", "Forward", "pause=60000", *more, "--yes") as command,
    ):
        for _ in range(4):
            command.stdout.readline()
        code, _, err = command.end(number)

    assert (code, err.decode()) == (status, f"{told}\n")
    assert (device.state.moving, device.state.speed) == (False, 9)


# -- what the answers are worth -------------------------------------------------------------------


class Flood(Simulator):
    """A robot that, once it has heard LED 7, sends bytes without end."""

    flooding = False

    def receive(self, data: bytes, now: int) -> None:
        self.flooding |= b"\x81\x07" in data
        super().receive(data, now)

    def advance(self, now: int) -> bytes:
        return super().advance(now) + b"\x00" * 1000 * self.flooding

    def deadline(self) -> int | None:
        return 0 if self.flooding else super().deadline()


@pytest.mark.parametrize("more", [[], ["--together"], ["--expect", "OK,OK,OK"]])
def test_a_device_that_floods_the_line_ends_it_at_once(protocol: Protocol, more: list[str]) -> None:
    device = Flood(protocol)
    with served_here(device) as (port, _):
        items = ("Forward", "LED 7", "pause=60000", "Speed 1")
        result = command("send", port, *items, "--yes", *more)

    assert result.returncode == 1
    told = result.stderr.decode().splitlines()
    assert told[0] == "the device floods the line: 64 bytes came that answer no instruction"
    assert "2 of 3 instructions were sent" in told
    assert len(result.stdout.splitlines()) < 80
    assert (device.state.moving, device.state.speed) == (False, 0)


# -- what a probe sees ----------------------------------------------------------------------------


@pytest.mark.parametrize(("more", "seen"), [((), [False, True, True]), (("--together",), [True])])
def test_json_lines_hold_what_the_probe_sees_after_each_item(
    protocol: Protocol, more: tuple[str, ...], seen: list[bool]
) -> None:
    """Of a robot that answers bad data as it should, and drives on."""
    device = Simulator(protocol, fault_bank(protocol)["no-stop-on-bad-data"])
    words = ("Speed 9", "Forward", "81 09", "--yes", "--format", "jsonl", *more)
    with served_here(device) as (port, probe):
        result = command("send", port, "--probe", probe, *words)

    lines = json_lines(result.stdout)
    looks = [line for line in lines if line["kind"] == "look"]
    assert result.returncode == 0
    assert [look["moving"] for look in looks] == seen
    assert (looks[-1]["motion"], looks[-1]["speed"]) == ("forward", 9)
    assert lines[-1] == looks[-1]
    assert [line["t"] for line in lines] == sorted(line["t"] for line in lines)
    assert not device.state.moving


def test_a_probe_that_hangs_up_ends_it_with_the_robot_at_rest(protocol: Protocol) -> None:
    device = Simulator(protocol)
    with ProbeServer(b'{"moving": true}\n', b"") as probe, served_here(device) as (port, _):
        words = ("Speed 80", "Forward", "LED 5", "--yes", "--probe", probe.name)
        result = command("send", port, *words)

    assert result.returncode == 2
    assert f"bilprov: the probe at {probe.name} hung up" in result.stderr.decode()
    assert (device.state.moving, device.state.led) == (False, 0)


def test_ctrl_c_does_not_wait_for_a_command_that_looks(protocol: Protocol) -> None:
    device = Simulator(protocol)
    with (
        served_here(device) as (port, _),
        running(
            *("send", port, "Speed 9", "Forward", "--yes"),
            *("--probe", "exec:echo looking >&2; sleep 600; true"),
        ) as sending,
    ):
        assert sending.stderr.readline() == b"looking\n"
        code, _, err = sending.end()  # waits for all that have its output, also for the command

    assert (code, err) == (1, b"1 of 2 instructions were sent\n")
    assert not device.state.moving


# -- what is said, and how long it drives ---------------------------------------------------------


def test_a_robot_that_drives_too_long_without_an_instruction_is_stopped() -> None:
    with simulate() as served:
        moves = ("Speed 80", "Forward", "pause=60000", "Speed 9")
        result = command("send", served.port, *moves, "--yes", "--max-drive", "0.2")
        state = served.state()
        rested = command("send", served.port, "Stop", "pause=400", "--yes", "--max-drive", "0.1")

    assert (result.returncode, rested.returncode) == (1, 0)
    told = result.stderr.decode()
    assert "stopped: it has driven for 0.2 s without a new instruction" in told
    assert "2 of 3 instructions were sent" in told
    assert (state["moving"], state["speed"]) == (False, 80)


# -- a port that comes late, or again -------------------------------------------------------------


def test_a_port_that_is_not_there_yet_is_waited_for(tmp_path: Path, protocol: Protocol) -> None:
    link = tmp_path / "robot"
    with running("send", str(link), "LED rgb=5", "--yes", "--wait") as sending:
        assert b"; waiting" in sending.stderr.readline()
        with plugged(link, device := Simulator(protocol)):
            sending.process.wait(PATIENCE)

    assert sending.process.returncode == 0
    assert device.state.led == 5


def test_a_port_that_comes_back_is_homed_and_the_rest_follows(
    tmp_path: Path, protocol: Protocol
) -> None:
    link, items = tmp_path / "robot", ("Speed 80", "Forward", "pause=60000", "LED rgb=5")
    first = Simulator(protocol)
    with ExitStack() as stack:
        unplugged = stack.enter_context(ExitStack())
        unplugged.enter_context(plugged(link, first))
        words = ("send", str(link), *items, "--yes", "--wait", "--format", "jsonl")
        sending = stack.enter_context(running(*words))
        # The answer to Forward is the last line: from then on the pause is under way.
        lines = [sending.stdout.readline()]
        while (line := json.loads(lines[-1]))["kind"] != "response" or not line["state"]["moving"]:
            lines.append(sending.stdout.readline())
        unplugged.close()
        assert b"; waiting" in sending.stderr.readline()
        # As after a short break of the cable: it drives on.
        moving: list[bool] = []

        def note(device: object, event: Event, reaction: Reaction) -> Reaction:
            instruction = event.judgement.instruction
            if instruction and instruction.effect.sets("led"):
                moving.append(event.before.moving)
            return reaction

        second = Simulator(protocol, Fault("driving", "test", "", power_on=first.state, react=note))
        with plugged(link, second):
            code, out, err = sending.result()
            shown, told = json_lines(b"".join(lines) + out), err.decode()

    assert code == 1
    assert BACK in told
    assert "stopped" in {line["state"]["motion"] for line in shown}
    assert [line["hex"] for line in shown if line["direction"] == "host"][-1] == "81 05"
    assert "gap" in {line["kind"] for line in shown}
    assert moving == [False]
    assert (second.state.moving, second.state.led) == (False, 5)


@pytest.mark.parametrize("wait", [False, True])
def test_a_port_that_is_lost_in_the_last_homing_is_no_success(
    tmp_path: Path, protocol: Protocol, wait: bool
) -> None:
    """It is unplugged at the first of the stops at the end; with --wait it is homed once more."""
    device, port = Simulator(protocol), tmp_path / "robot"
    begin = len(stops(protocol))
    words = ("send", str(port), "Forward", "--yes", *(["--wait"] * wait))
    with (
        served_here(device, pty=True) as (line, _),
        Adapter(port, line, [begin + 2], 0.3),
    ):
        result = command(*words)

    assert result.returncode == 1, result.stderr
    told = BACK if wait else UNANSWERED_STOPS
    assert told in result.stderr.decode()


def test_nobody_is_told_to_wait_for_what_cannot_come_back(
    capsys: pytest.CaptureFixture[str], protocol: Protocol
) -> None:
    place, lost = Place("socket://127.0.0.1:1"), LinkError("it is gone")
    settings = line_settings(protocol, None, None, None)

    with Stopper() as stopper, pytest.raises(LinkError, match="it is gone"):
        _resumed(None, place, settings, stopper, lost)  # type: ignore[arg-type]

    assert "waiting" not in capsys.readouterr().err


def test_without_wait_a_port_that_is_lost_ends_it(tmp_path: Path, protocol: Protocol) -> None:
    link, device = tmp_path / "robot", Simulator(protocol)
    with ExitStack() as stack:
        unplugged = stack.enter_context(ExitStack())
        unplugged.enter_context(plugged(link, device))
        sending = stack.enter_context(running("send", str(link), "LED 5", "pause=60000", "--yes"))
        until(lambda: device.state.led == 5)
        unplugged.close()
        code, _, _ = sending.result()

    assert code == 2
