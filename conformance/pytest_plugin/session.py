"""The hooks of a pytest session with a robot: cases are tests, judged in one run on its port.

The verdict of a case is the outcome of its test, the evidence its message. A run goes on while a
result is waited for, and rests between two cases, when the robot is homed. Tests of the user's get
clients, never at the same time. However it ends, the robot is homed. A client uses a link, so that
a test works alike on a port in real time and on a simulator in virtual time.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, TypeVar

import pytest

from bilprov.analyzer.cli.options import NotConfirmed, confirm_effect
from bilprov.analyzer.client.driver import Answer, RobotError
from bilprov.analyzer.client.operations import Ended, Link, Procedure, drive, listen, observe
from bilprov.analyzer.client.probes import ASK, ProbeError
from bilprov.analyzer.client.robot import Instructions
from bilprov.analyzer.grammar_file import load_protocol
from bilprov.analyzer.transport.errors import LinkError
from bilprov.analyzer.transport.line_settings import line_settings
from bilprov.analyzer.transport.signals import ENDINGS, Stopper, handled, unhandled
from bilprov.captures.schemas import MS, Look
from bilprov.conformance import api
from bilprov.conformance.cases.levels import LEVELS, STANDARD, AnyCase
from bilprov.conformance.dut.boards import EmulatorError
from bilprov.conformance.dut.target import SIM, Target, open_target, target_named
from bilprov.conformance.oracle.profile import parse_allowed
from bilprov.conformance.oracle.verdicts import CaseResult, Verdict
from bilprov.conformance.report.run_report import Report, evidence_lines, reproducer
from bilprov.conformance.runner.listeners.listener import RunListener
from bilprov.spec.by_effect import effect_words
from bilprov.spec.errors import UserError, one_line
from bilprov.spec.protocol import Protocol, require_family

_SETTLE = 2 * MS
T = TypeVar("T")


class Client(Instructions):
    """One robot on a link, driven as a `Robot` is. `sees` says whether there is a probe to look.

    Nothing is sent until `home` or an instruction is called. Every method raises RobotError where
    the robot does not answer, sends an unsolicited answer, or cannot be reached any more. Once it
    is `over` no instruction is sent any more, whoever kept the client.
    """

    def __init__(self, protocol: Protocol, link: Link, *, sees: bool) -> None:
        super().__init__(protocol, link)
        self.sees = sees
        self.over = False

    def send_bytes(self, data: bytes, answers: int = 1) -> tuple[Answer, ...]:
        """Send bytes unchanged, as a `Robot` does."""
        with self._alone():
            if self.over:
                raise RobotError("the test that used the robot is over")
            return super().send_bytes(data, answers)

    def look(self) -> Look:
        """What the probe sees now. Raises RobotError where there is no probe."""
        if not self.sees:
            raise RobotError("there is no probe to observe the robot; see --robot-probe")
        return self._do(observe()).look

    def home(self) -> None:
        """Bring the line to a frame's boundary and the robot to a stop, from wherever it is.

        Speed and LED stay as they were. The probe, if there is one, must see it stand still.
        """
        super().home()
        # Link and probe are two lines: a look may be a little older than the answer.
        until = self._do(listen(None, 0)).now + round(self.protocol.timing.stop_longest * MS)
        while self.sees and self.look().moving:
            if self._do(listen(None, _SETTLE)).now >= until:
                raise RobotError("the robot still moves although it was sent a stop")

    def _do(self, procedure: Procedure[T]) -> T:
        try:
            return drive(procedure, self._link)
        except Ended as ended:
            raise RobotError(str(ended)) from ended


class Bench(RunListener):
    """One run of the suite, and any number of clients, on a port, `sim` or an emulated board.

    Nothing is opened before `open`. `close` stops a run that is still going, and homes. `unplanned`
    gets the results of cases that are not in `order`. `link` is the run's, once it has begun.

    `option` gives the plugin's options by name. Raises ValueError, in one sentence, for one that
    cannot be used, and as `load_protocol` does.
    """

    link: dict[str, Any]

    def __init__(self, option: Callable[[str], Any]) -> None:
        self.protocol = protocol = load_protocol(option("robot_grammar"))
        require_family(protocol, "the suite")
        self.target, self.options = option("robot_port"), _options(protocol, option)
        self._name = name = target_named(self.target)
        probe, fault = option("robot_probe"), option("robot_fault")
        if fault is not None:
            if self.target != SIM:
                raise ValueError("--robot-fault is for --robot-port sim")
            from bilprov.conformance.mutation.catalogue import find_fault

            fault = find_fault(protocol, fault)
        if name.own_probe and probe not in (None, SIM):
            raise ValueError(
                f"--robot-port {self.target} brings its own probe: leave --robot-probe out"
            )
        if probe == ASK:
            raise ValueError(
                f"--robot-probe {probe} cannot be used under pytest; run bilprov conform"
            )
        self.report: Report | None = None
        self.unplanned: list[CaseResult] = []
        self._stopper = Stopper()
        settings = line_settings(protocol, option("robot_baud"))
        self._open_target = partial(
            open_target, protocol, name, self._stopper, settings=settings, probe=probe, fault=fault
        )
        self._stack = ExitStack()
        self._port: Target | None = None
        self._run: Generator[None] | None = None
        self._going = False  # a step of the run is under way
        self._results: dict[str, CaseResult] = {}

    @cached_property
    def cases(self) -> tuple[AnyCase, ...]:
        """The cases of the options, which take seconds to make. Raises as `select_cases` does."""
        return api.select_cases(self.protocol, self.options)

    @cached_property
    def order(self) -> Mapping[str, int]:
        """The ids of the cases with their places in a run. Raises as `select_cases` does."""
        cases = (*api.opening_and_reading_cases(self.protocol), *self.cases)
        return {case.id: at for at, case in enumerate(cases)}

    def open(self, confirm: Callable[[Target], None]) -> None:
        """Open port and probe, and call `confirm`, which raises if the robot may not move.

        It is not called for the simulator or an emulated board, which move nothing. Raises
        LinkError, ProbeError and EmulatorError, in one sentence.
        """
        if self._name.own_probe:
            with self._opened():  # raises if the firmware cannot be run
                return
        self._port = self._stack.enter_context(self._open_target())
        confirm(self._port)
        self._stopper.before_suspending(self._port.halt)

    def _opened(self) -> AbstractContextManager[Target]:
        """The robot at the port; a target in virtual time is opened anew, just after power-on."""
        return self._open_target() if self._port is None else nullcontext(self._port)

    # -- the run ----------------------------------------------------------------------------------

    def start(self, ids: Collection[str]) -> None:
        """Begin the run of these cases, in the suite's order. Only the first call has an effect."""
        if self._run is None:
            options = self.options
            if self.order.keys() - set(ids):
                options = replace(options, only=tuple(ids))
            self._run = self._steps(options)

    def result(self, ident: str) -> CaseResult | None:
        """A case's result once it is final; None when the run has ended without one.

        Raises what broke the run, if the kit did, and KeyboardInterrupt where a signal ended it.
        """
        while ident not in self._results and self._step():
            pass
        if self._stopper.stopped:
            raise KeyboardInterrupt
        return self._results.get(ident)

    @property
    def why_not(self) -> str:
        """Why a case has no result although the run has ended; "" if the run did not need it."""
        if self.report is None:
            return "the run broke off"
        return self.report.unusable or self.report.ended or ""

    def finish(self) -> None:
        """Let the run go on to its end."""
        while self._step():
            pass

    def interrupt(self) -> bool:
        """Let a run that has begun end soon; whether a step of it is under way, which goes on."""
        if self._run is not None:
            self._stopper.stop()
        return self._going

    def halt(self) -> None:
        """Stop the robot at the port at once: a test may go on after Ctrl-C."""
        if self._port is not None:
            self._port.halt()

    def stop(self) -> None:
        """End a run that is still going; homes the robot, and ignores a second Ctrl-C meanwhile."""
        with Stopper():
            self.interrupt()
            self.finish()

    def _step(self) -> bool:
        """Do one operation of the run; whether there was one."""
        self._going = True
        try:
            return self._run is not None and next(self._run, self) is None
        finally:
            self._going = False

    def _steps(self, options: api.Options) -> Generator[None]:
        with self._opened() as target:
            self.link = target.environment.link
            self.report = yield from api.suite_steps(target, options, [self])

    def end(self, result: CaseResult) -> None:
        """A case is final."""
        self._results[result.id] = result
        if result.id not in self.order:
            self.unplanned.append(result)

    # -- clients ----------------------------------------------------------------------------------

    @contextmanager
    def client(self) -> Iterator[Client]:
        """A client of the robot, which is homed before and after. Waits for the end of a run.

        Raises RobotError where the robot cannot be homed.
        """
        self.finish()
        with self._opened() as target:
            eyes = target.environment.observability
            sees = eyes.available and not eyes.costly
            client = Client(self.protocol, target.connect(None), sees=sees)
            client.home()
            try:
                yield client
            finally:
                with Stopper() as postponed:
                    client.over = True
                    client.home()
                postponed.pass_on()

    def close(self) -> None:
        """Stop a run that is still going and close the port; may be called more than once."""
        self.stop()
        self._stack.close()
        self._stopper.close()


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
            self.bench = Bench(option)
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
            seconds = api.estimated(target, self.bench.options, chosen)
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
            raise KeyboardInterrupt

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


def _options(protocol: Protocol, option: Callable[[str], Any]) -> api.Options:
    """The options of the run. Raises ValueError for a level or a choice that there is not."""
    seed, level = option("robot_seed"), option("robot_level") or STANDARD.name
    if level not in LEVELS:
        raise ValueError(
            f"--robot-level is {level}; allowed are {', '.join(LEVELS)}: give one of them"
        )
    allow = tuple(option("robot_allow") or ())
    parse_allowed(protocol, allow)
    return api.Options(
        only=tuple(option("robot_only") or ()),
        seed=1 if seed is None else seed,
        level=level,
        allow=allow,
    )
