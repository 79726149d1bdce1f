"""The state that a grammar declares: its variables, what effects change, when a device is at rest.

A state is one value: an immutable record with a field for each variable, of a class that is made
once for each declaration. Where the grammar says when a device is at rest, the record also tells
whether it is `moving`. A value that is not known is None.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, TypeAlias, TypeVar

import msgspec
from msgspec.structs import replace

from bilprov.spec.errors import Declared, WrongValue, checked, shown

Kind = Literal["word", "whole", "bits"]
_MOST = 30  # variables, and words or bits of one
NOT_KNOWN = -(1 << 62)
"""The number of a value that is not known."""

OTHERS = -1
"""Stands for the address of every device that was not addressed yet."""


class VariableSpec(msgspec.Struct, frozen=True):
    """One variable: its name and kind, and its smallest and largest value.

    A word counts as its place in `words`; `bits` names bits, most significant first. `unknown`
    tells whether an instruction can leave it not known.
    """

    name: str
    kind: Kind
    low: int
    high: int
    words: tuple[str, ...] = ()
    bits: str = ""
    unknown: bool = False

    @property
    def default(self) -> int | str:
        """The first word, or the number nearest to 0."""
        return self.words[0] if self.words else min(max(0, self.low), self.high)

    @property
    def allowed(self) -> str:
        """The values that it can have, in words."""
        return ", ".join(self.words) if self.words else f"{self.low} to {self.high}"

    def holds(self, value: object) -> bool:
        """Whether it can have this value."""
        if value is None:
            return self.unknown
        if self.words:
            return value in self.words
        return type(value) is int and self.low <= value <= self.high


@checked
def Word(*words: str) -> VariableSpec:
    """A variable that is one of some words; at first it is the first one."""
    if not 1 <= len(set(words)) == len(words) <= _MOST:
        raise WrongValue(
            f"the words of a variable are {shown(words)}, allowed are 1 to {_MOST} words, each once"
        )
    return VariableSpec("", "word", 0, len(words) - 1, words=tuple(map(str, words)))


@checked
def Whole(low: int, high: int) -> VariableSpec:
    """A variable that is a whole number in `low`..`high`."""
    if low > high:
        raise WrongValue(f"the numbers {low} to {high} hold nothing")
    return VariableSpec("", "whole", low, high)


@checked
def Bits(names: str) -> VariableSpec:
    """A variable that is some bits, named by a letter each, most significant first."""
    if not 1 <= len(set(names)) == len(names) <= _MOST:
        raise WrongValue(
            f"the bits of a variable are {shown(names)}, allowed are at most {_MOST} letters, "
            "each once"
        )
    return VariableSpec("", "bits", 0, (1 << len(names)) - 1, bits=names)


class Variables:
    """The state: a Word, Whole or Bits for each variable."""

    def __init__(self, **kinds: VariableSpec) -> None:
        if len(kinds) > _MOST:
            raise WrongValue(f"STATE has {len(kinds)} variables, allowed are {_MOST}")
        for name, kind in kinds.items():
            if name == "moving" or name.startswith("_") or name in State.__dict__:
                raise WrongValue(f"a variable is named {name}, allowed is another name")
            if not isinstance(kind, VariableSpec):
                raise WrongValue(
                    f"the variable {name} is {shown(kind)}, allowed is a Word, a Whole or Bits"
                )
        self.specs = {name: replace(kind, name=name) for name, kind in kinds.items()}
        """The variables by name."""


class Condition:
    """What the state must be: some variables with the values that they must have."""

    _decides: ClassVar[bool]  # whether one value that is as named decides, or one that is not

    def __init__(self, **values: str | int) -> None:
        if not values:
            raise WrongValue(f"{type(self).__name__} names no variable")
        self.values = {name: plain(value) for name, value in values.items()}

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and vars(self) == vars(other)

    def __hash__(self) -> int:
        return hash((type(self), *self.values.items()))

    def holds(self, state: State) -> bool:
        """Whether it holds in a state."""
        for name, value in self.values.items():  # a list would take twice as long
            same: bool = getattr(state, name) == value
            if same is self._decides:
                return same
        return not self._decides

    def follows(self, values: Mapping[str, Any]) -> bool:
        """Whether it holds wherever some variables have these values, whatever the others are."""
        missing = object()
        named = [values.get(name, missing) == value for name, value in self.values.items()]
        return any(named) if self._decides else all(named)


class AnyOf(Condition):
    """The state has one of these values at least."""

    _decides = True


class AllOf(Condition):
    """The state has all of these values."""

    _decides = False


class Changed(Declared, frozen=True):
    """The new value of a variable: its old one times `factor`, and `plus` added.

    It is held in `low`..`high`, the bounds of the variable, which the loader fills in.
    """

    factor: int = 1
    plus: int = 0
    low: int = 0
    high: int = 0

    def value(self, old: int | None) -> int | None:
        """The new value; None: not known."""
        return None if old is None else min(max(old * self.factor + self.plus, self.low), self.high)


class Unknown:
    """The new value of a variable that is not told by the instruction."""


class From(Declared, frozen=True):
    """The value of a data field, times `factor`, as the new value of a state variable.

    A Word is set to the name of the value, from an Enum whose names are words of it; the loader
    fills in these `words`, each with its value.
    """

    field: str
    factor: int = 1
    words: tuple[tuple[str, int], ...] = ()

    def value(self, number: int) -> int | str:
        """The value of the variable where the field has this number."""
        if self.words:
            return next(word for word, known in self.words if known == number)
        return number * self.factor

    def number(self, value: int | str) -> int | None:
        """The number that a field must have to set this value, None if there is none."""
        if self.words or isinstance(value, str):
            return dict(self.words).get(str(value))
        number = value // self.factor if self.factor else value
        return number if number * self.factor == value else None


Source: TypeAlias = int | str | From | Changed | None
"""What a variable is set to: a value, what it is made of, or None where it is not known."""


class Effect(msgspec.Struct, frozen=True):
    """Assignments to state variables: pairs of a variable and its Source."""

    assignments: tuple[tuple[str, Any], ...] = ()

    def apply(self, state: State, fields: Mapping[str, int] | None = None) -> State:
        """Return the state after this effect; `fields` are the instruction's values by name."""
        return after(state, assigned(self, fields or {}))

    def sets(self, variable: str) -> bool:
        """Return whether this effect assigns to the variable."""
        return any(name == variable for name, _ in self.assignments)

    @property
    def constants(self) -> dict[str, str | int]:
        """The variables that it always sets to the same value, with that value."""
        return {
            name: value
            for name, value in self.assignments
            if value is not None and not isinstance(value, From | Changed)
        }


Assigned: TypeAlias = tuple[tuple[str, Any], ...]
"""Variables with their new values, or the Changed that is applied to the old one."""


def assigned(effect: Effect, fields: Mapping[str, int]) -> Assigned:
    """The new value of each variable that the effect sets with these values of the fields."""
    return tuple(
        [  # a generator would take half as long again
            (name, value.value(fields[value.field]) if type(value) is From else value)
            for name, value in effect.assignments
        ]
    )


def value_words(value: Any) -> str:
    """A new value in words."""
    if value is None:
        return "not known"
    if not isinstance(value, Changed):
        return str(value)
    added = f" {'-' if value.plus < 0 else '+'} {abs(value.plus)}" if value.plus else ""
    return f"{times(value.factor)}old value{added} ({value.low} to {value.high})"


def times(factor: int) -> str:
    """A factor as it stands before what it multiplies: `-`, `258 x `."""
    return {1: "", -1: "-"}.get(factor, f"{factor} x ")


def after(state: State, values: Assigned) -> State:
    """The state with these new values; the same object where they change nothing."""
    new: dict[str, Any] = {}
    for name, value in values:
        old = getattr(state, name)
        found = value.value(old) if type(value) is Changed else value
        if found != old:
            new[name] = found
    if not new:
        return state
    found = replace(state, **new)
    at_rest = state.at_rest
    if at_rest is not None and at_rest.holds(found) is found.moving:
        found = replace(found, moving=not found.moving)
    return found


class State(msgspec.Struct, frozen=True, gc=False):
    """The values of the variables of a grammar; `state_class` makes the class that has them."""

    made_of: ClassVar[tuple[Any, ...]] = ()
    variables: ClassVar[tuple[str, ...]] = ()
    words: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    signed: ClassVar[frozenset[str]] = frozenset()
    at_rest: ClassVar[Condition | None] = None
    wheels: ClassVar[Any] = None  # what a car declares, of class Wheels
    moving: ClassVar[bool] = False  # a field, where the grammar says when the device is at rest

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """The state with these values, of all variables."""
        if cls.at_rest is None:
            return cls(**values)
        still = cls(**values, moving=False)
        return still if cls.at_rest.holds(still) else replace(still, moving=True)

    def but(self, **values: Any) -> Self:
        """The same state with other values of some variables."""
        new = tuple((name, plain(value)) for name, value in values.items())
        return after(self, new)  # type: ignore[return-value]

    @classmethod
    def code(cls, variable: str, value: str | int | None) -> int:
        """A variable's value as a number, as columns have it: a word is its place."""
        if value is None:
            return NOT_KNOWN
        return cls.words[variable].index(value) if isinstance(value, str) else value

    @classmethod
    def value(cls, variable: str, code: int) -> str | int | None:
        """The value of a variable with this number."""
        if code == NOT_KNOWN:
            return None
        return cls.words[variable][code] if variable in cls.words else code

    @property
    def described(self) -> str:
        """The values in words, like `fan low level -2`.

        A car's motion stands without its name, and its steering only where it is not 0: `forward
        speed 255 steering +64 led 5`.
        """
        words, car = [], self.wheels
        for name in self.variables:
            value = getattr(self, name)
            shown = f"{value:+d}" if value and name in self.signed else str(value)
            if value is None:
                words.append(f"{name} not known")
            elif car and name == car.by:
                words.append(shown)
            elif value or not car or name != car.steering:
                words.append(f"{name} {shown}")
        return " ".join(words)

    @property
    def codes(self) -> tuple[int, ...]:
        """The values of all variables as numbers."""
        return tuple(self.code(name, getattr(self, name)) for name in self.variables)

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (self.made_of, msgspec.structs.astuple(self))


def _restored(made_of: tuple[Any, ...], values: tuple[Any, ...]) -> State:
    return _class(*made_of)(*values)


def state_class(
    variables: Iterable[VariableSpec], at_rest: Condition | None, wheels: Any = None
) -> type[State]:
    """The class of the states with these variables; with `at_rest` they also have `moving`.

    Grammars that differ only in the ranges of their variables have the same one.
    """
    alike = [replace(v, kind="whole", low=-(v.low < 0), high=0, bits="") for v in variables]
    if wheels:
        (words,) = (spec.words for spec in alike if spec.name == wheels.by)
        wheels = replace(wheels, still=next(word for word in words if word not in wheels.turns))
    return _class(tuple(alike), at_rest, wheels)


@lru_cache(maxsize=64)
def _class(
    variables: tuple[VariableSpec, ...], at_rest: Condition | None, wheels: Any
) -> type[State]:
    kinds: list[tuple[str, Any]] = []
    for spec in variables:
        kind = str if spec.words else int
        kinds.append((spec.name, kind | None if spec.unknown else kind))
    if at_rest is not None:
        kinds.append(("moving", bool))
    what = "The state" if at_rest is None else "The motion state"
    made: Any = msgspec.defstruct(
        "State",
        kinds,
        bases=(State,),
        namespace={
            "__doc__": f"{what} that the instructions so far predict (topic `/state`).",
            "made_of": (variables, at_rest, wheels),
            "variables": tuple(spec.name for spec in variables),
            "words": {spec.name: spec.words for spec in variables if spec.words},
            "signed": frozenset(spec.name for spec in variables if spec.low < 0),
            "at_rest": at_rest,
            "wheels": wheels,
        },
        frozen=True,
        gc=False,
    )
    found: type[State] = made
    return found


def plain(value: Any) -> Any:
    """A word as a plain text: a grammar may use an enumeration's."""
    return str(value) if isinstance(value, str) else value


Request: TypeAlias = tuple[str, dict[str, Any]]
"""An instruction's name, and its fields."""

Sent = TypeVar("Sent")

Step: TypeAlias = tuple[Sent, frozenset[str], frozenset[str]]
"""What is sent, with the variables that are right after it, and those that are wrong."""


def ways_on(
    right: frozenset[str], steps: Sequence[Step[Sent]]
) -> Iterator[tuple[frozenset[str], tuple[Sent, ...]]]:
    """Yield which variables can be right after some steps, each with the fewest: from these on.

    Of equally few steps those come first that stand first.
    """
    paths: dict[frozenset[str], tuple[Sent, ...]] = {right: ()}
    ahead = deque(paths)
    while ahead:
        right = ahead.popleft()
        yield right, paths[right]
        for sent, sets, spoils in steps:
            reached = (right - spoils) | sets
            if reached not in paths:
                paths[reached] = (*paths[right], sent)
                ahead.append(reached)
