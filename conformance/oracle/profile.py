"""The profile of a device under test: its measured times, and its choices at open points.

As a TOML file it can be given to a run: it replaces that run's measurements, and the device must
keep to it. Also: the timers of a run, how long it waits by default and in an environment.
"""

from __future__ import annotations

import statistics
from collections import defaultdict, deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Annotated

import msgspec

from bilprov.analyzer.client.operations import Received
from bilprov.analyzer.files import from_toml
from bilprov.captures.schemas import MS
from bilprov.conformance.dut.target import Environment
from bilprov.conformance.oracle.verdicts import LABELS, Verdict
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import POINTS, READINGS

# -- the choices of one device at the open points, and those that are allowed ---------------------
# A device that shows another choice than the default everywhere gets the verdict of the point's
# reading (`spec.readings`), one that shows two choices fails.


_VERDICTS = {reading.id: LABELS.get(reading.verdict, Verdict.FAIL) for reading in READINGS}


def default_of(point: str) -> str:
    """The kit's own choice of a point, "" for a point that this version does not know."""
    return POINTS[point].default if point in POINTS else ""


@dataclass
class Choices:
    """The choices of one device: for each open point its word, and the case that showed it.

    A point that was never shown counts as the default. `allowed` are the options that were given
    (`led-upper` -> `ignore`), `led_id` the ID that the device uses for the LED where it is not the
    document's. `others` are the points at which the device has chosen otherwise than the kit,
    `hidden` those at which the probe did not show its choice.
    """

    shown: dict[str, tuple[str, str]] = field(default_factory=dict)
    allowed: dict[str, str] = field(default_factory=dict)
    led_id: int | None = None
    others: set[str] = field(default_factory=set)
    hidden: set[str] = field(default_factory=set)

    def word(self, point: str) -> str:
        """The device's choice of a point."""
        return self.shown[point][0] if point in self.shown else POINTS[point].default

    def differs(self, point: str) -> bool:
        """Whether the device was seen to choose otherwise than the kit does."""
        return bool(self.others) and point in self.others

    def unknown(self, point: str) -> bool:
        """Whether the device may choose either way at this point: the probe did not show it."""
        return point in self.hidden and point not in self.shown

    def record(self, point: str, word: str, case: str) -> str:
        """Record that the device showed `word` in `case`.

        The first choice of a point is kept. Returns a sentence if `word` contradicts it, else "".
        """
        before, where = self.shown.setdefault(point, (word, case))
        if before != POINTS[point].default:
            self.others.add(point)
        if before == word:
            return ""
        reading = POINTS[point].reading
        return f"{reading}: {word} here, {before} in {where}; a device keeps to one choice"

    def but(self, point: str, word: str) -> Choices:
        """These choices, but `word` at `point`."""
        default = word == POINTS[point].default
        others = self.others - {point} if default else self.others | {point}
        return replace(self, shown=self.shown | {point: (word, "")}, others=others)

    def verdict(self, point: str) -> Verdict:
        """The verdict of the device's choice of a point."""
        return verdict_of(point, self.word(point))


def verdict_of(point: str, word: str) -> Verdict:
    """The verdict of a device that always makes this choice."""
    if word == POINTS[point].default:
        return Verdict.PASS
    return _VERDICTS[POINTS[point].reading]


_OPTIONS = (
    option.partition("=")
    for point in POINTS.values()
    for option in (*(choice.option for choice in point.choices), point.skipped)
)
_ALLOWED = {name: value for name, _, value in _OPTIONS if name}


def parse_allowed(protocol: Protocol, texts: Iterable[str]) -> dict[str, str]:
    """The values of `--allow NAME=VALUE`, by name. Raises ValueError, in one sentence."""
    found: dict[str, str] = {}
    for text in texts:
        name, _, value = text.partition("=")
        wanted = _ALLOWED.get(name, "")
        numbers = [str(i) for i in protocol.unused_ids]
        fits = {
            "ID": value in numbers,
            "VERSION": bool(value) and value != protocol.version,
            "": False,
        }.get(wanted, value == wanted)
        if not fits:
            raise ValueError(f"{text!r} cannot be allowed; there are {allowed_words(protocol)}")
        found[name] = value
    return found


def allowed_words(protocol: Protocol) -> str:
    """The values that `--allow` takes, in words."""
    examples = {"ID": str(next(iter(protocol.unused_ids), 0)), "VERSION": "1.0"}
    words = [f"{name}={examples.get(value, value)}" for name, value in _ALLOWED.items()]
    return ", ".join(words)


_TIMES = {
    "truncation_timeout_ms": "truncation_timeout",
    "stop_latency_ms": "stop_latency",
    "watchdog_ms": "watchdog",
    "flushes_for_ms": "flushes_for",
}
_MEASURED = (*_TIMES.values(), "round_trip", "jitter", "boot")
_FLAGS = {
    "truncated_frames_answered": "truncation_answered",
    "flushes": "flushes",
    "whole_frame": "whole_frame",
}


_LONGEST = 60_000  # ms of a time in a file
Milliseconds = Annotated[float, msgspec.Meta(ge=-1e12, le=1e12)]

_RECENT = 100  # answers to an instruction that tell how far its answers vary
_FEWEST = 10  # that tell it


def _recent() -> defaultdict[bytes, deque[int]]:
    return defaultdict(lambda: deque(maxlen=_RECENT))


@dataclass
class Profile:
    """What was measured on the device; times in ns, None where it was not.

    `flushes` is true for a device that discards what follows a fault until the line is idle,
    `flushes_for` is how long it must be idle where the truncation time-out is not enough.
    `keeps_waiting` is true for one that never gives up a frame that was cut short.
    `whole_frame` is true for one whose time-out counts over the whole frame. `stop_latency` is how
    late it was seen to stop, `watchdog` the silence after which it stopped by itself, `boot` the
    time to the first answer; `one_by_one` is true where instructions that are sent ahead are lost.
    `slowest` is the longest time to an answer, `delays` the three longest, `delays_by_frame` those
    of the last answers to each instruction that set a robot up, on a real line, and `spreads` how
    far these vary.
    `moves` are the kinds of motion in which it was seen moving, `facets` what of the state the
    probe told each time, `graded` whether its wheels showed several speeds, `preamble_speed` the
    speed at which most faults are tried.
    `round_trip` and `jitter` are the line's and the device's together, `pace` is how long an
    instruction that was sent ahead takes. `choices` are those that the
    device has shown where the document is silent.
    """

    truncation_timeout: int | None = None
    truncation_answered: bool | None = None
    keeps_waiting: bool = False
    latencies: list[int] = field(default_factory=list)
    slowest: int = 0
    delays: list[int] = field(default_factory=list)
    delays_by_frame: defaultdict[bytes, deque[int]] = field(default_factory=_recent)
    spreads: dict[bytes, int] = field(default_factory=dict)
    flushes: bool = False
    flushes_for: int | None = None
    whole_frame: bool = False
    watchdog: int | None = None
    round_trip: int | None = None
    jitter: int | None = None
    pace: int = 0
    boot: int | None = None
    stop_latency: int = 0
    one_by_one: bool = False
    moves: set[str] | None = None
    facets: frozenset[str] = frozenset()
    graded: bool = False
    preamble_speed: int | None = None
    choices: Choices = field(default_factory=Choices)

    @property
    def all_but_two(self) -> int:
        """Within what time (ns) all answers came but two, which a busy host may have taken late."""
        return self.delays[2] if len(self.delays) > 2 else 0

    @property
    def unsteadiness(self) -> int:
        """By how much (ns) the line delays one byte more than another, for nine bytes in ten or so.

        It is how far the answers to one and the same frame vary, without the tenth that came first
        and the tenth that came last: a busy host is late now and then, a line that jitters always.
        """
        return max(self.spreads.values(), default=0)

    def set_up(self, frame: bytes, delay: int) -> None:
        """Note how late (ns) the answer to an instruction that set a robot up came."""
        delays = self.delays_by_frame[frame]
        delays.append(delay)
        if len(delays) >= _FEWEST:
            told, tenth = sorted(delays), len(delays) // 10
            self.spreads[frame] = told[-1 - tenth] - told[tenth]

    def delayed(self, delay: int) -> None:
        """Note how late (ns) an answer came."""
        self.slowest = max(self.slowest, delay)
        self.delays = sorted((*self.delays, delay), reverse=True)[:3]

    def measured(self, heard: Received, sent: int) -> None:
        """Add the latency of the first answer, if any, to a frame that had gone at `sent` (ns)."""
        for t, _ in heard.answers[:1]:
            if t >= sent:  # else it came by itself
                self.latencies.append(t - sent)
                self.delayed(t - sent)

    def figures(self) -> Figures:
        """The profile as a report has it."""
        times = [latency / MS for latency in self.latencies]
        return Figures(
            **{f"{name}_ms": _ms(getattr(self, name)) for name in _MEASURED},
            truncated_frames_answered=self.truncation_answered,
            latency_median_ms=round(statistics.median(times), 3) if times else None,
            latency_max_ms=round(max(times), 3) if times else None,
            flushes=self.flushes,
            whole_frame=self.whole_frame,
            led_id=self.choices.led_id,
            facets=tuple(sorted(self.facets)),
            preamble_speed=self.preamble_speed,
            all_but_two_answers_ms=_ms(self.all_but_two),
            readings={point: word for point, (word, _) in sorted(self.choices.shown.items())},
        )


def _ms(time: int | None) -> float | None:
    return None if time is None else round(time / MS, 3)


class Figures(msgspec.Struct, frozen=True, kw_only=True):
    """The profile in a report: times in ms, null where something was not measured.

    A key is missing in a report of an older kit, which did not measure it. `readings` has the
    device's choice for each open point that it has shown.
    """

    truncation_timeout_ms: Annotated[float, msgspec.Meta(ge=0, le=1e6)] | None = None
    truncated_frames_answered: bool | None = None
    latency_median_ms: Milliseconds | None = None
    latency_max_ms: Milliseconds | None = None
    round_trip_ms: Milliseconds | None = None
    jitter_ms: Milliseconds | None = None
    boot_ms: Milliseconds | None = None
    flushes: bool | None = None
    flushes_for_ms: Milliseconds | None = None
    whole_frame: bool | None = None
    led_id: int | None = None
    stop_latency_ms: Milliseconds | None = None
    watchdog_ms: Milliseconds | None = None
    facets: tuple[str, ...] | None = None
    preamble_speed: int | None = None
    all_but_two_answers_ms: Milliseconds | None = None
    readings: dict[str, str] | None = None

    @property
    def other_readings(self) -> dict[str, str]:
        """The choices that are not the kit's own, by open point."""
        shown = (self.readings or {}).items()
        return {point: word for point, word in shown if word != default_of(point)}

    def toml(self, protocol: Protocol) -> str:
        """The text of the file that can be given to a run."""
        told = msgspec.structs.asdict(self)
        lines = [
            "# A device's profile; give it to conform with --profile.",
            f'grammar = "{protocol.name} {protocol.version}"',
            f'sha256 = "{protocol.sha256}"',
        ]
        lines += [f"{name} = {told[name]}" for name in _TIMES if told[name]]
        flags = ((name, told[name]) for name in _FLAGS)
        lines += [f"{name} = {str(flag).lower()}" for name, flag in flags if flag is not None]
        if self.led_id is not None:
            lines.append(f"led_id = {self.led_id}")
        lines += ["", "[readings]"]
        lines += [f'"{point}" = "{word}"' for point, word in (self.readings or {}).items()]
        return "\n".join(lines) + "\n"


def profile_from(protocol: Protocol, text: str, allowed: dict[str, str]) -> Profile:
    """The profile that a text holds. Raises ValueError, in one sentence, for one that does not fit.

    `allowed` are the options of the run: a choice that needs one is refused without it.
    """
    try:
        told = from_toml(text)
    except ValueError as error:
        raise ValueError(f"it is not TOML ({error}); give a file that conform wrote") from error
    if told.get("sha256") != protocol.sha256:
        raise ValueError("it was made with another grammar; leave it out and make a new one")
    try:
        given = msgspec.convert(told, Figures)
    except msgspec.ValidationError as error:
        raise ValueError(f"{error}; give a file that conform wrote") from error
    profile = Profile(choices=Choices(allowed=allowed))
    for point, word in (given.readings or {}).items():
        choice = POINTS[point].choice(word) if point in POINTS else None
        if choice is None:
            raise ValueError(f"{point} = {word!r} is not a choice that this version knows")
        if choice.option and choice.option.partition("=")[0] not in allowed:
            raise ValueError(f"{point} = {word!r} has to be allowed: see --allow")
        profile.choices.record(point, word, "--profile")
    for key, name in _TIMES.items():
        time = getattr(given, key)
        if time is not None and not 0 < time <= _LONGEST:
            raise ValueError(f"{key} = {time!r} is not a time; allowed are 0 to {_LONGEST} ms")
        if time is not None:
            setattr(profile, name, int(time * MS))
    for key, name in _FLAGS.items():
        if getattr(given, key) is not None:
            setattr(profile, name, getattr(given, key))
    if given.led_id not in (None, *protocol.unused_ids):
        raise ValueError(f"led_id = {given.led_id!r} is not an unused ID")
    profile.choices.led_id = given.led_id
    return profile


# How much later than an answer a stop may be seen on a real line although it was in time: link and
# probe are two lines, and a busy machine is late itself.
_GRACE = 20 * MS
_WAITING_BUDGET = 90_000 * MS
_RUN_BUDGET = 300_000 * MS


@dataclass(frozen=True, slots=True)
class Timers:
    """How long the runner waits, in ns.

    `deadline` is when an answer is due: a later one is slow. `longest` is when a missing answer is
    given up: a later one fails. `silence` is kept after an answer before the next step, `hold`
    while a thorough case watches the stop. `grace` is how much later than the answer a stop may be
    seen although it was in time (the link's own jitter), `settle` the time for what may still be
    under way, `boot` that for the first answer, `idle` how long a moving robot is sent nothing, and
    one that a fault has stopped; `never` when a truncated frame counts as never answered.
    `waiting_budget` bounds the time spent waiting for missing answers in all, `run_budget` that of
    all cases on a slow device; None means no bound.
    """

    deadline: int = 100 * MS
    longest: int = 1000 * MS
    silence: int = 20 * MS
    hold: int = 250 * MS
    grace: int = 0
    settle: int = MS
    boot: int = 10_000 * MS
    never: int = 2500 * MS
    idle: int = 1200 * MS
    waiting_budget: int | None = None
    run_budget: int | None = None

    def due_within(self, deadline: int) -> Timers:
        """These timers with another deadline (ns) for an answer; `longest` is at least as long."""
        return replace(self, deadline=deadline, longest=max(self.longest, deadline))


def timers_of(environment: Environment, protocol: Protocol) -> Timers:
    """The default timers of a run in this environment, to which the options are then applied."""
    # Answers later than allowed must still be received, to be judged.
    longest = int(protocol.timing.answer_longest * MS)
    if environment.virtual:
        return Timers(longest=longest)
    return Timers(
        longest=longest,
        grace=_GRACE,
        settle=2 * MS,
        waiting_budget=_WAITING_BUDGET,
        run_budget=_RUN_BUDGET,
    )
