"""Grammars of the family, drawn by seed out of parts: instructions, fields, headers, effects."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random
from typing import NamedTuple

_IMPORTS = """\
from construct import (
    BitsInteger, BitStruct, Byte, BytesInteger, Checksum, Int8sb, Int16sb, Int16ub, Int16ul,
    Struct, Switch, this,
)
from bilprov.spec.fields import (
    Answer, Answers, Clauses, From, Instruction, LineDefaults, Outcome, Ranged, Sets, Timing,
)
from bilprov.spec.motion import Motion

NAME, VERSION, DOCUMENT = "drawn", "{seed}", "none"
"""

_BYTES = (("Byte", 0, 255), ("Byte", 0, 100), ("Byte", 1, 255), ("Byte", 0, 1), ("Byte", 5, 5))
_WORDS = (("Int16ub", 0, 1000), ("Int16ul", 0, 60_000), ("BytesInteger(3)", 1, 70_000))
_SIGNED = (("Int8sb", -100, 100), ("Int8sb", -128, 127), ("Int16sb", -300, 301))
_TURNS = ("FORWARD", "BACKWARD", "ROTATE_RIGHT", "ROTATE_LEFT")
_OUTCOMES = ("VALID", "UNKNOWN_ID", "BAD_DATA", "TOO_MANY", "TOO_FEW")


class Part(NamedTuple):
    """One drawn instruction: its name, its fields (name, type, range) and what it sets."""

    name: str
    fields: tuple[tuple[str, str, int, int, str], ...]
    sets: dict[str, str]

    @property
    def size(self) -> int:
        """Its data bytes."""
        sizes = {"Int16ub": 2, "Int16ul": 2, "Int16sb": 2, "BytesInteger(3)": 3}
        return sum(sizes.get(kind, 1) for _, kind, *_ in self.fields)

    def text(self, identity: int) -> str:
        """Its entry in the grammar."""
        fields = "".join(
            f'"{name}" / Ranged({kind}, {low}, {high}{bits}) * "a value", '
            for name, kind, low, high, bits in self.fields
        )
        effect = _sets(self.sets)
        return (
            f'    {identity}: "{self.name}" / Instruction({fields}document="", effect={effect})'
            f' * "What it does.",\n'
        )


class Drawn(NamedTuple):
    """A drawn grammar's text, and what the loader must say against it ("" for nothing)."""

    seed: int
    text: str
    refused: str


def drawn(seed: int) -> Drawn:
    """The grammar of this seed."""
    draw = Random(f"grammar {seed}")
    # One length bit carries one data byte, seven carry 127: both ends are rare.
    bits = draw.choice((2, 3, 3, 4, 4, 4, 5, 5, 6, 6, 7))
    parts = _parts(draw, longest=2 ** (8 - bits) - 1)
    parts = parts[: 2**bits]
    identities = sorted(draw.sample(range(2**bits), len(parts)))
    draw.shuffle(parts)
    refused = draw.choice(("FRAME", "FAULTY", "POWER_ON")) if draw.random() < 0.06 else ""
    faulty = {"motion": "Motion.STOPPED"} | _resets(draw)
    power_on = {} if draw.random() < 0.4 else {"motion": "Motion.STOPPED"} | _resets(draw)
    if refused == "FAULTY":
        faulty = draw.choice(({}, {"steering": "0"}, {"motion": "Motion.FORWARD"}))
    if refused == "POWER_ON":
        power_on["motion"] = "Motion.BACKWARD"
    codes = draw.sample(range(256), len(_OUTCOMES))
    timeout = draw.choice((5, 20, 50, 50, 50, 200, 1000))
    deadline = draw.choice((1, 10, 100, 100, 100, 500))
    checksum = ', "sum" / Checksum(Byte, lambda data: 0, b"")' if refused == "FRAME" else ""
    header = [f'"id" / BitsInteger({bits}) * "which"', f'"length" / BitsInteger({8 - bits}) * "n"']
    draw.shuffle(header)
    answers = "".join(
        f'    {code}: Answer("{outcome}", Outcome.{outcome}, "", "an answer"),\n'
        for code, outcome in zip(codes, _OUTCOMES, strict=True)
    )
    text = (
        f"{_IMPORTS.format(seed=seed)}"
        f"HEADER = BitStruct({', '.join(header)})\n"
        "INSTRUCTIONS = {\n"
        f"{''.join(p.text(i) for i, p in zip(identities, parts, strict=True))}"
        "}\n"
        f'FRAME = Struct("header" / HEADER, "data" / Switch(this.header.id, INSTRUCTIONS)'
        f"{checksum})\n"
        f"RESPONSE = Answers(Byte, {{\n{answers}}})\n"
        f"FAULTY = {_sets(faulty)}\n"
        f"POWER_ON = {_sets(power_on)}\n"
        f"TIMING = Timing(truncation_timeout={timeout}, truncation_shortest={min(5, timeout)}, "
        f"truncation_longest={max(1000, timeout)}, answer_deadline={deadline}, "
        f"answer_longest=1000, stop_longest={draw.choice((20, 100, 100, 500))})\n"
        f'LINE = LineDefaults(baud={draw.choice((9600, 57_600, 115_200))}, parity="N", '
        "stopbits=1)\n"
        'CLAUSES = Clauses(header="1", instructions="2", responses="3", safety="4")\n'
    )
    return Drawn(seed, text, refused)


def _sets(values: dict[str, str]) -> str:
    return f"Sets({', '.join(f'{name}={value}' for name, value in values.items())})"


def _resets(draw: Random) -> dict[str, str]:
    """What a stop, a fault or the power-on sets beside the motion: mostly zeros."""
    found = {}
    if draw.random() < 0.6:
        found["steering"] = "0"
    if draw.random() < 0.25:
        found["speed"] = draw.choice(("0", "0", "7"))
    if draw.random() < 0.25:
        found["led"] = draw.choice(("0", "1"))
    return found


def _parts(draw: Random, longest: int) -> list[Part]:
    """The stop, then what else there is in a drawn order; the header may not carry all of them."""
    stop = {"motion": "Motion.STOPPED"} | _resets(draw)
    others = [part for part in _others(draw) if part.size <= longest]
    draw.shuffle(others)
    return [Part("Stop", (), stop), *others]


def _field(
    draw: Random, name: str, kinds: tuple[tuple[str, int, int], ...], bits: str = ""
) -> tuple[str, str, int, int, str]:
    kind, low, high = draw.choice(kinds)
    return name, kind, low, high, f', bits="{bits}"' if bits else ""


def _others(draw: Random) -> Iterator[Part]:
    """Every part but the stop that this draw has."""

    def has(chance: float) -> bool:
        return draw.random() < chance

    speeds = (*_BYTES, *_BYTES, *_WORDS, *_SIGNED)
    for turn in _TURNS if has(0.9) else ():
        if has(0.65 if "ROTATE" in turn else 0.85):
            more = _resets(draw) if has(0.15) else {}
            yield Part(turn.title().replace("_", ""), (), {"motion": f"Motion.{turn}"} | more)
    if has(0.75):
        speed = _field(draw, "speed", speeds)
        factor = ", factor=2" if has(0.1) else ""
        yield Part("Speed", (speed,), {"speed": f'From("speed"{factor})'})
    if has(0.2):
        yield Part("Fast", (), {"speed": "200"})
    if has(0.5):
        for name, factor in (("Right", ""), ("Left", ", factor=-1")):
            strength = _field(draw, "strength", _BYTES)
            yield Part(name, (strength,), {"steering": f'From("strength"{factor})'})
    if has(0.2):
        yield Part("Steer", (_field(draw, "angle", _SIGNED),), {"steering": 'From("angle")'})
    if has(0.2):  # one that sets two variables
        both = _field(draw, "speed", speeds), _field(draw, "steering", (*_BYTES, *_SIGNED))
        sets = {"speed": 'From("speed")', "steering": 'From("steering")'}
        yield Part("Both", both, sets)
    if has(0.25):  # a motion with data
        data = [_field(draw, "speed", speeds)]
        sets = {"motion": f"Motion.{draw.choice(_TURNS)}", "speed": 'From("speed")'}
        if has(0.5):
            data.append(_field(draw, "turn", _SIGNED))
            sets["steering"] = 'From("turn")'
        yield Part("Drive", tuple(data), sets)
    if has(0.6):
        light = _field(draw, "rgb", (("Byte", 0, 7),), "RGB")
        if has(0.5):
            light = _field(draw, "lamp", speeds)
        yield Part("LED", (light,), {"led": f'From("{light[0]}")'})
    if has(0.1):
        yield Part("Halt", (), {"motion": "Motion.STOPPED"} | _resets(draw))
    if has(0.1):
        brake = _field(draw, "force", _BYTES)
        yield Part("Brake", (brake,), {"motion": "Motion.STOPPED"})
    if has(0.2):
        yield Part("Horn", (_field(draw, "tone", (*_BYTES, *_WORDS)),), {})
    if has(0.1):
        yield Part("Many", tuple(_field(draw, f"f{n}", _BYTES) for n in range(4)), {})
    if has(0.1):
        yield Part("Ping", (), {})
