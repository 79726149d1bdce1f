"""Published checks of the nine digits 123456789, typed by hand.

Those with the name of a CRC are of the catalogue of parametrised CRC algorithms (RevEng): width,
poly, init, refin and refout, xorout, check. Nothing of the kit is imported.
"""

from __future__ import annotations

from typing import NamedTuple

DIGITS = b"123456789"


class CheckVector(NamedTuple):
    """A check as a grammar declares it, and its value of the nine digits."""

    name: str
    declared: str
    value: int

    def __str__(self) -> str:
        return self.name


CHECKS = [
    CheckVector(*row)
    for row in (
        ("CRC-3/GSM", "Crc(3, 0x3, xorout=0x7)", 0x4),
        ("CRC-3/ROHC", "Crc(3, 0x3, 0x7, reflected=True)", 0x6),
        ("CRC-4/G-704", "Crc(4, 0x3, reflected=True)", 0x7),
        ("CRC-4/INTERLAKEN", "Crc(4, 0x3, 0xF, xorout=0xF)", 0xB),
        ("CRC-5/EPC-C1G2", "Crc(5, 0x09, 0x09)", 0x00),
        ("CRC-5/G-704", "Crc(5, 0x15, reflected=True)", 0x07),
        ("CRC-5/USB", "Crc(5, 0x05, 0x1F, reflected=True, xorout=0x1F)", 0x19),
        ("CRC-6/CDMA2000-A", "Crc(6, 0x27, 0x3F)", 0x0D),
        ("CRC-6/DARC", "Crc(6, 0x19, reflected=True)", 0x26),
        ("CRC-6/G-704", "Crc(6, 0x03, reflected=True)", 0x06),
        ("CRC-6/GSM", "Crc(6, 0x2F, xorout=0x3F)", 0x13),
        ("CRC-7/MMC", "Crc(7, 0x09)", 0x75),
        ("CRC-7/ROHC", "Crc(7, 0x4F, 0x7F, reflected=True)", 0x53),
        ("CRC-7/UMTS", "Crc(7, 0x45)", 0x61),
        ("CRC-8/DVB-S2", "Crc(8, 0xD5)", 0xBC),
        ("CRC-8/MAXIM-DOW", "Crc(8, 0x31, reflected=True)", 0xA1),
        ("CRC-8/SMBUS", "Crc(8, 0x07)", 0xF4),
        ("CRC-10/ATM", "Crc(10, 0x233)", 0x199),
        ("CRC-11/FLEXRAY", "Crc(11, 0x385, 0x01A)", 0x5A3),
        ("CRC-12/DECT", "Crc(12, 0x80F)", 0xF5B),
        ("CRC-12/UMTS", "Crc(12, 0x80F, refout=True)", 0xDAF),
        ("CRC-14/DARC", "Crc(14, 0x0805, reflected=True)", 0x082D),
        ("CRC-15/CAN", "Crc(15, 0x4599)", 0x059E),
        ("CRC-16/ARC", "Crc(16, 0x8005, reflected=True)", 0xBB3D),
        ("CRC-16/IBM-3740", "Crc(16, 0x1021, 0xFFFF)", 0x29B1),
        ("CRC-16/IBM-SDLC", "Crc(16, 0x1021, 0xFFFF, reflected=True, xorout=0xFFFF)", 0x906E),
        ("CRC-16/MODBUS", "Crc(16, 0x8005, 0xFFFF, reflected=True)", 0x4B37),
        ("CRC-16/XMODEM", "Crc(16, 0x1021)", 0x31C3),
        ("CRC-17/CAN-FD", "Crc(17, 0x1685B)", 0x04F03),
        ("CRC-24/BLE", "Crc(24, 0x00065B, 0x555555, reflected=True)", 0xC25A56),
        ("CRC-24/OPENPGP", "Crc(24, 0x864CFB, 0xB704CE)", 0x21CF02),
        ("CRC-31/PHILIPS", "Crc(31, 0x04C11DB7, 0x7FFFFFFF, xorout=0x7FFFFFFF)", 0x0CE9E46C),
        (
            "CRC-32/ISO-HDLC",
            "Crc(32, 0x04C11DB7, 0xFFFFFFFF, reflected=True, xorout=0xFFFFFFFF)",
            0xCBF43926,
        ),
        ("CRC-32/MPEG-2", "Crc(32, 0x04C11DB7, 0xFFFFFFFF)", 0x0376E6E7),
        ("Fletcher-16", "Fletcher(255)", 0x1EDE),
        ("sum", "Sum(8)", 0xDD),
        ("sum inverted", "Sum(8, complement=1)", 0x22),
        ("sum subtracted", "Sum(8, complement=2)", 0x23),
        ("sum of 16 bits", "Sum(16)", 0x01DD),
        ("sum of 16 bits subtracted", "Sum(16, complement=2)", 0xFE23),
        ("exclusive or", "Xor()", 0x31),
        ("exclusive or from 0xFF", "Xor(0xFF)", 0xCE),
    )
]
