"""The hooks of a pytest session with a robot: cases are tests, judged in one run on its port.

The verdict of a case is the outcome of its test, the evidence its message.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import pytest

from bilprov.analyzer.cli.options import NotConfirmed, confirm_effect
from bilprov.analyzer.client.probes import ProbeError
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.signals import ENDINGS, handled, unhandled
from bilprov.conformance.api import Options, estimated
from bilprov.conformance.cases.levels import LEVELS, STANDARD
from bilprov.conformance.dut.boards import EmulatorError
from bilprov.conformance.dut.simulator import Fault
from bilprov.conformance.dut.target import SIM, Target
from bilprov.conformance.oracle.choices import parse_allowed
from bilprov.conformance.oracle.verdicts import Verdict
from bilprov.conformance.pytest_plugin.bench import Bench
from bilprov.conformance.report.run_report import evidence_lines, reproducer
from bilprov.spec.by_effect import effect_words
from bilprov.spec.errors import UserError, one_line
from bilprov.spec.protocol import Protocol, require_family

NAME = "conformance"


class Conformance(pytest.Collector):
    """The suite as a collector without a file, whose items are the cases of `ids`."""

    bench: Bench
    ids: Sequence[str]
    told_why = False  # why cases have no result: said once, the reason is the same for all

    def collect(self) -> Iterable[pytest.Item]:
        """The cases, in the run's order."""
        for ident in self.ids:
            yield CaseItem.from_parent(self, name=ident)


class CaseItem(pytest.Item):
    """One case as an item. `known` is true for one that was not collected but has a result."""

    known = False
    parent: Conformance

    def setup(self) -> None:
        """Wait for the result; a case that the kit could not judge is an error, not a failure."""
        bench = self.parent.bench
        result = bench.result(self.name)
        if result is None:
            why = bench.why_not
            if self.parent.told_why or not why:
                _skip(f"not judged: {why or 'this run did not need it'}")
            self.parent.told_why = True
            _fail(f"not judged: {why}")
        self._result = result
        self.user_properties += [("clause", result.clause), ("verdict", result.verdict.label)]
        if result.reading:
            self.user_properties.append(("reading", result.reading))
        if result.verdict is Verdict.ERROR:
            _fail(result.reason)

    def runtest(self) -> None:
        """The verdict as an outcome: only `fail` fails, only what was judged passes."""
        result, bench = self._result, self.parent.bench
        if result.verdict is Verdict.FAIL:
            command = reproducer(bench.protocol.origin, bench.target, bench.link, bench.options)
            lines = evidence_lines(result, command(result))
            _fail("\n".join([f"{result.id} ({result.clause}): {result.requirement}", *lines]))
        if result.verdict in (Verdict.INCONCLUSIVE, Verdict.SKIPPED):
            _skip(f"{result.verdict.label}: {result.reason}")
        if result.verdict is not Verdict.PASS:
            self.add_report_section("call", NAME, f"{result.verdict.label}: {result.reason}")

    def reportinfo(self) -> tuple[Path, int, str]:
        """The location that pytest shows: a path made of the suite's name, which has no file."""
        return self.config.rootpath / NAME, 0, self.name


def _fail(message: str) -> NoReturn:
    """Fail with the message alone: a traceback into the kit would not help the user."""
    pytest.fail(message, pytrace=False)


def _skip(reason: str) -> NoReturn:
    raise pytest.skip.Exception(reason, _use_item_location=True)


class RobotSession:
    """The plugin's hooks, registered with --robot-port.

    Raises pytest.UsageError, in one sentence, for wrong use.
    """

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        _require_one_process(config)
        option = config.getoption
        if option("setuponly") or option("setupplan"):
            raise pytest.UsageError("a robot has no set-up to show: leave --robot-port out")
        try:
            protocol = load_protocol(option("robot_grammar"))
            require_family(protocol, "the suite")
            self.bench = Bench(
                protocol,
                option("robot_port"),
                options=_options(protocol, option),
                settings=line_settings(protocol, option("robot_baud"), None, None),
                probe=option("robot_probe"),
                fault=_fault(protocol, option("robot_port"), option("robot_fault")),
            )
            with ExitStack() as refused:
                refused.callback(self.bench.close)
                self._wanted = self._asked_for()
                refused.pop_all()
        except (UserError, ValueError, OSError) as error:
            raise pytest.UsageError(one_line(error)) from error
        self._left: list[str] = []
        self._signals = ExitStack()

    def _asked_for(self) -> frozenset[str]:
        """The ids of the cases that the command line names; all of them where it names nothing."""
        config = self._config
        mine = [arg for arg in config.args if arg.startswith(f"{NAME}::")]
        if NAME in config.args and not Path(NAME).exists():  # else it is a file of the user's
            mine.append(NAME)
        if not mine and config.args_source is pytest.Config.ArgsSource.ARGS:
            return frozenset()
        named = {arg.removeprefix(f"{NAME}::") for arg in mine} - {NAME}
        unknown = sorted(named - self.bench.order.keys())
        if unknown:
            raise pytest.UsageError(f"there is no case {one_line(unknown[0])}; see --collect-only")
        config.args[:] = [arg for arg in config.args if arg not in mine]
        return frozenset(named if named and NAME not in mine else self.bench.order)

    # -- collecting -------------------------------------------------------------------------------

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_collection_modifyitems(
        self, session: pytest.Session, items: list[pytest.Item]
    ) -> Generator[None]:
        """Add the cases before -k and -m select; put them first, in order, after any shuffling."""
        if self._wanted:
            ids = [ident for ident in self.bench.order if ident in self._wanted]
            suite: Conformance = Conformance.from_parent(session, name=NAME, nodeid=NAME)
            suite.bench, suite.ids = self.bench, ids
            suite.add_marker(NAME)
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
        """Open the port and ask for consent before the first test, if any test needs the robot."""
        if session.config.option.collectonly:
            return
        self._left = [item.name for item in session.items if isinstance(item, CaseItem)]
        others = any("robot" in getattr(item, "fixturenames", ()) for item in session.items)
        if not self._left and not others:
            return
        # Each signal that ends pytest is treated as Ctrl-C, so that none leaves a robot driving. A
        # step of the run that is under way goes on, and the run then ends in order.
        self._signals.enter_context(handled(unhandled(ENDINGS), self._end))
        try:
            self.bench.open(self._confirm)
        except (LinkError, ProbeError, EmulatorError, NotConfirmed) as error:
            raise pytest.UsageError(str(error)) from error

    def _confirm(self, target: Target) -> None:
        what = f"the robot at {self.bench.target} will do what the tests send"
        if self._left:
            left = set(self._left)
            chosen = [case for case in self.bench.cases if case.id in left]
            seconds = estimated(target, self.bench.options, chosen)
            what = f"the robot at {self.bench.target} will move for about {seconds:.0f} s"
        words = effect_words(self.bench.protocol)
        capture = self._config.pluginmanager.getplugin("capturemanager")
        if capture is not None:
            capture.suspend_global_capture(in_=True)
        try:
            yes = self._config.getoption("robot_yes")
            confirm_effect(self.bench.protocol, what, words, yes=yes, option="--robot-yes")
        finally:
            if capture is not None:
                capture.resume_global_capture()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(
        self, item: pytest.Item, nextitem: pytest.Item | None
    ) -> Generator[None, object, object]:
        """Begin the run at the first case, wait for its end at the last, add unplanned failures."""
        if not isinstance(item, CaseItem) or item.known:
            return (yield)
        self.bench.start(self._left)
        done = yield
        if not isinstance(nextitem, CaseItem):
            self.bench.finish()
        for extra in self._unplanned(item):
            item.ihook.pytest_runtest_protocol(item=extra, nextitem=nextitem)
        return done

    def _unplanned(self, item: CaseItem) -> Iterator[CaseItem]:
        """Items for failed cases that were not collected, such as unsolicited answers."""
        while self.bench.unplanned:
            result = self.bench.unplanned.pop(0)
            if result.verdict >= Verdict.FAIL:
                extra: CaseItem = CaseItem.from_parent(item.parent, name=result.id)
                extra.known = True
                yield extra

    def _end(self, number: int, frame: FrameType | None) -> None:
        if not self.bench.interrupt():
            self.bench.halt()
            signal.default_int_handler(number, frame)

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self) -> None:
        """End the run, also after -x or Ctrl-C, and home the robot."""
        self.bench.stop()

    def pytest_unconfigure(self) -> None:
        """Close the port and restore the signal handlers."""
        self.bench.close()
        self._signals.close()

    # -- telling ----------------------------------------------------------------------------------

    def pytest_report_header(self) -> str:
        """The header's line: robot, protocol and seed."""
        bench = self.bench
        return (
            f"robot: {bench.target}, {bench.protocol.name} {bench.protocol.version}, seed "
            f"{bench.options.seed}"
        )

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Print what no test shows: why the run ended early, and opening cases that failed."""
        report = self.bench.report
        if report is None:
            return
        if report.unusable or report.ended_by == "error":
            terminalreporter.write_line(f"robot: {report.unusable or report.ended}")
        for result in report.results:
            unasked = result.id in self.bench.order and result.id not in self._left
            if unasked and result.verdict >= Verdict.FAIL:
                what = f"{result.id}, which opens every run, is {result.verdict.label} too"
                terminalreporter.write_line(f"robot: {what}: {result.reason}")


def _require_one_process(config: pytest.Config) -> None:
    several = getattr(config.option, "numprocesses", None) or hasattr(config, "workerinput")
    if several or getattr(config.option, "dist", "no") != "no":
        raise pytest.UsageError("one port takes one process: leave -n out with --robot-port")


def _options(protocol: Protocol, option: Callable[[str], Any]) -> Options:
    """The options of the run. Raises ValueError for a level or a choice that there is not."""
    seed, level = option("robot_seed"), option("robot_level") or STANDARD.name
    if level not in LEVELS:
        raise ValueError(
            f"--robot-level is {level}; allowed are {', '.join(LEVELS)}: give one of them"
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
    from bilprov.conformance.mutation.catalogue import find_fault

    return find_fault(protocol, name)
