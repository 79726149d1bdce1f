"""The demonstration behind `make demo`: simulator, sniff, conform and replay, end to end.

Every step is the command itself, as anyone would type it, in a process of its own.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import click

from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.port import Port
from bilprov.analyzer.transport.ports import open_port, wait_readable
from bilprov.spec.framing import Framer
from bilprov.spec.protocol import Protocol
from bilprov.spec.readings import ERRATA, EXAMPLES

_ANSWER = 0.3  # s that the driver waits for an answer: longer than any truncation time-out
_PAUSE = 0.05  # s between instructions, so that the decoding can be followed


def _bilprov(*words: str) -> list[str]:
    return [sys.executable, "-m", "bilprov", *words]


def _say(step: str, *words: str) -> None:
    command = " ".join(("bilprov", *words)) if words else ""
    click.secho(f"\n== {step}", bold=True)
    if command:
        click.secho(f"$ {command}", dim=True)


def _first_line(process: subprocess.Popen[str], stream: int) -> str:
    """The first line that a process prints there; RuntimeError if it ends without one."""
    line = b""
    while not line.endswith(b"\n"):
        if not select.select([stream], [], [], 10)[0]:
            raise RuntimeError(f"{process.args!r} said nothing in 10 s")
        byte = os.read(stream, 1)
        if not byte:
            raise RuntimeError(f"{process.args!r} ended")
        line += byte
    return line.decode().strip()


def examples(protocol: Protocol) -> list[tuple[str, list[bytes]]]:
    """The document's three examples as it should have printed them, then as it did print them."""
    meant = {e.example: bytes.fromhex(e.meant) for e in ERRATA if e.example}
    printed: dict[str, list[bytes]] = {}
    right: dict[str, list[bytes]] = {}
    for example in EXAMPLES:
        sent = bytes(int(bits, 2) for bits in example.bits.split())
        printed.setdefault(example.section, []).append(sent)
        fixed = meant.get((example.section, example.line), sent)
        right.setdefault(example.section, []).append(fixed)
    shows = [(f"example {section}, as its own table asks for", right[section]) for section in right]
    for section, frames in printed.items():
        if frames != right[section]:
            shows.append((f"example {section}, as the document prints it", frames))
    shows.append(("home", [bytes([protocol.pad_byte]) * protocol.longest_frame]))
    return shows


def _drive(protocol: Protocol, port: Port) -> int:
    """Send every example, waiting for each answer; returns how many bytes went out."""
    sent = 0
    for title, lines in examples(protocol):
        click.secho(f"-- {title}", fg="cyan", err=True)
        for line in lines:
            framer = Framer(protocol.lengths, None)
            frames = [*framer.feed(line, 0), *framer.drop(0, "truncated")]
            port.write(line)
            sent += len(line)
            for _ in frames:
                wait_readable([port], _ANSWER)
                time.sleep(_PAUSE)
                port.read()
    return sent


def demo(folder: Path) -> int:
    """Run the demonstration into a folder; returns the exit code of the conformance run."""
    protocol = load_protocol()
    capture, report = folder / "drive.mcap", folder / "conformance.json"
    run = folder / "conformance.mcap"
    _say("1. A simulated robot on a pty", "simulate")
    simulator = subprocess.Popen(_bilprov("simulate"), stdout=subprocess.PIPE, text=True)
    sniffer: subprocess.Popen[str] | None = None
    try:
        assert simulator.stdout is not None
        robot = _first_line(simulator, simulator.stdout.fileno())
        click.echo(robot)
        words: tuple[str, ...] = (
            "sniff",
            "--bridge",
            robot,
            "-w",
            str(capture),
            "--format",
            "lines",
        )
        _say("2. Sniff the line while a driver sends the document's examples", *words)
        sniffer = subprocess.Popen(_bilprov(*words), stderr=subprocess.PIPE, text=True)
        assert sniffer.stderr is not None
        offered = _first_line(sniffer, sniffer.stderr.fileno()).split()[-1]
        with open_port(offered) as port:
            _drive(protocol, port)
        time.sleep(_ANSWER)
        sniffer.send_signal(signal.SIGINT)
        sniffer.wait(10)
        words = ("capture", "info", str(capture))
        _say("3. What the capture holds", *words)
        subprocess.run(_bilprov(*words), check=True)
    finally:
        for process in (sniffer, simulator):
            if process is not None:
                process.terminate()
                process.wait(10)
                for stream in (process.stdout, process.stderr):
                    if stream is not None:
                        stream.close()
    words = ("conform", "sim", "--level", "smoke", "--json", str(report), "--record", str(run))
    _say("4. The conformance suite at its quickest level, in virtual time", *words)
    code = subprocess.run(_bilprov(*words), check=False).returncode
    words = ("conform", "sim", "--level", "smoke", "--fault", "restarts-by-itself", "--fail-fast")
    _say("5. The same suite on a robot that restarts by itself after its safety stop", *words)
    subprocess.run(_bilprov(*words), check=False)
    words = ("replay", str(capture), "--rate", "0", "--filter", "faulty")
    _say("6. Replay the capture: only the faulty instructions", *words)
    subprocess.run(_bilprov(*words), check=True)
    _say("The files are in " + str(folder))
    for file in sorted(folder.iterdir()):
        click.echo(f"{file.stat().st_size:10,} bytes  {file}")
    return code


@click.command()
def main() -> None:
    """Run the demonstration into a new folder under the current one."""
    folder = Path(tempfile.mkdtemp(prefix="demo-", dir=Path.cwd()))
    try:
        code = demo(folder)
    except (LinkError, RuntimeError, subprocess.SubprocessError) as error:
        click.echo(f"demo: {error}; the files so far are in {folder}", err=True)
        code = 2
    sys.exit(code)


if __name__ == "__main__":
    main()
