"""`from bilprov import Device`: what it sends, returns and raises; it agrees with the decoder."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from random import Random
from typing import Any

import pytest

from bilprov import Device, LinkError
from bilprov.analyzer.client.driver import DeviceDriver, NoAnswer, Refused, RobotError
from bilprov.analyzer.client.operations import LinkListener
from bilprov.analyzer.decode.records import DeviceRecord, HostRecord, Record
from bilprov.analyzer.decode.session import Session
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.simulated.device import SimulatedDevice, drawn_request
from bilprov.captures.schemas import Chunk
from bilprov.conformance.dut.target import VirtualLink
from bilprov.spec.codec import Judgement, build, free_parts, judge
from bilprov.spec.protocol import Protocol, load
from tests.support import ROOT
from tests.support.drawn_layouts import drawn_layout, drawn_values
from tests.support.robots import served_here

BYTE_TIME = 572_917  # ns at 19,200 8E1
NAMES = ["modbus-rtu", "stk500v1", "dynamixel1"]


class Scripted(SimulatedDevice):
    """A simulated device whose answers a test changes."""

    def __init__(self, protocol: Protocol) -> None:
        super().__init__(protocol)
        self.heard = b""
        self.saying: list[bytes] = []  # what is sent instead of the next answers
        self.absent: set[int | None] = set()  # addresses at which nobody is

    def receive(self, data: bytes, now: int) -> None:
        self.heard += data
        super().receive(data, now)

    def _answer(self, judgement: Judgement, values: dict[str, Any], known: int) -> None:
        if judgement.address not in self.absent:
            super()._answer(judgement, values, known)

    def advance(self, now: int) -> bytes:
        answer = super().advance(now)
        return self.saying.pop(0) if answer and self.saying else answer


class Tap(LinkListener):
    """Decodes what passes over a link."""

    def __init__(self, protocol: Protocol) -> None:
        self._session = Session(protocol, timeout=10**12, skew=0)
        self.records: list[Record] = []

    def sent(self, data: bytes, t: int) -> None:
        self.records += self._session.feed(Chunk(t, "host", data))

    def received(self, data: bytes, t: int) -> None:
        self.records += self._session.feed(Chunk(t, "device", data))


def client_of(protocol: Protocol) -> tuple[DeviceDriver, Scripted, Tap]:
    """A client of a simulated device in virtual time, and what the decoder makes of it."""
    device, tap = Scripted(protocol), Tap(protocol)
    return DeviceDriver(protocol, VirtualLink(device, BYTE_TIME, tap)), device, tap


def driver(name: str, address: int | None = None) -> tuple[DeviceDriver, Scripted, Tap]:
    """The same for a shipped grammar, and for a device at this address."""
    client, device, tap = client_of(load_protocol(name))
    client._address = address
    return client, device, tap


# -- on a port ------------------------------------------------------------------------------------


@contextmanager
def opened(name: str, **options: Any) -> Iterator[tuple[Device, Scripted]]:
    device = Scripted(load_protocol(name))
    with (
        served_here(device) as (port, _),
        Device(port, grammar=name, **options) as client,
    ):
        yield client, device


@pytest.mark.waits
def test_registers_are_written_and_read_on_a_port() -> None:
    with opened("modbus-rtu", address=17) as (meter, device):
        assert device.heard == b""
        assert meter.write_multiple_registers(0, 2, [4, 5]) == (0, 2)
        assert meter.read_holding_registers(start=0, quantity=3) == (4, 5, 0)
        assert meter.read_holding_registers(start=0, quantity=1, address=18) == (0,)
        assert repr(meter).endswith(" modbus-rtu>")


@pytest.mark.waits
def test_a_device_that_the_grammar_brings_to_rest_is_left_at_rest() -> None:
    protocol = load(MOTORS, "motors.py")
    device = Scripted(protocol)
    with served_here(device) as (port, _), Device(port, grammar=protocol, address=0x80) as motors:
        begun = len(device.heard)
        motors.forward_m1(50)
        motors.forward_m2(60, address=0x81)
        assert device.state(0x81).moving
    assert begun == 2 * 5
    assert not device.state(0x80).moving
    assert not device.state(0x81).moving


MOTORS = (ROOT / "examples" / "roboclaw.py").read_text(encoding="utf-8")


def test_of_a_device_without_a_rest_nothing_is_told_when_its_line_is_lost() -> None:
    device = Scripted(load_protocol("modbus-rtu"))

    def lost() -> None:
        with ExitStack() as served:
            port, _ = served.enter_context(served_here(device, pty=True))
            with Device(Path(port), grammar="modbus-rtu", address=1) as meter:
                assert meter.read_coils(0, 1) == b"\x00"
                served.close()
                meter.read_coils(0, 1)

    with pytest.raises(LinkError, match="disappeared while it was in use") as raised:
        lost()
    assert not hasattr(raised.value, "__notes__")


def test_what_brings_a_device_to_rest_is_found_in_the_effects() -> None:
    stop_both = (("ForwardM1", {"speed": 0}), ("ForwardM2", {"speed": 0}))
    assert load(MOTORS, "motors.py").rest_requests == stop_both
    assert load_protocol("modbus-rtu").rest_requests == ()
    assert load_protocol().rest_requests == (("Stop", {}),)


CAMERA = """
from construct import Byte, Checksum, Const, Int8sb, RawCopy, Struct, Switch, this
from bilprov.spec.fields import *
NAME, VERSION, DOCUMENT = "camera", "1", "a camera that pans and tilts"
STOP = {0: "Stop" / Instruction(
    "rest" / Const(bytes(2)), document="a", effect=Sets(pan=0, tilt=0))}
PAN = {1: "Pan" / Instruction(
    "by" / Int8sb, "tilt" / Const(bytes(1)), document="a", effect=Sets(pan=From("by"), tilt=0))}
BOTH = {2: "Both" / Instruction(
    "x" / Int8sb, "y" / Int8sb, document="a", effect=Sets(pan=From("x"), tilt=From("y")))}
INSTRUCTIONS = {**STOP, **PAN, **BOTH}
FRAME = Struct(
    "covered" / RawCopy(Struct("id" / Byte, "data" / Switch(this.id, INSTRUCTIONS))),
    "sum" / Checksum(Byte, Sum(8), this.covered.data),
)
REPLY = Struct("sync" / Const(bytes(1)))
SILENT = (Outcome.UNKNOWN_ID, Outcome.BAD_CHECKSUM, Outcome.BAD_DATA)
STATE = Variables(pan=Whole(-128, 127), tilt=Whole(-128, 127))
AT_REST = AllOf(pan=0, tilt=0)
POWER_ON = Sets(pan=0, tilt=0)
TIMING = Timing(50, 5, 1000, 100, 1000, 100)
LINE = LineDefaults(baud=2400, parity="N", stopbits=1)
CLAUSES = Clauses(header="a", instructions="a", responses="a", safety="a")
"""


@pytest.mark.parametrize(
    ("without", "request_"),
    [
        ("nothing", ("Stop", {})),
        ("**STOP, ", ("Pan", {"by": 0})),
        ("**STOP, **PAN, ", ("Both", {"x": 0, "y": 0})),
    ],
)
def test_fixed_data_and_several_fields_bring_a_device_to_rest(
    without: str, request_: tuple[str, dict[str, int]]
) -> None:
    assert load(CAMERA.replace(without, ""), "camera.py").rest_requests == (request_,)


@pytest.mark.waits
def test_a_silent_address_does_not_keep_the_others_from_being_driven() -> None:
    motors, device, _ = client_of(load(MOTORS, "motors.py"))
    device.absent = {0x82}
    motors.forward_m1(50, address=0x80)
    with pytest.raises(NoAnswer, match="was not answered"):
        motors.forward_m1(50, address=0x82)
    motors.forward_m1(60, address=0x80)
    assert device.state(0x80).m1 == 60
    device.absent = {0x80, 0x82}
    with pytest.raises(NoAnswer, match="was not answered"):
        motors.forward_m1(70, address=0x80)
    with pytest.raises(NoAnswer, match="nobody answers"):
        motors.forward_m1(70, address=0x80)


# -- what a method returns ------------------------------------------------------------------------


def test_a_method_returns_one_value_a_named_tuple_or_nothing() -> None:
    bootloader, _, _ = driver("stk500v1")
    assert bootloader.get_sync() is None
    assert bootloader.read_sign() == b"\x1e\x95\x0f"
    fuses = bootloader.read_fuse_ext()
    assert (fuses.low, fuses.high, fuses.extended) == (0, 0, 0)
    bootloader.load_address(16)
    bootloader.prog_page(4, "flash", "01 02 03 04")
    bootloader.load_address(16)
    assert bootloader.read_page(size=4, memory="flash") == bytes([1, 2, 3, 4])


def test_what_is_sent_to_all_returns_nothing_at_once() -> None:
    servos, device, _ = driver("dynamixel1", 254)
    assert servos.write(30, b"\x05") is None
    assert servos.sync_write(30, 1, "0105") is None
    assert servos.read(30, 1, address=7) == b"\x05"
    assert device.heard.startswith(bytes.fromhex("ff ff fe 04 03 1e 05"))


def test_the_signature_names_the_fields_and_the_address() -> None:
    meter, _, _ = driver("modbus-rtu")
    wanted = "(coil: int, value: 'int | str', *, address: 'int | None' = None)"
    assert str(inspect.signature(meter.write_single_coil)) == wanted
    assert meter.write_single_coil.__doc__ == "WriteSingleCoil (6.5)."
    bootloader, _, _ = driver("stk500v1")
    assert "address" not in inspect.signature(bootloader.get_sync).parameters
    servos, _, _ = driver("dynamixel1")
    assert servos.ping.__doc__ == "Asks whether the servo is there."


def test_values_with_names_are_returned_by_their_names() -> None:
    meter, device, _ = driver("modbus-rtu", 1)
    assert meter.write_single_coil(3, "on") == (3, "on")
    device.saying = [bytes.fromhex("01 05 00 03 12 34 30 bd")]  # a value without a name
    assert meter.write_single_coil(3, "on").value == 0x1234


def test_a_register_that_is_read_by_its_name_is_its_value() -> None:
    protocol = load_protocol(str(ROOT / "examples" / "feetech.py"))
    servo, _, _ = client_of(protocol)
    servo._address = 1
    servo.write(42, b"\x05\x02\x01\x00\x02\x00")
    assert servo.read("goal_position") == servo.read("goal_position", 2) == 0x205
    assert servo.read("goal_position", 6) == 0x205
    assert servo.read("goal_position", 1) == b"\x05"  # not all of it
    assert servo.read(42, 2) == b"\x05\x02"
    wanted = "(register: 'int | str', size: 'int | None' = None, *, address: 'int | None' = None)"
    assert str(inspect.signature(servo.read)) == wanted


def test_the_answer_of_send_has_its_values_in_words() -> None:
    meter, _, _ = driver("modbus-rtu", 1)
    answer = meter.send("WriteSingleCoil", coil=3, value="on")
    assert answer is not None
    assert answer.told == (("coil", 3), ("value", "on"))
    assert repr(answer) == "<Reply 01 05 00 03 ff 00 7c 3a: @1 answer coil=3 value=65280 (on)>"
    text = (ROOT / "examples" / "feetech.py").read_text(encoding="utf-8")
    for old, new in (
        ("import Byte, Enum,", "import Byte, FlagsEnum,"),
        ("Enum(Byte, off=0, on=1)", "FlagsEnum(Byte, hot=1, odd=2, slow=4)"),
    ):
        assert old in text
        text = text.replace(old, new)
    servo, _, _ = client_of(load(text, "servo.py"))
    servo._address = 1
    servo.send("Write", torque=5)
    answer = servo.send("Read", register="torque")
    assert answer is not None
    assert dict(answer.told) == {"values": b"\x05", "torque": ("hot", "slow")}


# -- what it raises -------------------------------------------------------------------------------


def test_an_error_answer_is_raised_with_its_name() -> None:
    meter, device, _ = driver("modbus-rtu", 1)
    device.saying = [bytes.fromhex("01 83 02 c0 f1")]
    with pytest.raises(Refused) as raised:
        meter.read_holding_registers(0, 1)
    assert raised.value.answer == "ILLEGAL_DATA_ADDRESS"
    assert raised.value.code == 2
    assert raised.value.instruction == "ReadHoldingRegisters"
    assert raised.value.frame == bytes.fromhex("01 03 00 00 00 01 84 0a")
    assert meter.read_holding_registers(0, 1) == (0,)


def test_several_flags_are_named_together() -> None:
    servo, device, _ = driver("dynamixel1", 1)
    device.saying = [bytes.fromhex("ff ff 01 02 24 d8")]
    with pytest.raises(Refused, match="was answered OVERHEATING OVERLOAD") as raised:
        servo.ping()
    assert raised.value.answer == "OVERHEATING OVERLOAD"


def test_an_echo_that_reads_as_an_error_is_no_error() -> None:
    servo, device, _ = driver("dynamixel1", 1)
    device.saying = [bytes.fromhex("ff ff 01 02 01 fb")]  # Ping, and the code 01 by chance
    with pytest.raises(RobotError, match="came back: where the line has an echo, use echo=True"):
        servo.ping()


@pytest.mark.parametrize(
    ("answer", "kind", "words"),
    [
        ("", NoAnswer, "was not answered in 5000 ms"),
        ("01 03 02 00", RobotError, "the answer broke off after 4 of 7 bytes"),
        ("01 03 02 00 00 b8 45", RobotError, "crc is b8 45, right is b8 44"),
        ("02 03 02 00 00 fc 44", RobotError, "was answered 02 .*: address is 2, right is 1"),
        ("78 " * 99, RobotError, r"was answered (78 ){16}\.\.\.: address is 120, right is 1"),
        ("01 03 00 00 00 01 84 0a", RobotError, "came back: where the line has an echo, use echo"),
        ("01 03 02 00 00 b8 44 00", RobotError, "00 came after its answer"),
    ],
)
def test_the_line_is_silent_before_the_next_after_a_bad_answer(
    answer: str, kind: type[Exception], words: str
) -> None:
    meter, device, _ = driver("modbus-rtu", 1)
    device.saying = [bytes.fromhex(answer)]
    with pytest.raises(kind, match=words):
        meter.read_holding_registers(0, 1)
    assert meter.read_holding_registers(0, 1) == (0,)


def test_a_wrong_use_sends_nothing() -> None:
    meter, device, _ = driver("modbus-rtu")
    with pytest.raises(ValueError, match=r"needs address: 1 to 247, and 0 for all"):
        meter.read_coils(0, 1)
    with pytest.raises(ValueError, match="address is 250, allowed are 1 to 247, and 0 for all"):
        meter.read_coils(0, 1, address=250)
    with pytest.raises(ValueError, match="quantity is 0, allowed are 1 to 2000"):
        meter.read_coils(0, 0, address=1)
    with pytest.raises(TypeError, match="missing a required argument: 'quantity'"):
        meter.read_coils(0)
    with pytest.raises(AttributeError, match="modbus-rtu has no instruction 'read_coil'"):
        meter.read_coil(0)
    with pytest.raises(ValueError, match="stk500v1 has no addresses; address is 1"):
        Device("loop://", grammar="stk500v1", address=1)
    for wrong, why in (
        ({"timeout": "1"}, "timeout is '1', allowed are milliseconds above 0"),
        ({"baud": 9600.5}, "baud is 9600.5, allowed are whole numbers from 1"),
        ({"stopbits": "2"}, "stopbits is '2', allowed are 1, 1.5 and 2"),
    ):
        with pytest.raises(ValueError, match=why):
            Device("loop://", grammar="stk500v1", **wrong)  # type: ignore[arg-type]
    assert device.heard == b""


def test_only_reading_refuses_what_may_change_something() -> None:
    with opened("modbus-rtu", address=17, only_reading=True) as (meter, device):
        assert meter.read_coils(0, 8) == b"\x00"
        heard = device.heard
        with pytest.raises(ValueError, match=r"^@17 WriteSingleCoil .* may write coils: only_read"):
            meter.write_single_coil(0, "on")
        with pytest.raises(ValueError, match="may write coils: only_reading sends what changes"):
            meter.send("WriteSingleCoil", coil=0, value="on")
        assert device.heard == heard


# -- all agree ------------------------------------------------------------------------------------


def agreeing(client: DeviceDriver, device: Scripted, tap: Tap, frame: bytes) -> None:
    """Have a request sent by its fields: it is that frame, and is paired with its answer."""
    asked = judge(client.protocol, frame)
    assert asked.instruction is not None
    parts = {part.name: part.read(frame) for part in free_parts(client.protocol)}
    device.heard, tap.records = b"", []
    reply = client.send(asked.instruction.name, **parts, **dict(asked.fields))
    assert device.heard == frame
    host, *answers = tap.records
    assert isinstance(host, HostRecord)
    assert host.data == frame
    assert len(answers) == asked.answer_due == (reply is not None)
    for answer in answers:
        assert isinstance(answer, DeviceRecord)
        assert reply is not None
        assert answer.reply is not None
        assert answer.instruction == host.sequence
        assert answer.agrees
        assert answer.data == reply.frame
        assert answer.reply.fields == reply.fields


@pytest.mark.parametrize("name", NAMES)
def test_client_simulator_and_decoder_agree(name: str) -> None:
    client, device, tap = driver(name)
    chance = Random(name)
    for _ in range(200):
        agreeing(client, device, tap, drawn_request(client.protocol, chance))


@pytest.mark.sample(60)
@pytest.mark.parametrize("seed", range(200))
def test_client_simulator_and_decoder_agree_in_any_layout(seed: int) -> None:
    protocol, draw = drawn_layout(seed).protocol, Random(seed)
    client, device, tap = client_of(protocol)
    for spec in protocol.instructions:
        values = drawn_values(draw, protocol, spec)
        agreeing(client, device, tap, build(protocol, spec.name, values))
