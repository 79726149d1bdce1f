"""The C header that is generated from the grammar."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.spec.codec import build
from bilprov.spec.emit.c import c_header
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.drawn_layouts import drawn_layout
from tests.support.firmware import needs
from tests.support.grammars import checked_digits
from tests.vectors import HEADERS, LINE, LONGEST_FRAME, RESPONSES, TIMING
from tests.vectors_checks import CHECKS


def constants(text: str) -> dict[str, int]:
    """The header's numbers by their names, without the prefix."""
    found = re.findall(r"^#define ROBOT_CAR_(\w+) (0x[0-9a-f]+|\d+)\b", text, re.MULTILINE)
    assert len(found) == len(dict(found)), "a name is defined twice"
    return {name: int(value, 0) for name, value in found}


def words(name: str) -> str:
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).upper()


def test_it_says_what_the_document_says(protocol: Protocol) -> None:
    found = constants(c_header(protocol))

    for row in HEADERS:
        assert found[f"{words(row.name)}_ID"] == row.id
        assert found[f"{words(row.name)}_LENGTH"] == row.length
        assert found[words(row.name)] == row.id << 4 | row.length
    for response in RESPONSES:
        assert found[f"ANSWER_{response.name}"] == response.code
    assert found["LED_RGB_MAX"] == 7
    assert (found["LED_RGB_R"], found["LED_RGB_G"], found["LED_RGB_B"]) == (4, 2, 1)
    assert (found["ID_SHIFT"], found["ID_MASK"]) == (4, 0xF0)
    assert (found["LENGTH_SHIFT"], found["LENGTH_MASK"]) == (0, 0x0F)
    assert found["MAX_FRAME"] == LONGEST_FRAME == found["MAX_DATA"] + 1
    assert found["BAUD"] == LINE["baud"]
    assert found["TRUNCATION_TIMEOUT_MS"] == TIMING["truncation_timeout"]


def framed(name: str) -> Protocol:
    return load_protocol(name if "." not in name else str(ROOT / "examples" / name))


FRAMED = ["modbus-rtu", "stk500v1", "dynamixel1", "feetech.py", "relay_board.py", "roboclaw.py"]
GCC = needs("gcc", package="gcc libc6-dev")


def compiled(folder: Path, text: str, *options: str) -> list[str]:
    """The command that a C file compiles to, without a warning."""
    source, program = folder / "use.c", folder / "use"
    source.write_text(text, encoding="utf-8")
    words = ["gcc", "-std=c89", "-pedantic", "-Wall", "-Wextra", "-Werror", *options]
    done = subprocess.run([*words, "-o", program, source], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    return [str(program)]


@GCC
@pytest.mark.parametrize("name", FRAMED)
def test_every_constant_of_a_framed_grammar_is_one_of_c(name: str, tmp_path: Path) -> None:
    text = c_header(framed(name))
    names = re.findall(r"^#define (\w+) (.*?)(?: /\*.*)?$", text, re.MULTILINE)[0:]
    uses = [
        f"static const unsigned char b{at}[] = {name};" if "{" in value else f"long n{at} = {name};"
        for at, (name, value) in enumerate(names)
    ]
    size = "".join(f"+ sizeof b{at}" for at, (_, value) in enumerate(names) if "{" in value)
    (tmp_path / "protocol.h").write_text(text, encoding="utf-8")
    main = f"int main(void) {{ return (0 {size}) > 255; }}"
    compiled(tmp_path, "\n".join(['#include "protocol.h"', *uses, main]))


@pytest.mark.sample(8)
@GCC
@pytest.mark.parametrize("seed", range(0, 200, 10))
def test_the_header_of_any_layout_compiles(seed: int, tmp_path: Path) -> None:
    (tmp_path / "protocol.h").write_text(c_header(drawn_layout(seed).protocol), encoding="utf-8")
    compiled(tmp_path, '#include "protocol.h"\nint main(void) { return 0; }\n')


WRITING_A_REGISTER = """
#include <stdio.h>
#include "protocol.h"

static unsigned crc(const unsigned char *data, int size) {
    unsigned value = MODBUS_RTU_FRAME_CHECK_CRC_INIT, poly = 0;
    int bit, at;
    for (bit = 0; bit < MODBUS_RTU_FRAME_CHECK_CRC_WIDTH; bit++)
        if (MODBUS_RTU_FRAME_CHECK_CRC_POLY >> bit & 1)
            poly |= 1u << (MODBUS_RTU_FRAME_CHECK_CRC_WIDTH - 1 - bit);
    for (at = 0; at < size; at++) {
        value ^= data[at];
        for (bit = 0; bit < 8; bit++) value = value >> 1 ^ (value & 1 ? poly : 0);
    }
    return value ^ MODBUS_RTU_FRAME_CHECK_CRC_XOROUT;
}

static void put(unsigned char *at, unsigned value, int little) {
    at[little ? 0 : 1] = value & 0xff;
    at[little ? 1 : 0] = value >> 8;
}

int main(void) {
    unsigned char frame[64];
    unsigned char *data = frame + MODBUS_RTU_FRAME_HEAD;
    int at, end = MODBUS_RTU_FRAME_HEAD + MODBUS_RTU_WRITE_SINGLE_REGISTER_LENGTH
        + MODBUS_RTU_FRAME_TAIL;
    frame[MODBUS_RTU_FRAME_ADDRESS_OFFSET] = 17;
    frame[MODBUS_RTU_FRAME_ID_OFFSET] = MODBUS_RTU_WRITE_SINGLE_REGISTER_ID;
    put(data + MODBUS_RTU_WRITE_SINGLE_REGISTER_REGISTER_OFFSET, 1,
        MODBUS_RTU_WRITE_SINGLE_REGISTER_REGISTER_LITTLE_ENDIAN);
    put(data + MODBUS_RTU_WRITE_SINGLE_REGISTER_VALUE_OFFSET, 3,
        MODBUS_RTU_WRITE_SINGLE_REGISTER_VALUE_LITTLE_ENDIAN);
    put(frame + end - MODBUS_RTU_FRAME_CRC_FROM_END,
        crc(frame + MODBUS_RTU_FRAME_CHECK_FIRST,
            end - MODBUS_RTU_FRAME_CHECK_LAST - MODBUS_RTU_FRAME_CHECK_FIRST),
        MODBUS_RTU_FRAME_CRC_LITTLE_ENDIAN);
    for (at = 0; at < end; at++) printf("%02x", frame[at]);
    return 0;
}
"""


@GCC
def test_a_program_builds_a_request_from_the_header_alone(tmp_path: Path) -> None:
    protocol = load_protocol("modbus-rtu")
    (tmp_path / "protocol.h").write_text(c_header(protocol), encoding="utf-8")
    program = compiled(tmp_path, WRITING_A_REGISTER)
    values = {"address": 17, "register": 1, "value": 3}

    told = subprocess.run(program, capture_output=True, check=True).stdout

    assert told.decode() == build(protocol, "WriteSingleRegister", values).hex()


def test_the_header_has_what_a_request_with_a_length_and_a_register_is_built_of() -> None:
    text = c_header(framed("feetech.py"))
    for constant in (
        "FRAME_LENGTH_ALSO 2",
        "FRAME_CHECK_SUM_COMPLEMENT 0x01",
        "REGISTER_GOAL_POSITION 42",
        "REGISTER_GOAL_POSITION_LITTLE_ENDIAN 1",
    ):
        assert f"#define FEETECH_STS3215_{constant}" in text


ANY_CRC = r"""
#include <stdio.h>

static unsigned long turned(unsigned long value, int width) {
    unsigned long found = 0;
    int bit;
    for (bit = 0; bit < width; bit++) found |= (value >> bit & 1) << (width - 1 - bit);
    return found;
}

static void crc(int width, unsigned long poly, unsigned long value, int reflected,
                unsigned long xorout, int refout) {
    const char *digit;
    int bit;
    for (digit = "123456789"; *digit; digit++)
        for (bit = 0; bit < 8; bit++) {
            int next = *digit >> (reflected ? bit : 7 - bit) & 1;
            int top = value >> (width - 1) & 1;
            value = value << 1 & ((2ul << (width - 1)) - 1);
            if (top != next) value ^= poly;
        }
    printf("%lu\n", (refout ? turned(value, width) : value) ^ xorout);
}
"""


@GCC
def test_a_program_computes_each_published_crc_from_the_header_alone(tmp_path: Path) -> None:
    crcs = [one for one in CHECKS if one.declared.startswith("Crc")]
    words = ("WIDTH", "POLY", "INIT", "REFLECTED", "XOROUT", "REFOUT")
    calls = []
    for at, one in enumerate(crcs):
        header = c_header(checked_digits(one, "big")[0])
        (tmp_path / f"{at}.h").write_text(header, encoding="utf-8")
        prefix = header.partition("#ifndef ")[2].partition("_PROTOCOL_H")[0]
        given = ", ".join(f"{prefix}_FRAME_CHECK_CRC_{word}" for word in words)
        calls.append(f"    crc({given});")
    includes = [f'#include "{at}.h"' for at in range(len(crcs))]
    text = "\n".join([*includes, ANY_CRC, "int main(void) {", *calls, "    return 0;", "}", ""])

    told = subprocess.run(compiled(tmp_path, text), capture_output=True, check=True).stdout

    assert [int(line) for line in told.splitlines()] == [one.value for one in crcs]


@needs("avr-gcc", package="gcc-avr")
@pytest.mark.parametrize("language", ["-std=c89", "-xc++"])
def test_it_compiles_without_a_warning(protocol: Protocol, tmp_path: Path, language: str) -> None:
    header = tmp_path / "protocol.h"
    header.write_text(c_header(protocol), encoding="utf-8")
    use = tmp_path / "use.c"
    use.write_text('#include "protocol.h"\n#include "protocol.h"\nint led = ROBOT_CAR_LED;\n')

    flags = f"-pedantic -Wall -Wextra -Werror {language} -c -o /dev/null".split()
    done = subprocess.run(["avr-gcc", *flags, use], capture_output=True, text=True, check=False)

    assert (done.returncode, done.stderr) == (0, "")
