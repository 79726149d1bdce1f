"""A pytest session with a robot: its cases as tests, judged in one run over its port."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Collection, Generator, Iterator
from pathlib import Path
from typing import Any

import pytest

from analyzer.cli.confirm import NotConfirmed, confirm_motion
from analyzer.grammar_file import load_protocol
from analyzer.options import line_settings
from analyzer.transport.errors import LinkError
from captures.errors import shown
from conformance.api import Options
from conformance.cases.levels import LEVELS, STANDARD
from conformance.dut.boards.emulator import EmulatorError
from conformance.dut.probes import ProbeError
from conformance.dut.simulator import Fault
from conformance.mutation.faults import fault_bank
from conformance.oracle.choices import parse_allowed
from conformance.oracle.verdicts import Verdict
from conformance.pytest_plugin.bench import SIM, Bench
from conformance.pytest_plugin.case_item import NAME, CaseItem, Conformance
from spec.protocol import GrammarError, Protocol

_GONE = (signal.SIGTERM, signal.SIGHUP)


class RobotSession:
    """What pytest calls. Raises pytest.UsageError, in one sentence, for wrong use."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        _require_one_process(config)
        option = config.getoption
        if option("setuponly") or option("setupplan"):
            raise pytest.UsageError("a robot has no set-up to show: leave --robot-port out")
        try:
            protocol = load_protocol(option("robot_grammar"))
            self.bench = Bench(
                protocol,
                option("robot_port"),
                options=_options(protocol, option),
                settings=line_settings(protocol, option("robot_baud"), None, None),
                probe=option("robot_probe"),
                fault=_fault(protocol, option("robot_port"), option("robot_fault")),
            )
        except (GrammarError, ValueError, OSError) as error:
            raise pytest.UsageError(shown(error)) from error
        if self.bench.own_probe and option("robot_probe") not in (None, SIM):
            raise pytest.UsageError(
                f"--robot-port {self.bench.target} brings its own probe: leave --robot-probe out"
            )
        self._wanted = self._asked_for()
        self._left: list[str] = []
        self._old: dict[signal.Signals, Any] = {}

    def _asked_for(self) -> frozenset[str]:
        """The cases that the command line's files leave: all of them where it names none."""
        config = self._config
        mine = [arg for arg in config.args if arg.startswith(f"{NAME}::")]
        if NAME in config.args and not Path(NAME).exists():  # else it is a file of the user's
            mine.append(NAME)
        if not mine and config.args_source is pytest.Config.ArgsSource.ARGS:
            return frozenset()
        named = {arg.removeprefix(f"{NAME}::") for arg in mine} - {NAME}
        unknown = sorted(named - self.bench.order.keys())
        if unknown:
            raise pytest.UsageError(f"there is no case {shown(unknown[0])}; see --collect-only")
        config.args[:] = [arg for arg in config.args if arg not in mine]
        return frozenset(named if named and NAME not in mine else self.bench.order)

    # -- collecting -------------------------------------------------------------------------------

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_collection_modifyitems(
        self, session: pytest.Session, items: list[pytest.Item]
    ) -> Generator[None]:
        """The cases are there before -k and -m choose, and first and in order whatever shuffles."""
        if self._wanted:
            ids = [ident for ident in self.bench.order if ident in self._wanted]
            suite = Conformance.of(session, self.bench, ids)
            report = session.ihook.pytest_make_collect_report(collector=suite)
            session.ihook.pytest_collectreport(report=report)
            items += [item for item in report.result or () if isinstance(item, pytest.Item)]
        yield
        cases = [item for item in items if isinstance(item, CaseItem)]
        cases.sort(key=lambda item: self.bench.order[item.name])
        items[:] = [*cases, *(item for item in items if not isinstance(item, CaseItem))]

    # -- running ----------------------------------------------------------------------------------

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> None:
        """Open the port, and ask, before the first test; not where nothing needs the robot."""
        if session.config.option.collectonly:
            return
        self._left = [item.name for item in session.items if isinstance(item, CaseItem)]
        others = any("robot" in getattr(item, "fixturenames", ()) for item in session.items)
        if not self._left and not others:
            return
        self._heed_signals()
        try:
            self.bench.open(lambda: self._confirm(self._left))
        except (LinkError, ProbeError, EmulatorError, NotConfirmed) as error:
            raise pytest.UsageError(str(error)) from error

    def _confirm(self, ids: Collection[str]) -> None:
        what = f"the robot at {self.bench.target} will do what the tests tell it"
        if ids:
            seconds = self.bench.seconds(frozenset(ids))
            what = f"the robot at {self.bench.target} will drive and turn for about {seconds:.0f} s"
        capture = self._config.pluginmanager.getplugin("capturemanager")
        if capture is not None:
            capture.suspend_global_capture(in_=True)
        try:
            confirm_motion(what, yes=self._config.getoption("robot_yes"), option="--robot-yes")
        finally:
            if capture is not None:
                capture.resume_global_capture()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(
        self, item: pytest.Item, nextitem: pytest.Item | None
    ) -> Generator[None, object, object]:
        """Begin the run with the first case; end it with the last, and tell what has no test."""
        if not isinstance(item, CaseItem) or item.known:
            return (yield)
        self.bench.start(self._left)
        done = yield
        if not isinstance(nextitem, CaseItem):
            self.bench.finish()
        for extra in self._surprises(item):
            item.ihook.pytest_runtest_protocol(item=extra, nextitem=nextitem)
        return done

    def _surprises(self, item: CaseItem) -> Iterator[CaseItem]:
        """What failed and was never collected, such as an answer that nobody asked for."""
        while self.bench.surprises:
            result = self.bench.surprises.pop(0)
            if result.verdict >= Verdict.FAIL:
                extra: CaseItem = CaseItem.from_parent(item.parent, name=result.id)
                extra.known = True
                yield extra

    def _heed_signals(self) -> None:
        """A job that is cancelled leaves no robot driving: as Ctrl-C."""
        if threading.current_thread() is threading.main_thread():
            for number in _GONE:
                if signal.getsignal(number) is signal.SIG_DFL:
                    self._old[number] = signal.signal(number, signal.default_int_handler)

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self) -> None:
        """-x and Ctrl-C end the run too, and home the robot."""
        self.bench.stop()

    def pytest_unconfigure(self) -> None:
        """Give the port up."""
        self.bench.close()
        while self._old:
            signal.signal(*self._old.popitem())

    # -- telling ----------------------------------------------------------------------------------

    def pytest_report_header(self) -> str:
        """One line: which robot, which protocol, which seed."""
        bench = self.bench
        return (
            f"robot: {bench.target}, {bench.protocol.name} {bench.protocol.version}, seed "
            f"{bench.options.seed}"
        )

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """What the tests do not say: why the run ended early, and what failed unselected."""
        report = self.bench.report
        if report is None:
            return
        if report.unusable or report.ended_by == "error":
            terminalreporter.write_line(f"robot: {report.unusable or report.ended}")
        for result in report.results:
            unasked = result.id in self.bench.order and result.id not in self._left
            if unasked and result.verdict >= Verdict.FAIL:
                what = f"{result.id}, which opens every run, is {result.verdict.label} too"
                terminalreporter.write_line(f"robot: {what}: {shown(result.reason)}")


def _require_one_process(config: pytest.Config) -> None:
    several = getattr(config.option, "numprocesses", None) or hasattr(config, "workerinput")
    if several or getattr(config.option, "dist", "no") != "no":
        raise pytest.UsageError("one port takes one process: leave -n out with --robot-port")


def _options(protocol: Protocol, option: Callable[[str], Any]) -> Options:
    """What the run is told. Raises ValueError for a level or a choice that there is not."""
    seed, level = option("robot_seed"), option("robot_level") or STANDARD.name
    if level not in LEVELS:
        raise ValueError(
            f"--robot-level is {shown(level)}; allowed are {', '.join(LEVELS)}: give one of them"
        )
    allow = tuple(option("robot_allow") or ())
    parse_allowed(protocol, allow)
    return Options(
        only=tuple(option("robot_only") or ()),
        seed=1 if seed is None else seed,
        level=level,
        allow=allow,
    )


def _fault(protocol: Protocol, target: str, name: str | None) -> Fault | None:
    if name is None:
        return None
    if target != SIM:
        raise ValueError("--robot-fault is for --robot-port sim")
    bank = fault_bank(protocol)
    if name not in bank:
        raise ValueError(f"there is no fault {name!r}; bilprov simulate --list-faults lists them")
    return bank[name]
