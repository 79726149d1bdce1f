"""`bilprov lab learn`: learns a device as a Mealy machine, draws it, and shows where it differs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import click
import msgspec

from bilprov.analyzer.cli.command import command, family_protocol, group, option
from bilprov.analyzer.cli.command_files import STANDARD_OUTPUT, require_writable
from bilprov.analyzer.cli.options import note
from bilprov.analyzer.cli.streams import promise_verdict
from bilprov.captures.text import quantity
from bilprov.conformance.cli.options import seed_option
from bilprov.conformance.cli.outputs import write_each
from bilprov.conformance.cli.robot import RobotOptions
from bilprov.conformance.dut.target import Target
from bilprov.conformance.learning.drawing import dot_text, has_graphviz, svg_text
from bilprov.conformance.oracle.profile import verdict_of
from bilprov.spec.by_effect import all_movement

if TYPE_CHECKING:
    from bilprov.conformance.learning.learner import Learned

_SHOWN = 5  # differences told on the screen


class LearnOptions(msgspec.Struct, frozen=True):
    """The options of `lab learn`."""

    robot: RobotOptions = group(RobotOptions)
    dot: str | None = option(
        "-o", "--dot", metavar="FILE", help="The same in DOT; - is standard output."
    )
    svg: str | None = option(
        metavar="FILE",
        help="The machine as a picture of its kinds of motion, drawn by Graphviz.",
    )
    seed: int = seed_option(help="Seed of the random sequences.")

    @property
    def files(self) -> list[tuple[str, str]]:
        """The options that name files, and their paths."""
        named = {"--dot": self.dot, "--svg": self.svg}
        return [(name, path) for name, path in named.items() if path is not None]


@command(LearnOptions)
def learn(options: LearnOptions) -> int:
    """Examples:
      bilprov lab learn sim --svg machine.svg
      bilprov lab learn /dev/ttyUSB0 --probe tcp:127.0.0.1:7001

    The machine is compared with that of the Protocol. Every instruction with representative data
    and every kind of fault is sent in every state that the device shows, by its answers and what
    the probe sees. Before each sequence the line is homed and the settings are brought to rest; an
    unexpected answer is tried again. Where the machines differ, the shortest sequences are printed
    as `bilprov send` lines.

    Exit code: 0 the same machine, 1 another one, 2 the port or the probe cannot be used, 3 it could
    not be learned, or no probe sees the robot.
    """
    from bilprov.conformance.learning.learner import learn_target, require_aalpy

    protocol = family_protocol("lab learn")
    require_aalpy()
    robot, name, settings = options.robot.fitting(protocol)
    promise_verdict()
    require_writable(options.files)
    if options.svg is not None and not has_graphviz():
        raise click.UsageError("--svg needs Graphviz (apt-get install graphviz); --dot does not")
    from bilprov.conformance.cli.progress import bar

    def agreed(target: Target) -> Target:
        if target.environment.observability.costly:
            raise click.UsageError(
                f"--probe {robot.probe} allows only a few observations, and learning makes one "
                "after each frame: use tcp:HOST:PORT or modem:LINE"
            )
        if target.moves:
            robot.confirm(protocol, "some minutes", all_movement(protocol))
        return target

    with robot.driven(protocol, name, settings, agreed) as (target, _), bar() as shown:
        task = shown.add_task("", total=None)

        def progress(frames: int) -> None:
            shown.update(task, completed=frames, description="frames")

        learned = learn_target(target, seed=options.seed, progress=progress)
    _write(learned, options)
    onto_stdout = any(path == STANDARD_OUTPUT for _, path in options.files)
    for line in _told(learned):
        click.echo(line, err=onto_stdout)
    return learned.exit


def _write(learned: Learned, options: LearnOptions) -> None:
    """Write the files that were asked for; a picture needs a machine."""
    machine = learned.machine
    if machine is None:
        note("nothing is drawn: the machine was not learned" * bool(options.files))
        return
    ends = [(machine.after(one.word[:-1]), one.word[-1]) for one in learned.differences]
    drawn = dot_text(learned.protocol, machine, learned.names, learned.report.device, ends)
    texts = {"--dot": drawn, "--svg": svg_text(drawn) if options.svg else ""}
    write_each((path, texts[name]) for name, path in options.files)


def _told(learned: Learned) -> Iterator[str]:
    """What came of it, in lines for a person."""
    if learned.machine is not None:
        states = quantity(len(learned.machine), "state")
        inputs = quantity(len(learned.steps), "input")
        yield f"learned {states} over {inputs}, from {quantity(learned.sent.frames, 'frame')}"
        looks = ", ".join(learned.seen) or "nothing of the robot: no probe"
        yield f"seen beside the answers: {looks}"
    for point, word in sorted(learned.report.profile.other_readings.items()):
        label = verdict_of(point, word).label
        yield f"another reading, taken into account: {point} = {word} ({label})"
    for case, reason in learned.beside:
        yield f"failed beside it: {case}: {reason}"
    protocol = learned.protocol
    for number, one in enumerate(learned.differences[:_SHOWN], 1):
        names = [learned.names[letter] for letter in one.word]
        after = f" after {', '.join(names[:-1])}" if names[:-1] else ""
        step = learned.steps[one.word[-1]]
        reading = "" if one.actual.codes == one.expected.codes else step.point or step.reading
        about = f" [{reading}]" if reading else ""
        yield f"{number}. {names[-1]}{after}{about}"
        yield f"     due: {one.expected.words(protocol)}"
        yield f"     got: {one.actual.words(protocol)}"
        yield f"     {learned.send_line(one)}"
    if len(learned.differences) > _SHOWN:
        yield "and more"
    yield _conclusion(learned)


def _conclusion(learned: Learned) -> str:
    if learned.trouble:
        begun = "it differs, and " if learned.differences else ""
        return f"{begun}it was not learned to the end: {learned.trouble}"
    if learned.differences:
        return "not the Protocol's machine"
    if learned.beside:
        return "the Protocol's machine, but it does not conform: run bilprov conform"
    if learned.sent.flaky:
        times = quantity(learned.sent.flaky, "outcome")
        why = "the device does not always do the same" if learned.lossless else "noise, or a rhythm"
        return f"the Protocol's machine, but {times} came once and not again: {why}"
    if not learned.seen:
        return "by its answers the Protocol's machine; whether it stops was not seen, see --probe"
    return "the Protocol's machine"
