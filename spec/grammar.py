"""The robot-car serial protocol (MindRoad, 2015-06-23, v1.1): the one place where it is said.

Everything else - decoder, encoder, simulator, conformance cases, documentation - is read out of
these declarations. A copy of this file with an entry added is another protocol of the family; give
it to the command with --grammar FILE.py. Where the document is silent or contradicts itself, the
choice made here names its reading (R-...) or erratum (E...); see `bilprov spec readings`.
"""

from construct import BitsInteger, BitStruct, Byte, Struct, Switch, this

from bilprov.spec.fields import (
    Answer,
    Answers,
    AnyOf,
    Bits,
    Clauses,
    From,
    Instruction,
    LineDefaults,
    Outcome,
    Ranged,
    Sets,
    Timing,
    Variables,
    Wheels,
    Whole,
    Word,
)

NAME = "robot-car"
VERSION = "1.1"
DOCUMENT = "Protokoll för seriell kommunikation för robotbil, MindRoad, v1.1, 2015-06-23"

DEVICE = "robot"

STATE = Variables(
    motion=Word("stopped", "forward", "backward", "rotate_right", "rotate_left"),
    speed=Whole(0, 255),
    steering=Whole(-255, 255),  # right positive
    led=Bits("RGB"),
)
AT_REST = AnyOf(motion="stopped", speed=0)  # R-speed-zero: a direction with speed 0 does not move
WHEELS = Wheels(
    by="motion",
    speed="speed",
    steering="steering",
    turns={  # forward 1, backward -1: the left wheel, the right one
        "forward": (1, 1),
        "backward": (-1, -1),
        "rotate_right": (1, -1),
        "rotate_left": (-1, 1),
    },
)

HEADER = BitStruct(
    "id" / BitsInteger(4) * "which instruction it is",
    "length" / BitsInteger(4) * "number of data bytes that follow",
)

INSTRUCTIONS = {
    0: "Stop"
    / Instruction(
        document="Stopp",
        effect=Sets(motion="stopped", steering=0),  # R-stop-steering, R-stop-speed
    )
    * "Stops the robot and resets the directions that were set.",
    1: "Speed"
    / Instruction(
        "speed" / Ranged(Byte, 0, 255) * "speed that the other instructions use",
        document="Hastighet",
        effect=Sets(speed=From("speed")),  # R-speed-moving: takes effect at once
    )
    * "Sets the speed with which the robot moves; used together with the other instructions.",
    2: "Forward"
    / Instruction(document="Framåt", effect=Sets(motion="forward"))  # R-drive-steering
    * "Sets the direction forward and drives at the speed set before.",
    3: "Backward"
    / Instruction(document="Bakåt", effect=Sets(motion="backward"))
    * "Sets the direction backward and drives at the speed set before.",
    4: "Right"
    / Instruction(
        "strength" / Ranged(Byte, 0, 255) * "steering strength",
        document="Höger",
        effect=Sets(steering=From("strength")),  # R-steering, R-steer-rotating
    )
    * "Moves right at the speed and in the direction set before.",
    5: "Left"
    / Instruction(
        "strength" / Ranged(Byte, 0, 255) * "steering strength",
        document="Vänster",
        effect=Sets(steering=From("strength", factor=-1)),
    )
    * "Moves left at the speed and in the direction set before.",
    6: "RotateRight"
    / Instruction(document="Rotera hö.", effect=Sets(motion="rotate_right"))
    * "Stops, then rotates on the spot to the right at the speed set before.",
    7: "RotateLeft"
    / Instruction(document="Rotera vä.", effect=Sets(motion="rotate_left"))
    * "Stops, then rotates on the spot to the left at the speed set before.",
    8: "LED"  # E5, R-led-id
    / Instruction(
        "rgb"
        / Ranged(Byte, 0, 7, bits="RGB", reading="R-led-upper-bits")
        * "colours, 1 on and 0 off",
        document="LED",
        effect=Sets(led=From("rgb")),
    )
    * "Changes the colours of the RGB diode: the last three bits switch R, G and B.",
}

FRAME = Struct("header" / HEADER, "data" / Switch(this.header.id, INSTRUCTIONS))

RESPONSE = Answers(
    Byte,
    {
        0: Answer(
            "OK", Outcome.VALID, "Korrekt instruktion mottagen", "correct instruction received"
        ),
        1: Answer(
            "BAD_HEADER", Outcome.UNKNOWN_ID, "Felaktig header mottagen", "wrong header received"
        ),
        2: Answer("BAD_DATA", Outcome.BAD_DATA, "Felaktig data mottagen", "wrong data received"),
        3: Answer(
            "TOO_MANY_DATA",
            Outcome.TOO_MANY,
            "För många byte data mottagna",
            "too many data bytes received",
        ),
        4: Answer(
            "TOO_FEW_DATA",
            Outcome.TOO_FEW,
            "För få byte data mottagna",
            "too few data bytes received",
        ),
    },
)

# Section 2: a faulty instruction stops the robot at once. R-fault-state: it resets what Stop does.
FAULTY = Sets(motion="stopped", steering=0)

# R-power-on
POWER_ON = Sets(motion="stopped", speed=0, steering=0, led=0)

TIMING = Timing(
    truncation_timeout=50,
    truncation_shortest=5,
    truncation_longest=1000,
    answer_deadline=100,
    answer_longest=1000,
    stop_longest=100,
)

LINE = LineDefaults(baud=115200, parity="N", stopbits=1)

CLAUSES = Clauses(
    header="section 2",
    instructions="section 3, table 1",
    responses="section 4, table 2",
    safety="section 2",
)
