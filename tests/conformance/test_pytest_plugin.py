"""`pytest --robot-port`: one test for each case, one run over the port, and a fixture `robot`."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ET

import pytest

from bilprov.conformance.api import Options, conform
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.mutation.faults import fault_bank
from bilprov.spec.protocol import Protocol
from tests.support import ROOT
from tests.support.firmware import AVR, built
from tests.support.robots import PATIENCE, READING_CASES, TIMED_PROBES, served_here, simulate, until

pytestmark = pytest.mark.waits
pytest_plugins = ["pytester"]


PLUGIN = ("-p", "bilprov.conformance.pytest_plugin")
PROBES = 1 + READING_CASES  # the time-out and reading/*: what every run asks of a device first
SMOKE = ("--robot-level", "smoke")  # whose cases are soon made
FEW = ("--robot-only", "valid/LED/*", "--robot-only", "bad-data/LED/9")
Result = pytest.RunResult


# How -rs lists a case of the time-out that a real line is too coarse for when the machine is busy.
COARSE = re.compile(
    r"SKIPPED \[(\d+)\] conformance:1: "
    r"(?:informational|inconclusive): "
    r".*(?:time-out|whole-frame|between-bytes|tries do not agree)"
)


def unjudged(result: Result) -> int:
    """How many cases of the time-out were skipped, because the line was too coarse for them."""
    count = sum(int(found[1]) for line in result.outlines if (found := COARSE.match(line)))
    assert count <= len(TIMED_PROBES) + 1
    return count


@pytest.fixture
def run(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> pytest.Pytester:
    """A folder where pytest knows this plugin and, whatever is installed, no other."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "src"))
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    monkeypatch.delenv("PYTEST_ADDOPTS", raising=False)
    return pytester


def pytested(run: pytest.Pytester, *arguments: str, alone: bool = False) -> Result:
    """A run of pytest in this process, or `alone` in its own.

    What patches the plugin, is refused while it starts, or leaves a thread behind runs alone.
    """
    words = (*PLUGIN, "-W", "error", *arguments)
    if alone:
        return run.runpytest_subprocess(*words, timeout=PATIENCE)
    # What other tests have left unclosed is not this run's.
    return run.runpytest_inprocess(*words, "-p", "no:unraisableexception")


def on_sim(run: pytest.Pytester, *arguments: str, alone: bool = False) -> Result:
    return pytested(run, "--robot-port", "sim", *arguments, alone=alone)


def text(result: Result) -> str:
    return "\n".join([*result.outlines, *result.errlines])


# -- one test a case ------------------------------------------------------------------------------


@pytest.mark.sample(1)
@pytest.mark.parametrize("fault", ["led-order-reversed", "never-moves", "no-stop-on-bad-data"])
def test_the_outcomes_are_the_verdicts_of_conform(
    run: pytest.Pytester, protocol: Protocol, fault: str
) -> None:
    only = ("valid/LED/*", "bad-data/LED/1?", "unused-id/9/*")
    words = [word for glob in only for word in ("--robot-only", glob)]
    device = Simulator(protocol, fault_bank(protocol)[fault])
    report = conform(device, grammar=protocol, options=Options(only=only))

    result = on_sim(run, "--robot-fault", fault, *words, "--junitxml", "j.xml")

    outcome = {"pass": None, "fail": "failure", "inconclusive": "skipped", "skipped": "skipped"}
    cases = ET.parse(run.path / "j.xml").iter("testcase")
    found = {}
    for case in cases:
        assert case.get("classname") == "conformance"
        tags = [child.tag for child in case if child.tag not in ("properties", "system-out")]
        found[case.get("name")] = tags[0] if tags else None
    ran = {r.id: outcome[r.verdict.label] for r in report.results}
    assert {ident: found[ident] for ident in ran} == ran
    assert set(found.values()) != {None}
    assert result.ret == (1 if "failure" in found.values() else 0)


def test_a_failure_shows_expected_actual_and_the_command_and_no_traceback(
    run: pytest.Pytester,
) -> None:
    result = on_sim(run, *FEW, "--robot-fault", "led-order-reversed")

    result.assert_outcomes(passed=9 + PROBES, failed=5)
    result.stdout.fnmatch_lines(
        [
            "valid/LED/1 (section 3, table 1): LED: *",
            "sent*81 01",
            "state*led is 4, expected 1",
            "expected*led 1*",
            "got*led 4*",
            "again*bilprov conform sim --seed 1 --only valid/LED/1 --fault led-order-reversed",
        ]
    )
    assert "conformance/pytest" not in text(result)
    assert "Traceback" not in text(result)


def test_what_could_not_be_judged_is_skipped_with_its_reason(run: pytest.Pytester) -> None:
    result = on_sim(run, "--robot-only", "unused-id/9/?", "--robot-fault", "never-moves", "-rs")

    outcomes = result.parseoutcomes()
    assert outcomes["skipped"] >= 10
    result.stdout.fnmatch_lines(["SKIPPED*inconclusive: precondition lost: not seen moving*"])


def test_another_reading_passes_with_a_property(run: pytest.Pytester) -> None:
    words = ("--robot-only", "valid/Stop", "--robot-fault", "R-stop-steering=kept")

    result = on_sim(run, *words, "--junitxml", "j.xml", "-rP")

    result.assert_outcomes(passed=1 + 5 + PROBES)
    (case,) = [
        c for c in ET.parse(run.path / "j.xml").iter("testcase") if c.get("name") == "valid/Stop"
    ]
    told = {p.get("name"): p.get("value") for p in case.iter("property")}
    assert (told["verdict"], told["reading"]) == ("non-strict", "R-stop-steering")
    result.stdout.fnmatch_lines(["non-strict: kept: another reading of R-stop-steering"])


def test_a_line_that_cannot_be_used_is_one_error_and_nothing_passes(run: pytest.Pytester) -> None:
    result = on_sim(run, *FEW, "--robot-fault", "echo")

    result.assert_outcomes(errors=1, skipped=13 + PROBES)
    result.stdout.fnmatch_lines(["not judged: the line is an echo*"])
    assert result.ret == 1
    assert "Traceback" not in text(result)


def test_an_answer_that_nobody_asked_for_is_a_test_of_its_own(run: pytest.Pytester) -> None:
    result = on_sim(run, *FEW, "--robot-fault", "answers-again-after-30-ms")

    assert result.ret == 1
    result.stdout.fnmatch_lines(["FAILED conformance::line/unsolicited - *"])


# -- choosing -------------------------------------------------------------------------------------

CHOICES = [
    ((*SMOKE, "conformance::valid/LED/0"), "valid/LED/0", 1),
    (("-m", "conformance", "--robot-only", "valid/LED/*"), "valid/LED/0", 8 + 5 + PROBES),
    (("conformance", "--robot-only", "valid/LED/*"), "valid/LED/0", 8 + 5 + PROBES),
]


@pytest.mark.parametrize(("arguments", "member", "count"), CHOICES)
def test_only_the_selected_cases_run(
    run: pytest.Pytester, arguments: tuple[str, ...], member: str, count: int
) -> None:
    run.makepyfile("def test_mine(): pass")

    result = on_sim(run, *arguments, "-v")

    result.assert_outcomes(passed=count, deselected=1 if "-m" in arguments else 0)
    lines = ["robot: sim, robot-car 1.1, seed 1", f"conformance::{member} PASSED*"]
    result.stdout.fnmatch_lines(lines)
    assert "test_mine" not in text(result)


def test_what_is_deselected_is_not_sent(run: pytest.Pytester) -> None:
    run.makeconftest(
        "from bilprov.conformance.pytest_plugin import session as bench\n"
        "put = bench.Bench.end\n"
        "def end(self, result):\n"
        "    with open('ran', 'a') as file: file.write(result.id + '\\n')\n"
        "    put(self, result)\n"
        "bench.Bench.end = end\n"
    )

    result = on_sim(run, *FEW, "-k", "valid/LED/3 or valid/LED/6", alone=True)

    result.assert_outcomes(passed=2, deselected=12 + PROBES)

    ran = (run.path / "ran").read_text().split()
    assert [ident for ident in ran if ident.startswith("valid")] == ["valid/LED/3", "valid/LED/6"]
    assert len(ran) <= 2 + 6 + PROBES


def test_a_case_that_opens_each_run_is_told_of_though_it_was_not_selected(
    run: pytest.Pytester,
) -> None:
    words = (*SMOKE, "conformance::valid/LED/0", "--robot-fault", "wrong-code-for-unknown-id")
    result = on_sim(run, *words)

    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines(["robot: link/unused-id, which opens every run, is fail too:*"])


def test_files_that_are_named_leave_the_cases_out(run: pytest.Pytester) -> None:
    file = run.makepyfile("def test_mine(): pass")

    on_sim(run, str(file)).assert_outcomes(passed=1)
    on_sim(run, str(file), *SMOKE, "conformance::valid/LED/0").assert_outcomes(passed=2)


def test_collecting_sends_nothing(run: pytest.Pytester) -> None:
    result = pytested(run, "--robot-port", "/dev/no-such-port", "--co", "-q", *FEW)

    assert result.ret == 0
    result.stdout.fnmatch_lines(["conformance::valid/LED/7", f"{14 + PROBES} tests collected*"])


def test_the_cases_keep_their_order_whatever_shuffles(run: pytest.Pytester) -> None:
    pytest.importorskip("pytest_randomly")
    run.makepyfile("def test_mine(robot): pass")

    result = on_sim(run, *FEW, "-v", "-p", "pytest_randomly")

    result.assert_outcomes(passed=15 + PROBES)
    told = re.findall(r"^(conformance|test_\S+?)::(\S+) PASSED", text(result), re.M)
    ids = [name for _, name in told]
    assert ids[:2] == ["power-on/at-rest", "power-on/Speed"]
    assert ids[-1] == "test_mine"
    led = [name for name in ids if name.startswith("valid/LED")]
    assert led == [f"valid/LED/{n}" for n in range(8)]


# -- wrong use ------------------------------------------------------------------------------------

WRONG = [
    (("--robot-yes",), "--robot-yes needs --robot-port"),
    (("--robot-port", "sim", "--robot-probe", "tcp:a:1"), "leave --robot-probe out"),
    (("--robot-port", "sim", "--robot-fault", "x"), "there is no fault 'x'"),
    (("--robot-port", "/dev/x", "--robot-fault", "echo"), "--robot-fault is for"),
    (("--robot-port", "sim", "--robot-only", "x/*"), "no case matches x/*"),
    (("--robot-port", "sim", "conformance::valid/Nothing"), "there is no case valid/Nothing"),
    (("--robot-port", "sim", "--robot-grammar", "none.py"), "none.py"),
    (("--robot-port", "/dev/no-such-port", *SMOKE), "/dev/no-such-port"),
    (("--robot-port", "/dev/x", "--robot-probe", "ask"), "cannot be used under pytest"),
    (("--robot-port", "sim", "--setup-plan"), "no set-up to show"),
    (("--robot-port", "sim", "--robot-baud", "0"), "baud is 0"),
    (("--robot-port", "sim", "--robot-allow", "x=1"), "'x=1' cannot be allowed"),
    (("--robot-port", f"emulator:simavr:{__file__}", *SMOKE), "is not an ELF file"),
    (("-p", "xdist", "--robot-port", "sim", "-n", "2"), "one port takes one process"),
]


@pytest.mark.sample(2)
@pytest.mark.parametrize(("arguments", "words"), WRONG)
def test_wrong_use_is_one_sentence(
    run: pytest.Pytester, arguments: tuple[str, ...], words: str
) -> None:
    result = pytested(run, *arguments, alone=True)

    assert result.ret == pytest.ExitCode.USAGE_ERROR
    (line,) = [line for line in [*result.errlines, *result.outlines] if line.startswith("ERROR:")]
    assert words in line
    assert "Traceback" not in text(result)


# -- the fixture ----------------------------------------------------------------------------------

MINE = """\
import pytest

def test_an_instruction_gets_its_answer(robot):
    robot.send("Speed", speed=80)
    answer = robot.send("Forward")
    assert (answer.code, answer.name) == (0, "OK")
    assert robot.look().moving

def test_it_begins_at_rest_whatever_the_one_before_did(robot):
    assert robot.look().moving is False

def test_wrong_bytes(robot):
    assert [a.name for a in robot.send_bytes(bytes([0x93, 0, 0, 0]))] == ["BAD_HEADER"]
    assert robot.send_bytes(bytes([0x11]))[0].name == "TOO_FEW_DATA"
    assert len(robot.send_bytes(bytes(3), answers=3)) == 3

def test_a_value_out_of_range_is_not_sent(robot):
    with pytest.raises(ValueError, match="allowed are 0 to 7"):
        robot.send("LED", rgb=8)

def test_that_fails(robot):
    robot.send("Speed", speed=80)
    robot.send("Forward")
    assert robot.send("Stop").code == 1

def test_more(robot):
    assert robot.look().moving is False
    robot.wait(50)
"""


def test_people_test_their_robot_with_the_fixture(run: pytest.Pytester) -> None:
    run.makepyfile(test_mine=MINE)

    on_sim(run, "test_mine.py").assert_outcomes(passed=5, failed=1)
    on_sim(run, *FEW).assert_outcomes(passed=19 + PROBES, failed=1)


LATE = """
import threading

def test_that_leaves_a_thread_behind(robot):
    def drive():
        try:
            while True:
                robot.forward()
        except Exception as error:
            errors.append(str(error))

    errors = []
    robot.speed(80)
    thread = threading.Thread(target=drive)
    thread.start()
    left.append((thread, errors))

def test_what_is_left_of_it(robot):
    thread, errors = left[0]
    thread.join()
    assert errors == ["the test that used the robot is over"]

left = []
"""


def test_a_thread_that_outlives_its_test_drives_no_robot(
    run: pytest.Pytester, protocol: Protocol
) -> None:
    run.makepyfile(test_late=LATE)
    robot = Simulator(protocol)
    with served_here(robot) as (port, _):
        result = pytested(run, "--robot-port", port, "--robot-yes", "test_late.py", alone=True)

    result.assert_outcomes(passed=2)
    assert not robot.state.moving


@AVR
def test_a_board_s_firmware_is_judged_and_driven(run: pytest.Pytester) -> None:
    run.makepyfile(test_mine=MINE)
    target = f"emulator:simavr:{built()}"

    result = pytested(run, "-rs", "--robot-port", target, *FEW, "test_mine.py", "conformance")

    result.assert_outcomes(passed=19 + PROBES, failed=1)


def test_without_a_port_the_fixture_skips_and_nothing_else_happens(run: pytest.Pytester) -> None:
    run.makepyfile(test_mine=MINE + "\ndef test_plain(): pass\n")

    result = pytested(run, "-rs")

    result.assert_outcomes(passed=1, skipped=6)
    result.stdout.fnmatch_lines(["SKIPPED*the fixture robot needs --robot-port*"])


def test_a_robot_that_does_not_answer_is_an_error_in_one_sentence(run: pytest.Pytester) -> None:
    run.makepyfile(test_mine="def test_it(robot): pass\n")

    result = on_sim(run, "test_mine.py", "--robot-fault", "dead")

    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*nobody answers; is the robot on*"])


def test_another_grammar_gives_other_tests_and_instructions(
    run: pytest.Pytester, horn_text: str
) -> None:
    (run.path / "horn.py").write_text(horn_text)
    run.makepyfile("def test_horn(robot): assert robot.send('Horn', sound=3).code == 0")

    result = on_sim(run, "--robot-grammar", "horn.py", "--robot-only", "valid/Horn/*")

    result.assert_outcomes(passed=4 + 5 + 1 + PROBES)


# -- a real port ----------------------------------------------------------------------------------


def test_over_tcp_the_robot_is_judged_and_driven_and_left_at_rest(run: pytest.Pytester) -> None:
    run.makepyfile(test_mine=MINE)
    with simulate() as robot:
        port = ("--robot-port", robot.port, "--robot-probe", robot.probe)
        refused = pytested(run, *port, *FEW, alone=True)
        result = pytested(run, "-rs", *port, *FEW, "--robot-yes")
        moving = robot.state()["moving"]

    assert refused.ret == pytest.ExitCode.USAGE_ERROR
    assert re.search(
        r"ERROR: the robot at \S+ will move for about \d+ s: it drives and turns, at speeds up to "
        r"255 of 255; its wheels should be off the ground: there is no terminal to ask "
        r"on, so give --robot-yes if it may move",
        text(refused),
    )
    # Without a power switch one of the opening cases is skipped.
    unsure = unjudged(result)
    count = 8 + 1 + 4 + 5 + PROBES
    result.assert_outcomes(passed=count - unsure, skipped=1 + unsure, failed=1)
    assert moving is False


@pytest.mark.sample(1)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_run_that_is_interrupted_leaves_the_robot_at_rest(
    run: pytest.Pytester, number: signal.Signals
) -> None:
    with simulate() as robot:
        process = subprocess.Popen(
            [
                *(sys.executable, "-m", "pytest", *PLUGIN, "-v", "--robot-yes"),
                *("--robot-port", robot.port, "--robot-probe", robot.probe),
                *("--robot-only", "unused-id/*"),
            ],
            cwd=run.path,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )
        with process:
            assert process.stdout is not None
            for line in process.stdout:
                if "unused-id/9/3 PASSED" in line:
                    break
            process.send_signal(number)
            rest = process.stdout.read()
            assert process.wait(PATIENCE) == pytest.ExitCode.INTERRUPTED, rest
        moving = robot.state()["moving"]

    assert "unused-id/15/15" not in rest
    assert "KeyboardInterrupt" in rest
    assert moving is False


@pytest.mark.sample(1)
def test_ctrl_c_stops_the_robot_though_a_test_goes_on(run: pytest.Pytester) -> None:
    run.makepyfile(
        "import time\n"
        "def test_it(robot):\n"
        "    robot.send('Speed', speed=200)\n"
        "    robot.send('Forward')\n"
        "    try: time.sleep(90)\n"
        "    finally: time.sleep(90)\n"
    )
    with simulate() as robot:
        words = [*PLUGIN, "--robot-yes", "--robot-port", robot.port, *run.path.glob("*.py")]
        process = subprocess.Popen([sys.executable, "-m", "pytest", *words], cwd=run.path)
        until(lambda: robot.state()["moving"])
        process.send_signal(signal.SIGINT)
        until(lambda: not robot.state()["moving"])
        process.kill()
        process.wait()


# -- what it costs --------------------------------------------------------------------------------


def test_who_does_not_use_it_imports_nothing_of_the_kit(run: pytest.Pytester) -> None:
    run.makepyfile(
        "import sys\n"
        "def test_it():\n"
        "    kit = ('bilprov', 'construct', 'serial', 'rich')\n"
        "    found = {m for m in sys.modules if m.split('.')[0] in kit}\n"
        "    plugin = 'bilprov.conformance.pytest_plugin'\n"
        "    assert found == {'bilprov', 'bilprov.conformance', plugin}\n"
    )

    pytested(run, alone=True).assert_outcomes(passed=1)


def test_an_installed_kit_is_found_through_its_entry_point(
    run: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As an installer writes down what pyproject.toml declares."""
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    info = run.path / "site" / "bilprov-0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: bilprov\nVersion: 0\n")
    rows = "".join(f"{name} = {where}\n" for name, where in declared["pytest11"].items())
    (info / "entry_points.txt").write_text(f"[pytest11]\n{rows}")
    monkeypatch.setenv("PYTHONPATH", f"{info.parent}{os.pathsep}{ROOT / 'src'}")
    monkeypatch.delenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD")
    run.makepyfile("def test_it(robot): assert robot.send('Stop').code == 0")

    result = run.runpytest_subprocess("--robot-port", "sim", *FEW, "-p", "no:randomly")

    result.assert_outcomes(passed=15 + PROBES)
