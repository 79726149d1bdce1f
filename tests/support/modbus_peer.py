"""A client or a server of pymodbus: modbus_peer.py client|server TTY.

The client fails where an answer is not what the server's registers and coils are due to give.
"""

from __future__ import annotations

import asyncio
import sys
import time

from pymodbus import FramerType
from pymodbus.client import ModbusSerialClient
from pymodbus.server import ModbusSerialServer
from pymodbus.simulator import DataType, SimData, SimDevice

UNIT, SIZE = 17, 100
ILLEGAL_DATA_ADDRESS = 2
TURNAROUND = 1.0  # s that servers get to carry out a broadcast; this one loses what comes at once
PATIENCE = 30.0  # s; who asks again, because a busy machine answers late, is answered twice


def client(port: str) -> None:
    line = ModbusSerialClient(port, framer=FramerType.RTU, baudrate=19200, timeout=PATIENCE)
    assert line.connect()
    unit = {"device_id": UNIT}
    assert line.read_coils(0, count=SIZE, **unit).bits[:5] == [True, False, False, True, False]
    assert line.read_discrete_inputs(1, count=9, **unit).bits[:2] == [True, False]
    assert line.read_holding_registers(0, count=SIZE, **unit).registers[-1] == 1099
    assert line.read_input_registers(5, count=1, **unit).registers == [2005]
    assert not line.write_coil(4, True, **unit).isError()
    assert line.read_coils(4, count=1, **unit).bits[0]
    assert not line.write_register(6, 0x1234, **unit).isError()
    pattern = [True, False, True, True, False, False, True, True, False, True]
    assert not line.write_coils(20, pattern, **unit).isError()
    assert line.read_coils(20, count=10, **unit).bits[:10] == pattern
    four = [0xFFFF, 0x8000, 0x0102, 7]
    assert not line.write_registers(30, four, **unit).isError()
    assert not line.mask_write_register(address=6, and_mask=0xF2, or_mask=0x25, **unit).isError()
    both = line.readwrite_registers(
        read_address=30, read_count=4, write_address=40, values=four, **unit
    )
    assert both.registers == four
    for refused in (
        line.read_holding_registers(99, count=2, **unit),
        line.write_register(100, 1, **unit),
    ):
        assert refused.exception_code == ILLEGAL_DATA_ADDRESS
    line.write_register(50, 0x4321, device_id=0, no_response_expected=True)
    time.sleep(TURNAROUND)
    assert line.read_holding_registers(50, count=1, **unit).registers == [0x4321]
    line.close()


async def serve(port: str) -> None:
    bits, words = DataType.BITS, DataType.REGISTERS
    blocks = (
        [SimData(0, values=[at % 3 == 0 for at in range(SIZE)], datatype=bits)],
        [SimData(0, values=[at % 2 == 1 for at in range(SIZE)], datatype=bits)],
        [SimData(0, values=[1000 + at for at in range(SIZE)], datatype=words)],
        [SimData(0, values=[2000 + at for at in range(SIZE)], datatype=words)],
    )
    server = ModbusSerialServer(
        SimDevice(UNIT, simdata=blocks),
        framer=FramerType.RTU,
        port=port,
        baudrate=19200,
        broadcast_enable=True,
    )
    await server.serve_forever(background=True)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    await asyncio.Event().wait()


if __name__ == "__main__":
    role, port = sys.argv[1:]
    if role == "server":
        asyncio.run(serve(port))
    else:
        client(port)
