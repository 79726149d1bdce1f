"""Random filter expressions for Hypothesis, built from the names and values of a protocol."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from hypothesis import strategies as st

from bilprov.analyzer.filters.fields import Field, Kind, fields_of
from bilprov.spec.protocol import Protocol

Draw: TypeAlias = Callable[[st.SearchStrategy[Any]], Any]

_ORDER = ("==", "!=", "<", "<=", ">", ">=")
_OCTETS = ("00", "11", "ff", "0a 0b", "21 21", "81 09", "'20'", "00 00 00")
_TIMES = ("0", "1ms", "0.5 ms", "20us", "100ms", "1.5s", "-1", "0.001", "3s", "59s", "1e-9", "700")
_CLOCKS = ("00:00", "13:46:40", "13:46:41.5", "13:47", "14:00", "23:59:59.999999999")
_DATES = ("2026-09-21", "2026-09-21 13:46:41", "2026-09-21T13:47:00.25Z", "2026-09-22 00:00")
_TEXTS = ("'LED'", "ms", "'header'", "byte", '"a"', "'no such'")
_NUMBERS = (0, 1, 2, 4, 64, 127, 200, 255)


@st.composite
def expressions(draw: Draw, protocol: Protocol) -> str:
    """Filters that compile: comparisons of all kinds, joined."""
    fields = list(dict.fromkeys(fields_of(protocol)))
    text = ""
    for _ in range(draw(st.integers(1, 4))):
        field = fields_of(protocol)[draw(st.sampled_from(fields))]
        condition = _Writer(draw, list(fields_of(protocol).values())).condition(field)
        condition = draw(st.sampled_from(["{}", "{}", "not {}", "!({})"])).format(condition)
        join = draw(st.sampled_from(["{} and {}", "({}) or {}", "({}) && ({})", "{} || {}"]))
        text = join.format(text, condition) if text else condition
    return text


class _Writer:
    """Writes conditions about fields, with values that they can have."""

    def __init__(self, draw: Draw, fields: Sequence[Field]) -> None:
        self._draw = draw
        self._fields = fields

    def _one(self, *of: str) -> str:
        chosen: str = self._draw(st.sampled_from(of))
        return chosen

    def condition(self, field: Field) -> str:
        """A condition that asks for the field."""
        name = self._one(field.name, field.name.upper())
        write = {
            Kind.NUMBER: self._number,
            Kind.SECONDS: self._seconds,
            Kind.CLOCK: self._clock,
            Kind.WORD: self._word,
            Kind.WORDS: self._words,
            Kind.TEXT: self._text,
            Kind.TRUTH: self._truth,
            Kind.BYTES: self._bytes,
        }
        return write[field.kind](name, field)

    def _others(self, field: Field) -> list[str]:
        """Other fields with which it can be compared."""
        return [
            other.name
            for other in self._fields
            if other.kind is field.kind
            and other.key != field.key
            and (not field.words or not other.words or other.words == field.words)
        ]

    def _set(self, value: Callable[[], str]) -> str:
        values = ", ".join(value() for _ in range(self._draw(st.integers(1, 3))))
        return self._one("({},)", "{{{}}}", "[{}]").format(values)

    def _infix(self, name: str, signs: Sequence[str], value: str) -> str:
        return f"{name} {self._one(*signs)} {value}"

    def _among(self, name: str, values: str) -> str:
        return self._infix(name, ("in", "not in"), values)

    def _value(self, field: Field) -> str:
        """A value strictly between the field's ends, or the name of one."""
        number = self._inside(field)
        named = [repr(word) for word, value in field.words.items() if value == number]
        return self._one(str(number), hex(number), *named)

    def _inside(self, field: Field) -> int:
        low = -1 if field.low is None else field.low
        high = 300 if field.high is None else field.high
        inside = [number for number in (*_NUMBERS, low + 1, high - 1) if low < number < high]
        number: int = self._draw(st.sampled_from(inside))
        return number

    def _range(self, field: Field) -> str:
        return "..".join(map(str, sorted(self._inside(field) for _ in range(2))))

    def _named(self, field: Field) -> str:
        return repr(self._one(*field.words)) if field.words else ""

    def _number(self, name: str, field: Field) -> str:
        other = self._one(*self._others(field))
        value = self._value(field)
        bit = "1" if (field.low or 0) < 0 else str(1 << ((field.high or 8).bit_length() - 1))
        half = f"{self._inside(field)}.5"
        return self._one(
            self._infix(name, _ORDER, value),
            self._infix(value, _ORDER, name),
            self._infix(name, _ORDER, other),
            self._infix(name, ("<", "<=", ">", ">="), half),
            self._among(name, self._set(lambda: self._value(field))),
            self._among(name, self._set(lambda: self._one(other, self._range(field)))),
            self._among(name, self._range(field)),
            f"{name} & {bit}",
            f"{name} & {bit} == {bit}",
            f"{name} & {other} > 2",
        )

    def _seconds(self, name: str, field: Field) -> str:
        time = self._one(*_TIMES)
        return self._one(
            self._infix(name, _ORDER, time),
            self._infix(time, _ORDER, name),
            self._among(name, self._set(lambda: self._one("1ms..2s", *_TIMES))),
            self._among(name, "0.5ms..100ms"),
            self._infix(name, _ORDER, self._one(*self._others(field))),
        )

    def _clock(self, name: str, field: Field) -> str:
        moment = self._one(*_CLOCKS, *_DATES)
        over = f"{self._one(*_CLOCKS)}..{self._one(*_CLOCKS)}"
        return self._one(
            self._infix(name, ("<", "<=", ">", ">="), moment),
            self._infix(moment, ("<", "<=", ">", ">="), name),
            self._among(name, over),
            self._among(name, f"{{{over}, 13:46..13:47}}"),
            self._among(name, f"{_DATES[1]}..{_DATES[2]}"),
        )

    def _word(self, name: str, field: Field) -> str:
        part = self._one(*field.words)[:3].strip()
        return self._one(
            self._infix(name, ("==", "!="), self._named(field)),
            self._infix(self._named(field), ("==", "!="), name),
            self._among(name, self._set(lambda: self._named(field))),
            self._infix(name, ("contains", "not contains"), repr(part)),
        )

    def _words(self, name: str, field: Field) -> str:
        return self._one(
            self._infix(name, ("contains", "not contains"), self._named(field)),
            self._among(self._named(field), name),
            self._infix(name, ("==", "!="), self._set(lambda: self._named(field))),
            self._infix(name, ("==", "!="), self._named(field)),
        )

    def _text(self, name: str, field: Field) -> str:
        text = self._one(*_TEXTS)
        return self._one(
            self._infix(name, ("contains", "not contains"), text),
            self._among(repr("byte"), name),
            self._among(name, self._set(lambda: self._one("''", *_TEXTS))),
            self._infix(name, ("==", "!="), "''"),
        )

    def _truth(self, name: str, field: Field) -> str:
        return self._one(
            name,
            self._infix(name, ("==", "!="), self._named(field)),
            self._infix(name, ("==", "!="), self._one(*self._others(field))),
        )

    def _bytes(self, name: str, field: Field) -> str:
        item = f"{name}[{self._one('0', '1', '2')}]"
        return self._one(
            self._infix(name, ("contains", "not contains"), self._one(*_OCTETS)),
            self._infix(name, ("==", "!="), self._one("''", *_OCTETS)),
            self._among(name, self._set(lambda: self._one(*_OCTETS))),
            self._infix(item, _ORDER, self._one("0x21", "0x80", "9")),
            self._among(item, "0x20..0x80"),
            f"{item} & {self._one('1', '0x80')}",
        )
