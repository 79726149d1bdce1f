"""`from bilprov import Robot`: what it sends to a served robot, raises, and leaves behind."""

from __future__ import annotations

import inspect
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

import pytest

from bilprov.analyzer.client.driver import NoAnswer, Refused, RobotError
from bilprov.analyzer.client.operations import Ended, Operation
from bilprov.analyzer.client.robot import Robot
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.port import open_port
from bilprov.analyzer.transport.signals import ENDINGS, SUSPENDING, handled
from bilprov.captures.schemas import MS
from bilprov.conformance.dut.simulator import CONFORMING, Fault, Simulator
from bilprov.conformance.mutation.catalogue import find_variant
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.conformance.pytest_plugin.session import Client
from bilprov.spec.emit.python import RESERVED
from bilprov.spec.protocol import Protocol, load
from tests.support import ROOT
from tests.support.grammars import mutated
from tests.support.robots import PATIENCE, served_here, simulate

pytestmark = pytest.mark.waits

STOP, FORWARD = b"\x00", b"\x20"


class Scripted(Simulator):
    """A conforming robot that notes what it hears, and says what the test makes of its answers."""

    def __init__(self, protocol: Protocol, fault: Fault | None = None) -> None:
        super().__init__(protocol, fault)
        self.heard = b""
        self.hearing: Callable[[bytes], object] = lambda data: None
        self.saying: Callable[[bytes], bytes] = lambda data: data

    def receive(self, data: bytes, now: int) -> None:
        self.heard += data
        super().receive(data, now)
        self.hearing(data)

    def advance(self, now: int) -> bytes:
        return self.saying(super().advance(now))


@contextmanager
def driven(
    protocol: Protocol, fault: str = "", **options: Any
) -> Iterator[tuple[Robot, Scripted, str]]:
    """A robot that is served here and opened, with what it really is and its port."""
    device = Scripted(protocol, fault_bank(protocol)[fault] if fault else None)
    with (
        served_here(device) as (port, _),
        Robot(port, grammar=protocol, timeout=options.pop("timeout", None), **options) as robot,
    ):
        device.heard = b""
        yield robot, device, port


# -- instructions ---------------------------------------------------------------------------------


@pytest.mark.parametrize("pty", [False, True])
def test_it_drives_and_is_left_at_rest(pty: bool) -> None:
    with simulate(pty=pty) as served:
        with Robot(served.port) as robot:
            assert served.state()["moving"] is False
            answer = robot.speed(127)
            robot.led(rgb=5)
            robot.rotate_left()
            driving = served.state()
        left = served.state()

    assert (answer.code, answer.name) == (0, "OK")
    assert answer.latency >= 0
    assert (driving["motion"], driving["speed"], driving["led"]) == ("rotate_left", 127, 5)
    assert left["moving"] is False


METHODS = [
    ("stop", (), b"\x00"),
    ("speed", (127,), b"\x11\x7f"),
    ("forward", (), b"\x20"),
    ("backward", (), b"\x30"),
    ("right", (1,), b"\x41\x01"),
    ("left", (255,), b"\x51\xff"),
    ("rotate_right", (), b"\x60"),
    ("rotate_left", (), b"\x70"),
    ("led", (7,), b"\x81\x07"),
]


def test_every_instruction_is_a_method_and_sends_its_one_frame(protocol: Protocol) -> None:
    with driven(protocol) as (robot, device, _):
        for name, values, _ in METHODS:
            getattr(robot, name)(*values)
        sent = device.heard

    assert sent == b"".join(frame for _, _, frame in METHODS)
    assert len(METHODS) == len(protocol.instructions)


def test_opening_sends_stops_alone_which_also_end_a_frame_that_was_begun(
    protocol: Protocol,
) -> None:
    device = Scripted(protocol, replace(CONFORMING, timeout=3600 * 1000 * MS))
    device.receive(b"\x1f\x01", time.monotonic_ns())  # it waits for the rest as long as it takes
    with served_here(device) as (port, _), Robot(port) as robot:
        assert set(device.heard[2:]) == set(STOP)
        robot.speed(5)
        assert device.state.speed == 5


def test_a_robot_that_takes_its_time_is_driven_all_the_same(grammar_text: str) -> None:
    """It takes 60 ms for each instruction, which is longer than the deadline."""
    times = {
        "answer_deadline=100": "answer_deadline=20",
        "truncation_timeout=50": "truncation_timeout=20",
    }
    strict = load(mutated(grammar_text, times))
    slow = find_variant(strict, "R-answer-deadline=one-at-a-time")
    with served_here(Simulator(strict, slow)) as (port, _), Robot(port, grammar=strict) as robot:
        assert robot.speed(5).latency > strict.timing.answer_deadline
        assert robot.led(3).name == "OK"


@pytest.mark.parametrize(
    ("call", "kind", "sentence"),
    [
        (lambda r: r.speed(256), ValueError, "Speed.speed is 256, allowed are 0 to 255"),
        (lambda r: r.speed(-1), ValueError, "Speed.speed is -1, allowed are 0 to 255"),
        (lambda r: r.led(rgb=8), ValueError, "LED.rgb is 8, allowed are 0 to 7"),
        (lambda r: r.led("5"), ValueError, "'5', allowed are whole numbers from 0 to 7"),
        (lambda r: r.led(1.5), ValueError, "1.5, allowed are whole numbers from 0 to 7"),
        (lambda r: r.led(), TypeError, r"led\(rgb: int\).*: missing .*argument: 'rgb'"),
        (lambda r: r.stop(1), TypeError, r"stop\(\).*: too many positional arguments"),
        (lambda r: r.speed(sped=1), TypeError, r"speed\(speed: int\)"),
        (lambda r: r.send("Hoot"), ValueError, "there is no instruction 'Hoot'"),
    ],
)
def test_what_is_wrong_is_said_and_not_sent(
    protocol: Protocol, call: Callable[[Any], object], kind: type[Exception], sentence: str
) -> None:
    with driven(protocol) as (robot, device, _):
        with pytest.raises(kind, match=sentence):
            call(robot)
        sent = device.heard
        robot.stop()

    assert sent == b""


def test_only_reading_sends_nothing_that_changes_a_robot(protocol: Protocol) -> None:
    with driven(protocol, only_reading=True) as (robot, device, _):
        for call in (lambda: robot.speed(5), lambda: robot.send_bytes(b"\x20\x20")):
            with pytest.raises(ValueError, match="only_reading sends what changes nothing"):
                call()
        assert device.heard == b""


def test_the_methods_are_the_instructions_with_their_fields_and_prose(protocol: Protocol) -> None:
    with driven(protocol) as (robot, _, _):
        unknown: Any = robot
        with pytest.raises(AttributeError, match="no instruction 'horn'; there are stop, speed, "):
            unknown.horn(2)
        assert not hasattr(robot, "_horn")
        assert {name for name, _, _ in METHODS} <= set(dir(robot))
        assert list(inspect.signature(robot.led).parameters) == ["rgb"]
        assert robot.led.__name__ == "led"
        assert robot.led.__doc__ == protocol.by_name["LED"].prose


# -- what a robot does wrong ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "code", "answer", "meaning"),
    [
        ("always-1", 1, "BAD_HEADER", "wrong header received"),
        ("unused-code-for-valid", 5, "0x05", "robot-car has no such response"),
    ],
)
def test_a_refusal_carries_its_code_and_the_frame(
    protocol: Protocol, fault: str, code: int, answer: str, meaning: str
) -> None:
    with driven(protocol, fault) as (robot, _, _), pytest.raises(Refused) as raised:
        robot.speed(80)

    error = raised.value
    assert (error.code, error.answer) == (code, answer)
    assert (error.frame, error.instruction) == (b"\x11\x50", "Speed")
    assert str(error) == f"Speed speed=80 (11 50) was answered {answer} ({code}): {meaning}"
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.code, again.frame) == (str(error), code, error.frame)


def test_send_gives_a_refusal_back_instead_of_raising_it(protocol: Protocol) -> None:
    with driven(protocol, "always-1") as (robot, _, _):
        assert robot.send("Speed", speed=80).name == "BAD_HEADER"
        assert robot.send_bytes(b"\x93\x00\x00\x00")[0].code == 1


def test_no_answer_in_time_is_told_and_a_late_one_answers_no_other_instruction(
    protocol: Protocol,
) -> None:
    late: list[bytes] = []

    def hold(data: bytes) -> bytes:
        late.extend([data] * bool(data))
        return b""

    def say_all(data: bytes) -> bytes:
        owed = b"\1" * len(late) if data else b""  # which is another answer than is due
        late.clear()
        return owed + data

    with driven(protocol, timeout=1000) as (robot, device, _):
        robot.speed(80)
        device.saying = hold
        with pytest.raises(
            NoAnswer, match=r"^Forward \(20\): 1 answer is due in 1000 ms, but "
        ) as e:
            robot.forward()
        assert (device.state.moving, e.value.frame, late) == (True, FORWARD, [b"\0"])
        device.heard = b""
        device.saying = say_all
        assert robot.led(3).name == "OK"

    homed = protocol.longest_frame * STOP
    assert device.heard == homed + b"\x81\x03" + homed


def test_an_answer_too_many_is_an_error(protocol: Protocol) -> None:
    def told() -> None:
        robot.forward()
        robot.wait(100)

    with driven(protocol, "double-answer") as (robot, _, _), pytest.raises(RobotError) as raised:
        told()

    assert type(raised.value) is RobotError
    assert "OK" in str(raised.value)


def test_what_a_robot_says_unasked_is_an_error_and_it_is_homed_before_the_next(
    protocol: Protocol,
) -> None:
    with driven(protocol, "late-second-answer") as (robot, device, _):
        robot.send_bytes(b"\x90")
        with pytest.raises(RobotError, match=r"^\w+ came without an instruction$"):
            robot.wait(500)
        assert robot.led(3).name == "OK"
        assert device.heard == b"\x90" + protocol.longest_frame * STOP + b"\x81\x03"


def test_a_robot_that_never_answers_is_not_opened_and_its_port_is_free_again(
    grammar_text: str,
) -> None:
    soon = load(grammar_text.replace("answer_longest=1000", "answer_longest=100"))
    with simulate("--fault", "dead", pty=True) as served:
        with pytest.raises(NoAnswer) as raised:
            Robot(served.port, grammar=soon)
        open_port(served.port).close()  # a path is locked while it is open

    assert str(raised.value).startswith(f"nobody answers at {served.port}; is the robot on")


@pytest.mark.parametrize("pty", [False, True])
def test_a_line_that_is_lost_is_a_link_error_and_a_note_tells_it_was_not_stopped(
    pty: bool,
) -> None:
    def unplugged() -> None:
        with Robot(served.port) as robot:
            robot.forward()
            served.process.kill()
            served.process.wait(PATIENCE)
            robot.stop()

    with simulate(pty=pty) as served, pytest.raises(LinkError) as raised:
        unplugged()

    (note,) = raised.value.__notes__
    assert note.startswith(f"the robot was not brought to a stop at the end: {served.port} ")


def test_a_line_that_is_lost_unnoticed_is_told_on_leaving() -> None:
    with simulate() as served:
        robot = Robot(served.port).__enter__()
        served.process.kill()
        served.process.wait(PATIENCE)
        with pytest.raises(LinkError):
            robot.__exit__(None, None, None)


def test_a_robot_that_fell_silent_is_told_on_leaving(protocol: Protocol) -> None:
    with pytest.raises(NoAnswer, match="nobody answers at"), driven(protocol) as (_, device, _):
        device.saying = lambda data: b""


def test_a_port_that_cannot_be_opened_and_wrong_settings_are_one_sentence() -> None:
    with pytest.raises(LinkError, match="there is no /dev/no-such-port"):
        Robot("/dev/no-such-port")
    with pytest.raises(ValueError, match="baud is 0"):
        Robot("/dev/no-such-port", baud=0)
    for timeout in (0, -1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="allowed are milliseconds above 0"):
            Robot("/dev/no-such-port", timeout=timeout)


class GoneLink:
    """A link whose port has gone."""

    def do(self, ask: Operation) -> int:
        raise Ended("the port disappeared", error=True, line_works=False)


def test_the_fixtures_robot_tells_of_a_lost_line_in_the_links_own_words(
    protocol: Protocol,
) -> None:
    with pytest.raises(RobotError, match=r"^the port disappeared$"):
        Client(protocol, GoneLink(), sees=False).home()


# -- leaving --------------------------------------------------------------------------------------


class Own(Exception):
    """Somebody's own error."""


@pytest.mark.parametrize("error", [Own, KeyboardInterrupt, SystemExit, GeneratorExit])
def test_every_way_out_homes(protocol: Protocol, error: type[BaseException]) -> None:
    moving: list[bool] = []

    def left() -> None:
        with Robot(port) as robot:
            robot.speed(80)
            robot.forward()
            moving.append(device.state.moving)
            raise error

    device = Scripted(protocol)
    with served_here(device) as (port, _):
        with pytest.raises(error) as raised:
            left()
        moving.append(device.state.moving)

    assert moving == [True, False]
    assert not hasattr(raised.value, "__notes__")


def test_closing_homes_too_and_then_nothing_is_sent_any_more(protocol: Protocol) -> None:
    with driven(protocol) as (robot, device, port):
        robot.speed(80)
        robot.forward()
        robot.close()
        robot.close()
        assert not device.state.moving
        with pytest.raises(LinkError, match=f"{port} is closed"):
            robot.forward()


DRIVING = """\
import sys, time
from bilprov import Robot

with Robot(sys.argv[1]) as robot:
    robot.speed(100)
    robot.forward()
    print("driving", flush=True)
    time.sleep(60)
"""

ENDED = {number: 128 + number for number in ENDINGS} | {signal.SIGINT: -signal.SIGINT}


@contextmanager
def driving(
    protocol: Protocol, text: str
) -> Iterator[tuple[Scripted, subprocess.Popen[bytes], str]]:
    """A robot, a program that drives it, once it has said so, and the port between them."""
    device = Scripted(protocol)
    with (
        served_here(device) as (port, _),
        subprocess.Popen(
            [sys.executable, "-c", text, port],
            bufsize=0,
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            process_group=0,  # in the group of tests run in the background nothing is suspended
        ) as process,
    ):
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == b"driving\n"
            yield device, process, port
        finally:
            process.kill()


@pytest.mark.sample(2)
@pytest.mark.parametrize("number", ENDED)
def test_a_program_that_is_ended_homes_first_and_a_second_signal_waits(
    protocol: Protocol, number: int
) -> None:
    alive: list[bool] = []

    def ended_again(data: bytes) -> None:
        if device.heard.count(FORWARD) and data[-1:] == STOP and not alive:
            process.send_signal(number)
            try:
                process.wait(0.5)  # it has one second for the first answer to its stops
                alive.append(False)
            except subprocess.TimeoutExpired:
                alive.append(True)

    with driving(protocol, DRIVING) as (device, process, _):
        device.hearing = ended_again
        assert device.state.moving
        process.send_signal(number)
        process.wait(PATIENCE)

    assert not device.state.moving
    assert alive == [True]
    assert process.returncode == ENDED[number]


THREADED = """\
import sys, threading, time
from bilprov import Robot

def drive():
    with Robot(sys.argv[1]) as robot:
        robot.speed(100)
        robot.forward()
        print("driving", flush=True)
        while True:
            robot.wait(20)
            robot.forward()

thread = threading.Thread(target=drive)
thread.start()
while thread.is_alive():
    time.sleep(1)
"""


@pytest.mark.sample(2)
@pytest.mark.parametrize("number", ENDED)
def test_a_robot_in_another_thread_is_stopped_before_a_signal_ends_the_program(
    protocol: Protocol, number: int
) -> None:
    with driving(protocol, THREADED) as (device, process, _):
        assert device.state.moving
        process.send_signal(number)
        process.wait(PATIENCE)

    assert not device.state.moving
    assert process.returncode == -number


SHARED = """\
import os, sys, threading, time
from bilprov import Robot, RobotError

robot = Robot(sys.argv[1])
robot.speed(100)

def drive():
    try:
        while True:
            robot.forward()
    except RobotError as error:
        os.write(2, f"RobotError: {error}\\n".encode())  # at once: three tracebacks would mix

for _ in range(3):
    threading.Thread(target=drive).start()
print("driving", flush=True)
time.sleep(60)
"""


def interrupted(process: subprocess.Popen[bytes]) -> bytes:
    """What a program writes to standard error before Ctrl-C has ended it.

    Python handles a signal only after a sleep that its main thread was just about to begin: what
    nobody notices at a keyboard happens on a busy machine, so the key is pressed again.
    """
    for _ in range(4):
        process.send_signal(signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):
            return process.communicate(timeout=PATIENCE / 4)[1]
    raise AssertionError("Ctrl-C does not end the program")


@pytest.mark.parametrize(("text", "threads"), [(THREADED, 1), (SHARED, 3)])
def test_ctrl_c_ends_each_thread_that_drives_too(
    protocol: Protocol, text: str, threads: int
) -> None:
    with driving(protocol, text) as (device, process, _):
        told = interrupted(process)

    assert not device.state.moving
    assert told.count(b"RobotError: SIGINT came, and the robot was stopped before that") == threads


@pytest.mark.parametrize("number", SUSPENDING)
def test_a_robot_in_another_thread_is_stopped_before_the_program_is_suspended(
    protocol: Protocol, number: int
) -> None:
    with driving(protocol, THREADED) as (device, process, _):
        process.send_signal(number)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED)
        moving = device.state.moving
        process.send_signal(signal.SIGCONT)
        _, told = process.communicate(timeout=PATIENCE)

    assert not moving
    assert not device.state.moving
    assert b"RobotError: the program was suspended, and the robot was stopped" in told


LATE_IMPORT = """\
import sys, threading

def drive():
    from bilprov import Robot
    try:
        Robot(sys.argv[1])
    except RuntimeError as error:
        print("driving")
        print(error, flush=True)

thread = threading.Thread(target=drive)
thread.start()
thread.join()
"""


def test_a_robot_that_no_signal_could_stop_is_refused(protocol: Protocol) -> None:
    with driving(protocol, LATE_IMPORT) as (device, process, _):
        told, errors = process.communicate(timeout=PATIENCE)

    assert told == (
        b"a robot in this thread could not be stopped by a signal: import Robot in the main thread "
        b"before this one starts\n"
    )
    assert errors == b""
    assert device.heard == b""


DROPPED = """\
import sys
from bilprov import Robot

robot = Robot(sys.argv[1])
robot.speed(100)
robot.forward()
print("driving", flush=True)
sys.stdin.readline()
"""


@pytest.mark.parametrize("how", ["", "del robot\nimport time\ntime.sleep(60)\n", "1 / 0\n"])
def test_a_robot_that_nobody_closes_is_homed_with_a_warning(protocol: Protocol, how: str) -> None:
    text = "import warnings\nwarnings.simplefilter('always')\n" + DROPPED + how
    with driving(protocol, text) as (device, process, port):
        assert device.state.moving
        assert process.stdin is not None
        assert process.stderr is not None
        process.stdin.write(b"\n")
        process.stdin.flush()
        told = b""
        while b"ResourceWarning" not in told:
            line = process.stderr.readline()
            assert line, told
            told += line
        moving = device.state.moving

    assert not moving
    assert f"the robot at {port} was never closed, and was stopped only now".encode() in told


CHILD = """\
import multiprocessing, sys
from bilprov import Robot

def drive():
    global robot
    robot = Robot(sys.argv[1])
    robot.speed(100)
    robot.forward()

child = multiprocessing.get_context("fork").Process(target=drive)
child.start()
child.join()
print("driving", flush=True)
"""


USED_AT_EXIT = "import atexit\natexit.register(lambda: robot.forward())\n" + DROPPED
FORKED = DROPPED.replace("sys.stdin.readline()", "import os\nif os.fork(): os.wait(); os._exit(0)")


@pytest.mark.parametrize(
    ("text", "told", "moving"),
    [
        (CHILD, b"", False),
        (USED_AT_EXIT, b"RobotError: the program ended, and the robot was stopped before", False),
        (FORKED, b"", True),  # a child leaves its parent's robot alone
    ],
)
def test_at_the_end_of_a_process_its_own_robot_is_homed(
    protocol: Protocol, text: str, told: bytes, moving: bool
) -> None:
    with driving(protocol, text) as (device, process, _):
        _, errors = process.communicate(timeout=PATIENCE)

    assert told in errors
    assert device.heard
    assert device.state.moving is moving


@pytest.mark.parametrize("threads", [2, 8])
def test_threads_take_turns_with_one_robot(protocol: Protocol, threads: int) -> None:
    """Each gets the answers to its own instructions, and a wait keeps nobody out."""

    def drive(number: int) -> int:
        named = [robot.send_bytes(b"\x90") for _ in range(10)]
        lit = [robot.led(number % 8) for _ in range(10)]
        robot.wait(5)
        return len({answer.name for (answer,) in named} | {answer.name for answer in lit})

    with driven(protocol) as (robot, device, _), ThreadPoolExecutor(threads) as pool:
        kinds = list(pool.map(drive, range(threads)))
        heard = device.heard

    assert kinds == [2] * threads
    assert len(heard) == threads * 30


def test_a_long_wait_in_one_thread_leaves_the_robot_to_the_others(protocol: Protocol) -> None:
    with driven(protocol) as (robot, device, _), ThreadPoolExecutor(1) as pool:
        robot.forward()
        waiting = pool.submit(robot.wait, PATIENCE * 1000)
        robot.stop()
        assert not device.state.moving
        assert not waiting.done()
        robot.close()
        with pytest.raises(LinkError, match="is closed"):
            waiting.result(PATIENCE)


def test_the_programs_own_handlers_stay_and_ctrl_c_is_given_back() -> None:
    heard: list[int] = []
    with (
        simulate() as served,
        handled([signal.SIGINT], signal.default_int_handler),
        handled([signal.SIGTERM], lambda number, frame: heard.append(number)),
    ):
        with Robot(served.port):
            assert signal.getsignal(signal.SIGINT) is not signal.default_int_handler
            signal.raise_signal(signal.SIGTERM)
            assert heard == [signal.SIGTERM]
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


# -- other grammars -------------------------------------------------------------------------------


def test_an_instruction_whose_name_a_robot_needs_itself_gets_an_underscore(
    horn_text: str,
) -> None:
    protocol = load(horn_text.replace('9: "Horn"', '9: "Close"').replace('"sound"', '"from"'))
    with driven(protocol) as (robot, device, _):
        other: Any = robot
        other.close_(from_=2)
        with pytest.raises(ValueError, match=r"Close\.from is 4, allowed are 0 to 3"):
            other.close_(4)
        assert device.heard == b"\x91\x02"
        robot.stop()


def test_what_a_robot_has_besides_is_reserved(protocol: Protocol) -> None:
    own = {name for kind in (Robot, Client) for name in dir(kind) if not name.startswith("_")}
    with driven(protocol) as (robot, _, _):
        own |= {name for name in vars(robot) if not name.startswith("_")}

    assert own | {"sees"} == RESERVED
