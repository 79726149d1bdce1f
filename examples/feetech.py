"""A Feetech STS3215 servo: DYNAMIXEL 1.0, with its registers by name."""

from construct import Byte, Enum, Int16ul

from bilprov.spec.grammars.dynamixel1 import *  # noqa: F403

NAME = "feetech-sts3215"
VERSION = "1"
DOCUMENT = "Feetech STS3215, memory table of the SMS and STS series"
OFF_ON = Enum(Byte, off=0, on=1)
REGISTERS = {
    "registers": {
        5: "servo_id" / Byte,
        9: "min_position" / Int16ul * "steps, 4096 for a full turn",
        11: "max_position" / Int16ul * "steps",
        40: "torque" / OFF_ON * "whether it holds its position",
        41: "acceleration" / Byte * "100 steps/s²",
        42: "goal_position" / Int16ul * "steps",
        44: "goal_time" / Int16ul * "ms",
        46: "goal_velocity" / Int16ul * "steps/s",
        56: "present_position" / Int16ul * "steps",
        58: "present_velocity" / Int16ul * "steps/s",
        62: "present_voltage" / Byte * "0.1 V",
        63: "present_temperature" / Byte * "°C",
        66: "moving" / OFF_ON,
    }
}
