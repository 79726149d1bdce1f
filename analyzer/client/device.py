"""Drives a device of any grammar from Python: methods return the fields of the answers."""

from __future__ import annotations

import os
from os import PathLike

from bilprov.analyzer.client.driver import DeviceDriver, require_address
from bilprov.analyzer.client.port_driver import OnPort
from bilprov.analyzer.grammar_file import given_protocol
from bilprov.analyzer.transport.machine import Machine
from bilprov.spec.protocol import Protocol


class Device(OnPort, DeviceDriver):
    """A device on a port, driven from Python; each instruction of the grammar is a method.

        with Device("/dev/ttyUSB0", grammar="modbus-rtu", address=17) as meter:
            first, second = meter.read_holding_registers(start=0, quantity=2)

    `grammar` is the name of a shipped grammar, a file or a Protocol. `address` is the device that
    is meant unless a method is called with another one. With `only_reading` a method that may
    change something raises ValueError instead of sending it. `OnPort` describes the other
    arguments and how it is left, `DeviceDriver` the methods and the exceptions. Nothing is sent at
    first and at the end, unless the grammar tells when the device is at rest.
    """

    def __init__(
        self,
        url: str | PathLike[str],
        *,
        grammar: str | PathLike[str] | Protocol | None = None,
        address: int | None = None,
        only_reading: bool = False,
        timeout: float | None = None,
        baud: int | None = None,
        parity: str | None = None,
        stopbits: float | None = None,
        echo: bool = False,
    ) -> None:
        grammar = given_protocol(grammar)
        if address is not None:
            require_address(grammar, address)
        self._address = address
        self._only_reading = only_reading
        self._least_pause = Machine().least_pause(os.fspath(url))
        super().__init__(
            url,
            grammar=grammar,
            timeout=timeout,
            baud=baud,
            parity=parity,
            stopbits=stopbits,
            echo=echo,
        )
