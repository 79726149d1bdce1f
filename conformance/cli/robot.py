"""The options that name what is tested and how it is reached."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial

import click

from bilprov.analyzer.cli.command import argument, group, option
from bilprov.analyzer.cli.options import LineOptions, asked_here, yes_option
from bilprov.analyzer.cli.settings import PortName
from bilprov.analyzer.client.port_link import by_command
from bilprov.analyzer.client.probes import PROBES
from bilprov.analyzer.transport.line_settings import LineSettings, line_settings
from bilprov.analyzer.transport.signals import Stopper
from bilprov.conformance.cli.options import fault_option, named_device, variant_option
from bilprov.conformance.dut.target import PORT, SIM, Target, TargetName, open_target
from bilprov.spec.protocol import Protocol


@dataclass(frozen=True)
class RobotOptions:
    """The options that say what is tested and how it is reached."""

    target: str = argument(metavar="PORT|sim|emulator:KIND:FIRMWARE", type=PortName())
    probe: str | None = option(
        help=f"What sees a stop: {', '.join(kind.form for kind in PROBES)} (the default for a "
        "port) or sim (the target sim's own)."
    )
    power: str | None = option(
        metavar="exec:COMMAND", help="A command that switches it off and on."
    )
    line: LineOptions = group(LineOptions)
    yes: bool = yes_option()
    fault: str | None = fault_option(
        help="With sim: misbehave in this way; random:SEED or random:SEED.NUMBER draws one."
    )
    variant: str | None = variant_option(help="With sim: read the document in this legal way.")

    def settings(self, protocol: Protocol, name: TargetName) -> LineSettings:
        """The line's settings; the simulator and boards have the grammar's. Raises ValueError."""
        return self.line.settings(protocol) if name.kind == PORT else line_settings(protocol)

    def fitting(self, name: TargetName) -> RobotOptions:
        """The options without the settings that are for ports only, if this is none.

        Raises UsageError for an option of the command line that is not for this kind of target.
        """
        probe = self.probe if asked_here("probe") or not name.own_probe else None
        power = self.power if asked_here("power") or name.kind == PORT else None
        if name.own_probe and probe not in (None, SIM):
            raise click.UsageError(
                f"the target {name.text} brings its own probe; --probe {probe} is for ports"
            )
        if name.kind != SIM and (self.fault or self.variant):
            option = "--fault" if self.fault else "--variant"
            raise click.UsageError(
                f"{option} is for the target sim; start `bilprov simulate {option}`"
            )
        if power is not None and (name.kind != PORT or not power.startswith("exec:")):
            raise click.UsageError(f"--power {power}: it takes exec:COMMAND, and is for ports")
        return replace(self, probe=probe, power=power)

    def opened(
        self, protocol: Protocol, name: TargetName, settings: LineSettings, reconnect: float = 0.0
    ) -> Callable[[Stopper], AbstractContextManager[Target]]:
        """What opens the target; `reconnect` is how long (s) an unplugged port is waited for.

        Raises UsageError for a fault or variant that is none.
        """
        return partial(
            open_target,
            protocol,
            name,
            settings=settings,
            probe=self.probe,
            power=by_command(self.power.removeprefix("exec:")) if self.power else None,
            fault=named_device(protocol, self.fault, self.variant),
            reconnect=reconnect,
        )
