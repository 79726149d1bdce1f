"""A broken device object gives one sentence that names the method and what it returned."""

from __future__ import annotations

from typing import Any

import pytest

from bilprov.captures.topics import CarLook
from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.virtual_link import DeviceError
from bilprov.spec.protocol import Protocol

FEW = Options(only=("valid/LED/*",))


class Own:
    """The reference device as somebody's own object, broken in one way."""

    def __init__(self, protocol: Protocol, **broken: Any) -> None:
        device = Simulator(protocol)
        for name in ("receive", "advance", "deadline", "look"):
            setattr(self, name, broken.get(name, getattr(device, name)))


def raising(*arguments: object) -> None:
    raise KeyError("x\x1b")


BROKEN = [
    (
        {"look": lambda now: None},
        "the device's look gave None; it must give an instance of bilprov.Look",
    ),
    ({"look": lambda now: {"moving": True}}, "the device's look gave {'moving': True}"),
    ({"advance": lambda now: "\0"}, "the device's advance gave '\\x00'; it must give bytes"),
    ({"advance": lambda now: None}, "the device's advance gave None"),
    ({"deadline": lambda: 1.5}, "the device's deadline gave 1.5"),
    ({"deadline": lambda: -1}, "the device's deadline gave -1 again after advance("),
    ({"receive": raising}, "the device's receive raised KeyError: 'x"),
    ({"look": lambda: CarLook(t=0, moving=False)}, "the device's look raised TypeError"),
    ({"deadline": None}, "the device object Own has no method deadline"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("broken", "words"), BROKEN, ids=[words for _, words in BROKEN])
def test_the_method_is_named(protocol: Protocol, broken: dict[str, Any], words: str) -> None:
    device: Any = Own(protocol, **broken)

    with pytest.raises(DeviceError) as raised:
        conform(device, grammar=protocol, options=FEW)

    assert str(raised.value).startswith(words)
    assert str(raised.value).isprintable()


def test_a_device_that_keeps_to_it_is_judged_as_ever(protocol: Protocol) -> None:
    device: Any = Own(protocol)

    assert conform(device, grammar=protocol, options=FEW).exit == 0
