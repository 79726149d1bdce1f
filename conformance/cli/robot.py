"""The options that name what is tested and how it is reached."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager

import click
import msgspec
from msgspec.structs import replace

from bilprov.analyzer.cli.command import argument, asked_here, group, option
from bilprov.analyzer.cli.options import (
    SENDING_LINE,
    SendingLineOptions,
    confirm_effect,
    note,
    note_hindrances,
    note_suspension,
    only_for_ports,
    yes_option,
)
from bilprov.analyzer.cli.settings import PortName
from bilprov.analyzer.client.probes import PROBES
from bilprov.analyzer.transport.line_settings import LineSettings, line_settings
from bilprov.analyzer.transport.signals import Stopper
from bilprov.conformance.cli.options import fault_option, named_device, variant_option
from bilprov.conformance.dut.target import PORT, SIM, Target, TargetName, open_target, target_named
from bilprov.spec.by_effect import Movement, all_movement, movement_words
from bilprov.spec.protocol import Protocol


class RobotOptions(msgspec.Struct, frozen=True):
    """The options that say what is tested and how it is reached."""

    target: str = argument(metavar="PORT|sim|emulator:KIND:FIRMWARE", type=PortName())
    probe: str | None = option(
        help=f"What sees a stop: {', '.join(PROBES)} (the default for a "
        "port) or sim (the target sim's own)."
    )
    power: str | None = option(
        metavar="exec:COMMAND", help="A command that switches it off and on."
    )
    line: SendingLineOptions = group(SendingLineOptions)
    yes: bool = yes_option()
    fault: str | None = fault_option(
        help="With sim: misbehave in this way; random:SEED or random:SEED.NUMBER draws one."
    )
    variant: str | None = variant_option(help="With sim: read the document in this legal way.")

    def fitting(self, protocol: Protocol) -> tuple[RobotOptions, TargetName, LineSettings]:
        """The options without the settings that are for ports only where the target is none.

        With them the target and its line's settings; the simulator and boards have the grammar's.
        Raises UsageError, also for an option of the command line that is not for such a target.
        """
        try:
            name = target_named(self.target)
            line = self.line.settings(protocol) if name.kind == PORT else line_settings(protocol)
        except ValueError as error:
            raise click.UsageError(str(error)) from error
        if name.kind == PORT:
            probe, power = self.probe, self.power
        else:
            only_for_ports((*SENDING_LINE, "reconnect", "power"), name.text)
            probe, power = (self.probe if asked_here("probe") else None), None
            if probe not in (None, SIM):
                raise click.UsageError(
                    f"the target {name.text} brings its own probe; --probe {probe} is for ports"
                )
        if name.kind != SIM and (self.fault or self.variant):
            option = "--fault" if self.fault else "--variant"
            raise click.UsageError(
                f"{option} is for the target sim; start `bilprov simulate {option}`"
            )
        if power is not None and not power.startswith("exec:"):
            raise click.UsageError(f"--power {power}: it takes exec:COMMAND")
        return replace(self, probe=probe, power=power), name, line

    @contextmanager
    def driven(
        self,
        protocol: Protocol,
        name: TargetName,
        settings: LineSettings,
        agreed: Callable[[Target], Target],
        reconnect: float = 0.0,
    ) -> Iterator[tuple[Target, Stopper]]:
        """Open the target until the end of the block; its stopper handles signals from then on.

        `agreed` is called before anything is sent, asks whether a real robot may move, and gives
        the target with what is known of it by then. `reconnect` is how long (s) an unplugged port
        is waited for. At the end the user is told what the target has to remark.

        Raises UsageError for a fault or variant that is none, and what `open_target` raises.
        """
        with ExitStack() as stack:
            stopper = stack.enter_context(closing(Stopper()))
            opened = open_target(
                protocol,
                name,
                stopper,
                settings=settings,
                probe=self.probe,
                power=self.power and self.power.removeprefix("exec:"),
                fault=named_device(protocol, self.fault, self.variant),
                reconnect=reconnect,
            )
            target = agreed(stack.enter_context(opened))
            stack.enter_context(stopper)
            if target.moves:
                stopper.before_suspending(target.halt)
            yield target, stopper
            note(target.remark())
        note_suspension(stopper)

    def confirm(self, protocol: Protocol, how_long: str, movement: Movement) -> None:
        """Ask once whether the robot may move for so long, in words, and in this way."""
        note_hindrances(self.target)
        words = movement_words(protocol, movement)
        what = f"the robot at {self.target} will move for {how_long}"
        confirm_effect(
            protocol, what, words if all_movement(protocol).motions else "", yes=self.yes
        )
