"""The demonstration behind `make demo`: simulator, sniff, conform and replay, end to end.

Every step is the command itself, as anyone would type it, in a process of its own.
"""

from __future__ import annotations

import os
import select
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from textwrap import fill

import click

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.port import Port, open_port
from bilprov.spec.framing import Framer
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import ERRATA, EXAMPLES

FILES = ("drive.mcap", "conformance.json", "conformance.mcap")
PAGE = "report.html"  # what the last of the commands to try writes
FAULT = "restarts-by-itself"
_ANSWER = 0.3  # s that the driver waits for an answer: longer than any truncation time-out
_PAUSE = 0.05  # s between instructions, so that the decoding can be followed


def _bilprov(*words: str) -> list[str]:
    return [sys.executable, "-m", "bilprov", *words]


def _step(title: str, explanation: str, *words: str) -> None:
    """Print what a step shows, and its command."""
    click.secho(f"\n== {title}", bold=True)
    click.echo(fill(explanation, 80))
    click.secho(f"$ bilprov {shlex.join(words)}", dim=True)


def _run(title: str, explanation: str, *words: str, expected: int = 0) -> int:
    """Run one command as a step. Raises CalledProcessError where its exit status is another."""
    _step(title, explanation, *words)
    command = _bilprov(*words)
    status = subprocess.run(command, check=False).returncode
    if status != expected:
        raise subprocess.CalledProcessError(status, command)
    return status


def _first_line(process: subprocess.Popen[str], stream: int) -> str:
    """The first line that a process prints there; RuntimeError if it ends without one."""
    line = b""
    while not line.endswith(b"\n"):
        if not select.select([stream], [], [], 10)[0]:
            raise RuntimeError(f"{process.args!r} printed nothing in 10 s")
        byte = os.read(stream, 1)
        if not byte:
            raise RuntimeError(f"{process.args!r} ended")
        line += byte
    return line.decode().strip()


def examples(protocol: Protocol) -> list[tuple[str, list[bytes]]]:
    """The document's three examples as they were meant, those that it misprints, and a Stop."""
    meant = {e.example: bytes.fromhex(e.meant) for e in ERRATA if e.example}
    printed: dict[str, list[bytes]] = {}
    right: dict[str, list[bytes]] = {}
    for example in EXAMPLES:
        sent = bytes(int(bits, 2) for bits in example.bits.split())
        printed.setdefault(example.section, []).append(sent)
        fixed = meant.get((example.section, example.line), sent)
        right.setdefault(example.section, []).append(fixed)
    shows = [(f"example {section}, as it was meant", right[section]) for section in right]
    for section, frames in printed.items():
        if frames != right[section]:
            shows.append((f"example {section}, as the document misprints it", frames))
    shows.append(("stop the robot", [bytes([protocol.pad_byte])]))
    return shows


def _drive(protocol: Protocol, port: Port) -> None:
    """Send every example, waiting for each answer."""
    for title, lines in examples(protocol):
        click.secho(f"-- {title}", fg="cyan", err=True)
        for line in lines:
            framer = Framer(protocol, None)
            for frame in [*framer.feed(line, 0), *framer.drop(0, "truncated")]:
                port.write(frame.data)
                select.select([port], [], [], _ANSWER)
                time.sleep(_PAUSE)
                port.read()


def demo(folder: Path) -> int:
    """Run the demonstration into a folder; returns the exit status of the run that conforms."""
    protocol = load_protocol()
    capture, report, run = (folder / name for name in FILES)
    _step(
        "1. A simulated robot",
        "It listens at the pseudo terminal that it prints, which is used like a serial port.",
        "simulate",
    )
    simulator = subprocess.Popen(_bilprov("simulate"), stdout=subprocess.PIPE, text=True)
    sniffer: subprocess.Popen[str] | None = None
    try:
        assert simulator.stdout is not None
        robot = _first_line(simulator, simulator.stdout.fileno())
        click.echo(robot)
        words = ["sniff", "--bridge", robot, "-w", str(capture), "--format", "lines"]
        _step(
            "2. Sniff the line between a driver and the robot",
            "The driver sends the three examples of the document as they were meant, then those "
            "that it prints with mistakes. Each instruction is shown with the state that it "
            "predicts, each answer with how long it took. The rows of faulty instructions give "
            "the reason.",
            *words,
        )
        sniffer = subprocess.Popen(_bilprov(*words), stderr=subprocess.PIPE, text=True)
        assert sniffer.stderr is not None
        offered = _first_line(sniffer, sniffer.stderr.fileno()).split()[-1]
        with open_port(offered) as port:
            _drive(protocol, port)
        time.sleep(_ANSWER)
        sniffer.send_signal(signal.SIGINT)
        sniffer.wait(10)
    finally:
        for process in (sniffer, simulator):
            if process is not None:
                process.terminate()
                process.wait(10)
                for stream in (process.stdout, process.stderr):
                    if stream is not None:
                        stream.close()
    _run(
        "3. The capture",
        "It holds every byte of the drive with its time.",
        *("capture", "info", str(capture)),
    )
    _run(
        "4. The faulty instructions in it",
        "A filter selects them, with their answers: the robot refused each one and stopped.",
        *("replay", str(capture), "--rate", "0", "--filter", "faulty"),
    )
    conform = ("conform", "sim", "--level", "smoke")
    code = _run(
        "5. Test a robot",
        "The suite tests the simulated robot at its quickest level, in virtual time. It conforms.",
        *(*conform, "--json", str(report), "--record", str(run)),
    )
    _run(
        "6. Test a robot with a fault",
        "This one drives on by itself after its safety stop. It does not conform.",
        *(*conform, "--fault", FAULT, "--fail-fast"),
        expected=1,
    )
    click.secho(f"\nThe files are in {folder}. Try next:", bold=True)
    # In a checkout the command stands beside Python, which need not be in the PATH.
    beside = os.path.relpath(Path(sys.executable).with_name("bilprov"))
    program = "bilprov" if shutil.which("bilprov") else shlex.quote(beside)
    for words in (
        ["replay", str(capture)],
        ["stats", str(capture)],
        [*conform, "--fault", FAULT, "--html", str(folder / PAGE)],
    ):
        click.echo(f"  {program} {shlex.join(words)}")
    return code


@click.command()
def main() -> None:
    """Run the demonstration into build/demo, in place of the files of an earlier one."""
    folder = Path("build", "demo")
    folder.mkdir(parents=True, exist_ok=True)
    for name in (*FILES, PAGE):
        (folder / name).unlink(missing_ok=True)
    try:
        code = demo(folder)
    except (LinkError, RuntimeError, subprocess.SubprocessError) as error:
        click.echo(f"demo: {error}; the files so far are in {folder}", err=True)
        code = 2
    sys.exit(code)


if __name__ == "__main__":
    main()
