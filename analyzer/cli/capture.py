"""`bilprov capture`: what a capture holds, parts of it, several together, two side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click
import msgspec

from bilprov.analyzer.cli import command_files
from bilprov.analyzer.cli import options as shared
from bilprov.analyzer.cli.command import (
    PATH,
    argument,
    command,
    flag,
    group,
    option,
    protocol_in_use,
)
from bilprov.captures.text import printable, quantity

if TYPE_CHECKING:
    from bilprov.analyzer.edit.cut import Copy
    from bilprov.captures.reader import Capture
    from bilprov.spec.protocol import Protocol


class InfoOptions(msgspec.Struct, frozen=True):
    """The options of `capture info`."""

    file: str = argument(metavar="FILE.mcap")
    style: str = shared.text_format_option()
    as_json: bool = flag("The same as --format json.", "--json")


@command(InfoOptions)
def info(options: InfoOptions) -> None:
    """Examples:
      bilprov capture info drive.mcap

    Shows when and where it was recorded, and whether it is complete. The keys of the JSON are
    explained in analyzer/output/capture_info.py.
    """
    from bilprov.analyzer.output.capture_info import drawn, summarized
    from bilprov.analyzer.output.console import show_as
    from bilprov.captures.reader import open_capture

    capture = open_capture(options.file)
    summary = summarized(capture, protocol_in_use())
    style, carried = "json" if options.as_json else options.style, bool(capture.grammar_text)
    show_as(style, lambda: summary, lambda: drawn(summary, carried=carried))


class CheckOptions(msgspec.Struct, frozen=True):
    """The options of `capture check`."""

    path: Path = argument(metavar="FILE.mcap", type=PATH)
    style: str = shared.text_format_option()


@command(CheckOptions)
def check(options: CheckOptions) -> int:
    """Examples:
      bilprov capture check drive.mcap

    What is lost is given in bytes and seconds. Exit code: 0 nothing is lost, 2 something is.
    """
    from bilprov.analyzer.cli.ports import Findings
    from bilprov.analyzer.doctor.finding import of_capture

    findings = Findings(as_json=options.style == "json")
    findings.show(str(options.path), of_capture(options.path))
    return findings.end([str(options.path)])


class CutOptions(msgspec.Struct, frozen=True):
    """The options of `capture cut`."""

    path: Path = argument(metavar="IN.mcap", type=PATH)
    new: Path = argument(metavar="OUT.mcap", type=PATH)
    span: shared.WindowOptions = group(shared.WindowOptions)
    expression: str | None = shared.filter_option()
    force: bool = command_files.force_option()


@command(CutOptions)
def cut(options: CutOptions) -> None:
    """Examples:
      bilprov capture cut drive.mcap part.mcap --start 12 --end 20
      bilprov capture cut drive.mcap faults.mcap --filter faulty

    OUT holds the raw bytes and line events between --start and --end as they are, and what a
    conformance run noted there. A checkpoint at its beginning keeps the predicted state, the
    numbers of the instructions and the answers that are due, so that OUT is decoded as IN is; times
    stay those of IN.

    With --filter it holds the reads of the frames for which EXPR holds, each instruction with its
    answer, and the few frames that came in the same reads. Where others are left out, a gap records
    how many bytes, and a checkpoint how decoding continues.

    Decoded topics are left out: bilprov capture decode writes them. Ctrl-C leaves no OUT.
    """
    from bilprov.analyzer.edit.cut import cut_metadata, write_selected, write_window
    from bilprov.analyzer.replay.capture_decoding import opened_at, require_begun, said_about
    from bilprov.captures.reader import open_quickly

    window = options.span.window()
    if not window.bounded and options.expression is None:
        raise click.UsageError("name what OUT is to hold: --start, --end, --filter or some of them")
    found = open_quickly(options.path)
    protocol = command_files.protocol_of(found, copied=True)
    test = shared.compiled(options.expression, protocol)
    opened = opened_at(found, protocol, window.first or 0)
    capture = opened.capture
    require_begun(capture, window.first)
    shared.note(*said_about(capture, protocol))
    metadata = cut_metadata(capture, protocol, window, options.expression)
    times = 1 if test is None else 2
    with _copying(options, [capture], metadata, protocol, times=times) as copy:
        if test is None:
            write_window(opened, window, copy)
        else:
            held = test.started(capture.start)
            write_selected(lambda t: opened_at(found, protocol, t), window, held, copy)
    _note_size(options.new, copy, str(options.path))


class CopyOptions(msgspec.Struct, frozen=True):
    """The options of `capture repair` and `capture decode`."""

    path: Path = argument(metavar="IN.mcap", type=PATH)
    new: Path = argument(metavar="OUT.mcap", type=PATH)
    force: bool = command_files.force_option()


@command(CopyOptions)
def repair(options: CopyOptions) -> None:
    """Examples:
      bilprov capture repair broken.mcap repaired.mcap

    OUT holds all raw bytes, line events and notes of conformance runs that can be read, with
    metadata and attachments; a gap stands where something is lost. IN may also be a capture that
    was never finished, and stays as it is. bilprov capture check IN.mcap reports what is lost.
    Decoded topics are left out: bilprov capture decode writes them. Ctrl-C leaves no OUT."""
    from bilprov.analyzer.edit.cut import edited_metadata

    did = f"repair {printable(options.path.name)}"
    capture, copy = _copied(options, partial(edited_metadata, edit=did))
    _note_size(options.new, copy, str(options.path))
    if capture.left_out or not capture.damage:
        shared.note(f"{quantity(capture.left_out, 'byte')} of the file could not be read")


class JoinOptions(msgspec.Struct, frozen=True):
    """The options of `capture join`."""

    paths: tuple[Path, ...] = argument(metavar="FILE.mcap...", nargs=-1, required=True, type=PATH)
    new: Path = shared.output_option(
        metavar="OUT.mcap",
        required=True,
        type=PATH,
        help="The new capture.",
    )
    force: bool = command_files.force_option()


@command(JoinOptions)
def join(options: JoinOptions) -> None:
    """Examples:
      bilprov capture join host.mcap device.mcap -o both.mcap

    Two sniffers, of which one listened to the host and one to the device, give a capture of both
    directions: their clocks must agree within a few milliseconds. Recordings that follow each other
    become one capture with a gap between them. Where two hold the same direction at the same time,
    every byte would be there twice: that is refused, with the command that cuts one of them.

    Raw bytes, line events and what conformance runs noted are kept as they are, with the metadata
    and attachments of all. Decoded topics are left out: bilprov capture decode writes them. Ctrl-C
    leaves no OUT.
    """
    from bilprov.analyzer.edit.join import Joined, write_joined

    if len(options.paths) < 2:
        raise click.UsageError("name two captures or more to join")
    captures, protocol = command_files.opened_captures(options.paths, copied=True)
    joined = Joined(protocol, captures)
    inputs_in_order = [source.capture for source in joined.sources]
    with _copying(options, inputs_in_order, joined.metadata(), protocol) as copy:
        write_joined(joined, copy)
    _note_size(options.new, copy, f"{len(captures)} captures")


class DecodeOptions(CopyOptions, frozen=True):
    """The options of `capture decode`."""

    half_duplex: bool = shared.half_duplex_option()


@command(DecodeOptions)
def decode(options: DecodeOptions) -> None:
    """Examples:
      bilprov capture decode drive.mcap whole.mcap

    OUT holds what IN holds, and every frame, answer, state and fault decoded from its bytes,
    including those that were not written while traffic was heavy. IN may come from an older version
    or from another program, and may be unfinished or damaged. Ctrl-C leaves no OUT.
    """
    from bilprov.analyzer.edit.cut import decoded_metadata

    _copied(options, decoded_metadata, decoded=True, half_duplex=options.half_duplex)
    shared.note(f"{options.path} is in {options.new}, with everything decoded from it")


class DiffOptions(msgspec.Struct, frozen=True):
    """The options of `capture diff`."""

    first: str = argument(metavar="A.mcap")
    second: str = argument(metavar="B.mcap")
    tolerance: float = option(
        "--latency",
        metavar="MS",
        type=shared.Finite(0),
        default=20.0,
        help="By how many milliseconds the latencies of a frame may differ: an adapter alone may "
        "delay an answer by 16.",
    )
    output: str | None = command_files.json_option()
    force: bool = command_files.force_option()


@command(DiffOptions, only_with={"output": ("force",)})
def diff(options: DiffOptions) -> int:
    """Examples:
      bilprov capture diff yesterday.mcap today.mcap

    Both are decoded, and aligned by the frames that the host sent, so that one frame more or less
    does not shift the rest; after more than 20,000 missing at one place they are listed one by one.
    Reported are frames that only one of them has, different or missing answers, bytes that answer
    nothing, and latencies that differ by more than --latency; times of day and pauses are not
    compared. The keys of the JSON are explained in analyzer/edit/compare.py.

    Exit code 1 if anything differs, 0 if nothing does, 3 if only one of them holds answers and
    nothing else differs; 2 if not all of it could be shown.
    """
    from bilprov.analyzer.cli.streams import promise_verdict
    from bilprov.analyzer.edit.compare import as_json, compared, drawn
    from bilprov.analyzer.output.console import show

    promise_verdict()
    output, paths = options.output, (options.first, options.second)
    command_files.require_writable([("--json", output)], paths, force=options.force)
    captures, protocol = command_files.opened_captures(paths)
    with command_files.reading(captures) as progress:
        comparison = compared(captures, protocol, progress, round(options.tolerance * 1e6))
    if output is not None:
        command_files.write_output(
            output, command_files.json_object(as_json(comparison, protocol, paths))
        )
    if output != command_files.STANDARD_OUTPUT:
        show(*drawn(comparison, paths))
    return comparison.exit


def _copied(
    options: CopyOptions,
    metadata: Callable[[Capture, Protocol], Mapping[str, str]],
    *,
    decoded: bool = False,
    half_duplex: bool = False,
) -> tuple[Capture, Copy]:
    """Write a whole capture again, with what `metadata` makes of it."""
    from bilprov.analyzer.edit.cut import write_window
    from bilprov.analyzer.output.outputs import Window
    from bilprov.analyzer.replay.capture_decoding import opened_whole

    (capture,), protocol = command_files.opened_captures(
        [options.path], copied=True, half_duplex=half_duplex
    )
    # To write each frame takes long, however few bytes there are.
    shown = {"least": 0} if decoded else {}
    with _copying(options, [capture], metadata(capture, protocol), protocol, **shown) as copy:
        write_window(opened_whole(capture, protocol), Window(), copy, decoded=decoded)
    return capture, copy


def _note_size(new: Path, copy: Copy, of: str) -> None:
    shared.note(f"{new} holds {quantity(copy.raw_bytes, 'byte')} of {of}")


@contextmanager
def _copying(
    options: CutOptions | CopyOptions | JoinOptions,
    captures: Sequence[Capture],
    metadata: Mapping[str, str],
    protocol: Protocol,
    **shown: int,
) -> Iterator[Copy]:
    """Give the new capture, which is written while `reading` shows the progress as `shown` says."""
    from bilprov.analyzer.edit.cut import new_capture
    from bilprov.captures.topics import TOPICS

    inputs = [str(capture.path) for capture in captures]
    command_files.require_writable(
        [("OUT", str(options.new))], inputs, force=options.force, regular=True
    )
    known = {topic.name for topic in TOPICS}
    for capture in captures:
        if others := [topic for topic in capture.contents.counts if topic not in known]:
            shared.note(f"left out, since they are not bilprov's topics: {', '.join(others)}")
    with (
        command_files.reading(captures, **shown) as progress,
        new_capture(
            options.new, captures, metadata, protocol, progress, force=options.force
        ) as copy,
    ):
        yield copy
