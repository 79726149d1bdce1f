"""What failed last is kept for each device, and `conform` runs it alone or first.

The simulator with a fault is a device of its own: what failed of it is written for the one without.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from bilprov.conformance.cases.levels import Options
from bilprov.conformance.cli.last_run import LastRun, last_run
from bilprov.conformance.oracle.verdicts import Cause, Verdict
from bilprov.conformance.recheck import recheck
from bilprov.spec.protocol import Protocol
from tests.support.commands import Done, command
from tests.support.reports import a_case, a_run

FAULTY = ("--fault", "no-stop-on-bad-data")
BAD_DATA = ("--only", "bad-data/LED/*")

ALL = "none of the cases asked for is known to have failed: all of them are run"

Conform = Callable[..., Done]


@pytest.fixture
def conform(tmp_path: Path) -> Conform:
    """`conform sim --level smoke`, with a state folder of its own."""

    def run(*words: str, level: str = "smoke") -> Done:
        state = str(tmp_path / "state")
        return command("conform", "sim", "--level", level, *words, XDG_STATE_HOME=state)

    return run


@pytest.fixture
def known(
    protocol: Protocol, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Callable[..., None]:
    """Writes that these cases failed in the last run of the simulator."""

    def write(*idents: str) -> None:
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
        replace(last_run(protocol, "sim"), failed=dict.fromkeys(idents, Verdict.FAIL)).keep()

    return write


def cases(run: Done) -> dict[str, str]:
    """The verdicts of the cases besides those that every run has, in their order."""
    report: dict[str, Any] = json.loads(run.stdout)
    openings = ("power-on/", "link/", "timing/", "reading/")
    found = {case["id"]: case["verdict"] for case in report["cases"]}
    return {ident: verdict for ident, verdict in found.items() if not ident.startswith(openings)}


def told(run: Done) -> str:
    return run.stderr.decode().splitlines()[0]


def listed(run: Done) -> list[str]:
    return [line.split()[0] for line in run.stdout.decode().splitlines()]


def test_what_failed_is_run_alone_until_nothing_fails(
    conform: Conform, known: Callable[..., None]
) -> None:
    failed = {i for i, v in cases(conform(*FAULTY, "--json", "-")).items() if v == "fail"}
    assert 1 < len(failed) < 40

    faulty = conform(*FAULTY, "--last-failed", "--list")  # and sends nothing
    assert set(listed(faulty)) == failed
    known(*failed)
    mended = conform("--last-failed", "--json", "-")
    assert told(mended) == f"only the cases that failed last ({len(failed)})"
    assert cases(mended) == dict.fromkeys(cases(mended), "pass")
    assert cases(mended).keys() == failed

    again = conform("--last-failed", *BAD_DATA, "--json", "-")
    assert told(again) == ALL
    assert cases(again).keys() == {"bad-data/LED/8"}


def test_a_faulty_simulator_is_another_device_than_one_with_another_fault(conform: Conform) -> None:
    conform(*FAULTY, *BAD_DATA)
    variant = ("--variant", "R-unused-length=too-many")
    others = [(), ("--fault", "ok-to-bad-data"), variant]

    assert [told(conform(*other, *BAD_DATA, "--last-failed", "--list")) for other in others] == (
        [ALL] * 3
    )
    assert told(conform(*FAULTY, "--last-failed", "--list")).endswith("failed last (1)")


def test_what_failed_is_run_first_and_a_recording_of_that_is_judged_the_same(
    conform: Conform, tmp_path: Path
) -> None:
    usual = list(cases(conform(*FAULTY, *BAD_DATA, "--only", "valid/LED/*", "--json", "-")))
    assert usual[0] != "bad-data/LED/8"
    record = tmp_path / "run.mcap"
    words = (*FAULTY, *BAD_DATA, "--only", "valid/LED/*", "--record", str(record), "--json", "-")

    run = conform("--failed-first", *words)

    assert told(run) == "first the cases that failed last (1)"
    assert list(cases(run)) == ["bad-data/LED/8", *(i for i in usual if i != "bad-data/LED/8")]
    assert recheck(str(record)).differences == ()


def test_a_run_of_some_cases_changes_only_these(
    conform: Conform, known: Callable[..., None]
) -> None:
    known("bad-data/LED/8", "valid/LED/0", "valid/Stop")
    before = listed(conform("--last-failed", "--list"))

    conform(*BAD_DATA)  # it conforms now

    assert listed(conform("--last-failed", "--list")) == [
        ident for ident in before if ident != "bad-data/LED/8"
    ]


def test_what_failed_and_is_not_asked_for_is_no_reason_to_run_nothing(
    conform: Conform, known: Callable[..., None]
) -> None:
    known("bad-data/LED/8", "unused-id/9/0")
    some = conform("--last-failed", "--only", "bad-data/*", "--list")
    none = conform("--last-failed", "--only", "valid/LED/*", "--list")

    assert listed(some) == ["bad-data/LED/8"]
    assert told(some).endswith("as asked for)")
    assert told(none) == ALL
    assert listed(none) == ["valid/LED/0"]


def test_each_device_and_grammar_has_its_own(
    protocol: Protocol, horn: Protocol, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    first = replace(last_run(protocol, "first"), failed={"a/b": Verdict.FAIL})
    first.keep()
    assert last_run(protocol, "first") == first
    assert last_run(horn, "first").failed == last_run(protocol, "second").failed == {}
    odd = replace(last_run(protocol, "/dev/tty\udcff\x1b"), failed={"a/b": Verdict.FAIL})
    odd.keep()
    assert last_run(protocol, "/dev/tty\udcff\x1b") == odd


@pytest.mark.parametrize("text", [b'{"failed": {"a": "fine"}}', b"\xff" * 100])
def test_a_damaged_or_unwritable_state_is_no_state(
    conform: Conform, tmp_path: Path, text: bytes
) -> None:
    conform(*FAULTY, *BAD_DATA)
    (file,) = (tmp_path / "state").rglob("*.json")
    file.write_bytes(text)
    assert told(conform(*FAULTY, "--last-failed", *BAD_DATA)) == ALL

    for path in (file, file.parent):
        path.unlink() if path.is_file() else path.rmdir()
    file.parent.write_bytes(b"")  # where the folder should be
    assert conform(*FAULTY, *BAD_DATA).returncode == 1
    assert told(conform(*FAULTY, "--last-failed", *BAD_DATA)) == ALL


# -- what a run leaves ----------------------------------------------------------------------------


@pytest.fixture
def before() -> LastRun:
    ids = ("made/fail", "made/pass", "gone/1")
    return LastRun("sim", "robot-car", dict.fromkeys(ids, Verdict.FAIL))


def after(before: LastRun, protocol: Protocol, *verdicts: Verdict, **changes: Any) -> list[str]:
    """What failed after a run in which a case had each of the verdicts; `only` are its globs."""
    report = a_run(protocol, "valid/LED/1")
    options = Options(only=changes.pop("only", ()), strict=changes.pop("strict", False))
    known = changes.pop("expected", ())
    results = tuple(
        replace(a_case(f"made/{verdict.label}", verdict), expected_failure=verdict in known)
        for verdict in verdicts
    )
    return list(before.after(replace(report, results=results, options=options, **changes)).failed)


def test_a_whole_run_leaves_what_failed_in_it(before: LastRun, protocol: Protocol) -> None:
    assert after(before, protocol, *Verdict) == ["made/fail"]
    assert after(before, protocol, Verdict.PASS) == []
    assert after(before, protocol, Verdict.NON_STRICT, strict=True) == ["made/non-strict"]


def test_a_partial_or_broken_run_leaves_what_it_did_not_judge(
    before: LastRun, protocol: Protocol
) -> None:
    assert after(before, protocol, Verdict.PASS, only=("made/*",)) == ["made/fail", "gone/1"]
    assert after(before, protocol, Verdict.PASS, ended="it was") == ["made/fail", "gone/1"]
    assert after(before, protocol, unusable="nobody answers") == list(before.failed)


@pytest.mark.parametrize("verdict", [Verdict.SKIPPED, Verdict.INCONCLUSIVE, Verdict.ERROR])
def test_what_could_not_be_judged_stays_failed(protocol: Protocol, verdict: Verdict) -> None:
    before = LastRun("sim", "robot-car", {f"made/{verdict.label}": Verdict.FAIL})

    assert after(before, protocol, verdict) == list(before.failed)


def test_what_is_expected_to_fail_does_not_count(before: LastRun, protocol: Protocol) -> None:
    assert after(before, protocol, *Verdict, expected=(Verdict.FAIL,)) == []


def test_a_cause_stays_known_while_none_of_its_cases_was_judged_again(protocol: Protocol) -> None:
    def cause(sentence: str, *cases: str) -> Cause:
        return Cause(sentence, "always", "answer", "section 3", cases, 0, ())

    old, partly, fixed = cause("old", "gone/1"), cause("partly", "a", "b"), cause("fixed", "c")
    before = LastRun("sim", "robot-car", dict.fromkeys(("gone/1", *"abc"), Verdict.FAIL))
    before = replace(before, causes=(old, partly, fixed))
    now = cause("now", "a")
    verdicts = {"a": Verdict.FAIL, "c": Verdict.PASS}
    results = tuple(replace(a_case("made", v), id=ident) for ident, v in verdicts.items())
    report = replace(a_run(protocol, "valid/LED/1"), results=results, causes=(now,), ended="it was")

    assert before.after(report).causes == (now, old)
