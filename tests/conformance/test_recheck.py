"""Recheck: a recorded run, judged again from its bytes and observations, gives the same result."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import pytest

from bilprov.analyzer.client.operations import Ended
from bilprov.captures import topics
from bilprov.captures.errors import CaptureError
from bilprov.captures.reader import open_capture
from bilprov.conformance.api import Options
from bilprov.conformance.dut.simulator import Simulator
from bilprov.conformance.dut.target import Observability
from bilprov.conformance.recheck import recheck
from bilprov.conformance.report.json_report import as_json
from bilprov.spec.protocol import GrammarError, Protocol
from tests.support.commands import command
from tests.support.faults import BANK
from tests.support.messages import Message, messages
from tests.support.recordings import attachments_of, forged, recorded
from tests.support.robots import FEW_LOOKS, judged_exit, sentence, simulate, simulated

SOME = ("bad-data/LED/8", "unused-id/9/*", "wrong-length/*/0", "valid/Speed/25*", "recovery/*")


LED, SLOW = ("valid/LED/*",), "R-answer-deadline=150-ms"


def same(path: Path, report: Any) -> None:
    """The recheck says the same, and its report is the run's to the last byte."""
    found = recheck(str(path))
    assert found.differences == ()
    assert found.exit == 0
    assert found.report is not None
    assert as_json(found.report) == as_json(report) == attachments_of(path)["verdict.json"]


# -- the same -------------------------------------------------------------------------------------


FAMILIES = {fault.family: name for name, fault in BANK.items()}
FEW_OF_EACH = sorted({*FAMILIES.values(), *list(BANK)[::20]})


@pytest.mark.sample(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", FEW_OF_EACH)
def test_a_faulty_device_comes_out_as_faulty_as_it_was(
    tmp_path: Path, protocol: Protocol, name: str
) -> None:
    device = Simulator(protocol, BANK[name])
    report = recorded(tmp_path / "run.mcap", protocol, *SOME[:3], device=device)

    same(tmp_path / "run.mcap", report)


@pytest.mark.slow
@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("options", "fault", "code"),
    [
        (Options(only=SOME), "", 0),
        (Options(only=SOME, seed=7), "", 0),
        (Options(only=("truncated/LED/0", "timing/*"), truncation_timeout=30.0), "", 0),
        (Options(only=SOME[:2], strict=True, deadline=20.0, silence=5.0), "", 0),
        (Options(only=("timing/truncation-timeout",)), "", 0),
        (Options(only=SOME, fail_fast=True), "restarts-by-itself", 1),
        (Options(only=LED, strict=True, deadline=200.0), SLOW, 0),
        (Options(only=LED, strict=True), SLOW, 1),
    ],
)
def test_the_options_of_the_run_hold_again(
    tmp_path: Path, protocol: Protocol, options: Options, fault: str, code: int
) -> None:
    device = simulated(protocol, fault)

    report = recorded(tmp_path / "run.mcap", protocol, options=options, device=device)

    assert report.exit == code
    assert report.counts["skipped"] or not options.fail_fast
    same(tmp_path / "run.mcap", report)


@pytest.mark.parametrize("observability", [Observability(available=False), FEW_LOOKS])
def test_what_could_not_be_seen_cannot_be_seen_again(
    tmp_path: Path, protocol: Protocol, observability: Observability
) -> None:
    report = recorded(tmp_path / "run.mcap", protocol, *SOME, observability=observability)

    assert report.exit == 3
    same(tmp_path / "run.mcap", report)


@pytest.mark.parametrize(
    ("after", "why"), [(0, True), (3, "disk full"), (60, True), (200, "disk full")]
)
def test_an_interrupted_run_is_interrupted_again(
    tmp_path: Path, protocol: Protocol, after: int, why: bool | str
) -> None:
    asks = iter(range(10_000))
    report = recorded(
        tmp_path / "run.mcap",
        protocol,
        *SOME,
        interrupted=lambda: why if next(asks) >= after else False,
    )

    assert report.ended
    same(tmp_path / "run.mcap", report)
    assert "the run ended early" in recheck(str(tmp_path / "run.mcap")).notes[0]


@pytest.mark.parametrize(("at", "works"), [(0, True), (1, False), (40, False), (90, True)])
def test_a_link_that_fails_fails_again(
    tmp_path: Path, protocol: Protocol, at: int, works: bool
) -> None:
    def broken(asks: int) -> None:
        if asks == at:
            raise Ended("the probe went", error=True, line_works=works)

    report = recorded(tmp_path / "run.mcap", protocol, *SOME, broken=broken)

    assert report.ended == "the probe went"
    same(tmp_path / "run.mcap", report)


@pytest.mark.slow
def test_another_grammar_travels_with_the_recording(tmp_path: Path, horn: Protocol) -> None:
    only = ("valid/Horn/*", "bad-data/Horn/4")
    report = recorded(tmp_path / "run.mcap", horn, *only, device=Simulator(horn))

    assert {"valid/Horn/3", "bad-data/Horn/4"} <= {result.id for result in report.results}
    same(tmp_path / "run.mcap", report)


@pytest.mark.sample(1)
@pytest.mark.parametrize("pty", [False, True], ids=["tcp", "pty"])
def test_a_run_in_real_time_comes_out_the_same(tmp_path: Path, pty: bool) -> None:
    run, report, again = (tmp_path / name for name in ("run.mcap", "run.json", "again.json"))
    with simulate(pty=pty) as served:
        ran = command(
            *("conform", served.port, "--probe", served.probe, "--yes", "--record", str(run)),
            *("--json", str(report), "--level", "smoke"),
            *("--only", "truncated/*", "--only", "unused-id/9/*"),
        )
    verdict = json.loads(report.read_bytes())["verdict"]
    assert judged_exit(ran.returncode, json.loads(report.read_bytes())) == 0, ran.stderr

    result = command("recheck", str(run), "--json", str(again))

    count = len(json.loads(report.read_bytes())["cases"])
    assert result.stdout.decode() == f"the same: {count} cases, verdict {verdict}\n"
    assert (result.returncode, result.stderr) == (0, b"")
    made, judged = (json.loads(file.read_bytes()) for file in (report, again))
    # A recording is judged the same whenever and wherever that is done.
    assert judged == made | {"begun": None, "took_s": None, "host": None, "versions": {}}


# -- not the same ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory, protocol: Protocol) -> Path:
    """A recording of a device that fails some cases and passes others."""
    path = tmp_path_factory.mktemp("faulty") / "run.mcap"
    device = Simulator(protocol, BANK["restarts-by-itself"])
    report = recorded(path, protocol, *SOME, device=device)
    assert {"fail", "pass"} <= {name for name, count in report.counts.items() if count}
    return path


def changed(topic: str, number: int, **values: Any) -> Callable[[Message], Message]:
    """A change of the so-manieth message of a topic; bytes as `data`."""
    seen = iter(range(1 << 30))

    def change(message: Message) -> Message:
        if message.topic != topic or next(seen) != number:
            return message
        if isinstance(message.value, bytes):
            return msgspec.structs.replace(message, value=values["data"])
        return msgspec.structs.replace(message, value={**message.value, **values})

    return change


def with_run(
    faulty: Path, change: Callable[[Message], Message] | None = None, **about: Any
) -> Path:
    """The recording with other facts about its run, and with some of its options changed."""
    run = json.loads(attachments_of(faulty)["run.json"])
    run |= about | {"options": run["options"] | about.get("options", {})}
    changes = [change] if change else []
    to = faulty.with_name("forged.mcap")
    to.unlink(missing_ok=True)
    return forged(faulty, to, *changes, run_json=json.dumps(run).encode())


@pytest.mark.parametrize(
    ("topic", "number", "values", "case"),
    [
        (topics.DEVICE_RAW, 0, {"data": b"\x09"}, "power-on/Speed"),
        (topics.DEVICE_RAW, 1, {"data": b"\x09"}, "link/unused-id"),
        (topics.DEVICE_RAW, 2, {"data": b"\x09"}, "link/too-few"),
        (topics.LOOKS, 0, {"moving": True}, "power-on/at-rest"),
    ],
)
def test_a_forged_answer_or_look_is_told_by_a_verdict(
    faulty: Path, tmp_path: Path, topic: str, number: int, values: dict[str, Any], case: str
) -> None:
    found = recheck(str(forged(faulty, tmp_path / "f.mcap", changed(topic, number, **values))))

    assert found.exit == 1
    told = {(d.about, d.recorded, d.judged) for d in found.differences}
    # Judged again, the run may go another way from there: then its case has no verdict at all.
    assert told & {(case, "pass", "fail"), (case, "pass", "not judged")}


def test_forged_host_bytes_are_not_what_the_run_sends(faulty: Path, tmp_path: Path) -> None:
    found = recheck(
        str(forged(faulty, tmp_path / "f.mcap", changed(topics.HOST_RAW, 5, data=b"\x99")))
    )

    assert found.exit == 1
    assert found.report is None
    assert "sends 99, the kit now" in found.differences[-1].judged


def test_a_forged_verdict_is_not_trusted(faulty: Path, tmp_path: Path) -> None:
    marks = list(messages(open_capture(faulty), {topics.CASES}))
    values = [m.value for m in marks if isinstance(m.value, dict)]
    number = next(i for i, value in enumerate(values) if value["verdict"] == "fail")
    forgery = changed(topics.CASES, number, verdict="pass", reason="")
    file = forged(faulty, tmp_path / "f.mcap", forgery)

    result = command("recheck", str(file))

    assert result.returncode == 1
    line, last = result.stdout.decode().splitlines()
    assert line == f"{values[number]['id']}: verdict recorded: pass; judged again: fail"
    assert last == "not the same: 1 difference"


@pytest.mark.slow
@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("exit",), 0),
        (("verdict",), "pass"),
        (("counts", "fail"), 0),
        (("profile", "latency_max_ms"), 0.5),
        (("cases", 3, "axes", "answer", "verdict"), "non-strict"),
        (("cases", 3, "received"), []),
        (("cases", 3, "id"), "no/such/case"),
    ],
)
def test_a_forged_report_is_not_trusted(
    faulty: Path, tmp_path: Path, path: tuple[Any, ...], value: object
) -> None:
    report = part = json.loads(attachments_of(faulty)["verdict.json"])
    ident = report["cases"][3]["id"]
    for name in path[:-1]:
        part = part[name]
    assert part[path[-1]] != value
    part[path[-1]] = value
    file = forged(faulty, tmp_path / "f.mcap", verdict_json=json.dumps(report).encode())

    found = recheck(str(file))

    assert found.exit == 1
    about = {difference.about for difference in found.differences}
    assert about <= {"the report", "no/such/case", ident}


def test_a_recording_that_goes_on_after_the_run_is_not_the_same(faulty: Path) -> None:
    assert recheck(str(with_run(faulty, options={"only": SOME[:1]}))).exit == 1


def test_what_is_worded_otherwise_is_no_difference(faulty: Path, tmp_path: Path) -> None:
    report = json.loads(attachments_of(faulty)["verdict.json"])
    for case in report["cases"]:
        case["requirement"] = "as another version worded it"
        for axis in case["axes"].values():
            axis |= {"expected": "so", "actual": "so", "reason": "so"}
    files = {"verdict_json": json.dumps(report).encode()}

    def reworded(message: Message) -> Message:
        if message.topic != topics.CASES:
            return message
        assert isinstance(message.value, dict)
        return msgspec.structs.replace(message, value={**message.value, "reason": "so"})

    found = recheck(str(forged(faulty, tmp_path / "f.mcap", reworded, **files)))

    assert (found.exit, found.differences) == (0, ())


@pytest.mark.parametrize("only", [SOME[:1], ("valid/Stop", *SOME)], ids=["fewer", "others"])
def test_cases_of_another_version_that_are_no_longer_made_are_no_difference(
    faulty: Path, only: tuple[str, ...]
) -> None:
    result = command("recheck", str(with_run(faulty, kit="0.0.1", options={"only": only})))

    assert result.returncode == 3
    assert "no longer makes all of its cases" in result.stderr.decode()
    assert result.stdout.decode().endswith("as far as it could be judged again\n")


def test_a_verdict_of_another_version_is_compared_as_far_as_its_cases_are_made(
    faulty: Path,
) -> None:
    forgery = changed(topics.LOOKS, 0, moving=True)
    found = recheck(str(with_run(faulty, forgery, kit="0.0.1", options={"only": SOME[:1]})))

    assert found.exit == 1
    assert found.differences[0].about == "power-on/at-rest"


def test_another_version_of_the_kit_is_said(faulty: Path) -> None:
    result = command("recheck", str(with_run(faulty, kit="9.9", options={"unheard_of": 5})))

    assert result.returncode == 0
    assert "recorded by bilprov 9.9" in result.stderr.decode()


# -- cut, hostile ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_recording_that_was_never_finished_is_judged_as_far_as_it_goes(
    faulty: Path, tmp_path: Path
) -> None:
    content = faulty.read_bytes()
    path, counts = tmp_path / "cut.mcap", []
    end = content.index(b"profile.json")
    for at in range(0, end, end // 10):
        path.write_bytes(content[:at])
        with suppress(CaptureError):
            found = recheck(str(path))
            assert (found.exit, found.differences) == (3, ()), at
            assert "never finished" in " ".join(found.notes)
            counts.append(found.cases)

    assert counts == sorted(counts)
    assert counts[-1] > counts[0]

    result = command("recheck", str(path))
    assert result.returncode == 3
    assert result.stdout.decode().startswith(f"the same: {counts[-1]} cases, verdict fail, as far")


def test_a_killed_run_leaves_what_can_be_judged(tmp_path: Path, protocol: Protocol) -> None:
    class Killed(BaseException):
        """Nothing in the kit catches it."""

    calls = iter(range(10_000))

    def interrupted() -> bool:
        if next(calls) > 600:  # two for each operation
            raise Killed
        return False

    with pytest.raises(Killed):
        recorded(tmp_path / "run.mcap", protocol, *SOME, interrupted=interrupted)
    found = recheck(str(tmp_path / "run.mcap"))

    assert (found.exit, found.differences) == (3, ())
    assert found.cases > 5
    assert found.notes == ("it ends before its run did: what is there was judged again",)


def test_a_grammar_that_does_more_than_declare_is_not_run(
    faulty: Path, tmp_path: Path, grammar_text: str
) -> None:
    witness = tmp_path / "witness"
    evil = f"{grammar_text}\nopen({str(witness)!r}, 'w')\n"
    file = forged(faulty, tmp_path / "f.mcap", grammar=evil)

    result = command("recheck", str(file))

    assert result.returncode == 2
    assert "does more than declare" in sentence(result)
    assert not witness.exists()
    with pytest.raises(GrammarError):
        recheck(str(file))


@pytest.mark.slow
@pytest.mark.parametrize("content", [b"{}", b"[" * 100_000], ids=["empty", "deep"])
def test_what_the_run_rests_on_may_be_anything(
    faulty: Path, tmp_path: Path, content: bytes
) -> None:
    for name in ("run_json", "verdict_json"):
        file = forged(faulty, tmp_path / f"{name}.mcap", **{name: content})
        with pytest.raises(CaptureError, match="cannot be read"):
            recheck(str(file))


@pytest.mark.slow
@pytest.mark.sample(2)
@pytest.mark.parametrize(
    "options",
    [{"deadline": 1e308}, {"truncation_timeout": -1e308}, {"only": ["nothing"]}, {"seed": 1 << 62}],
)
def test_options_may_be_anything(faulty: Path, options: dict[str, Any]) -> None:
    with suppress(CaptureError):
        assert recheck(str(with_run(faulty, options=options))).exit == 1


@pytest.mark.sample(2)
@pytest.mark.slow
@pytest.mark.parametrize(
    "values",
    [
        {"t": 1 << 63},
        {"t": -(1 << 63)},
        {"ask": "power"},
        {"ask": "interrupt"},
        {"ended": "\x1b[2Jno", "error": True, "line_works": True},
        {"begun": None},
    ],
)
@pytest.mark.parametrize("number", [0, 40])
def test_steps_may_be_anything(
    faulty: Path, tmp_path: Path, number: int, values: dict[str, Any]
) -> None:
    file = forged(faulty, tmp_path / "f.mcap", changed(topics.ASKS, number, **values))

    result = command("recheck", str(file))

    assert result.returncode in (0, 1)
    assert b"Traceback" not in result.stderr
    assert b"\x1b" not in result.stdout + result.stderr
