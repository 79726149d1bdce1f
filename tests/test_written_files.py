"""Files that commands write: whole or not at all, named where they fail, never through a plant.

A table has every option that asks for a file; what is held of all of them is tested for each. What
one command shows is in tests/transcripts/written_files.txt.
"""

from __future__ import annotations

import os
import resource
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from bilprov.analyzer.files import write_whole
from tests.support.commands import Done, command, process
from tests.support.robots import sentence

FEW = "--only valid/LED/1"
# {runs} has the captures and reports that are read.
REPORTS = {
    "conform --json": f"conform sim {FEW} --json",
    "conform --html": f"conform sim {FEW} --html",
    "conform --junit": f"conform sim {FEW} --junit",
    "conform --markdown": f"conform sim {FEW} --markdown",
    "conform --profile": f"conform sim {FEW} --profile",
    "recheck --json": "recheck {runs}/run.mcap --json",
    "report --html": "report {runs}/run.json --html",
    "score --json": "lab score --only always-1 --level smoke --jobs 1 --json",
    "compare --json": "capture diff {runs}/run.mcap {runs}/run.mcap --json",
    "stats --json": "stats {runs}/run.mcap --json",
    "plot --html": "plot {runs}/run.mcap --html",
    "export csv": "export {runs}/run.mcap --format csv -o",
    "export jsonl": "export {runs}/run.mcap --format jsonl -o",
    "export parquet": "export {runs}/run.mcap --format parquet -o",
    "export pcapng": "export {runs}/run.mcap --format pcapng -o",
    "spec emit c": "spec emit c -o",
    "spec emit wireshark": "spec emit wireshark -o",
    "spec emit grammar": "spec emit grammar -o",
}
CAPTURES = {
    "cut": "capture cut --start 0 {runs}/run.mcap",
    "recover": "capture repair {runs}/run.mcap",
    "convert": "capture decode {runs}/run.mcap",
}
RECORDED = {"conform --record": f"conform sim {FEW} --record"}
PROFILE = "conform --profile"  # one that exists is read first: a device is none


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recorded run, and its report."""
    folder = tmp_path_factory.mktemp("runs")
    made = command(
        *f"conform sim {FEW} --record {folder}/run.mcap --json {folder}/run.json".split()
    )
    assert made.returncode == 0
    return folder


def words(name: str, runs: Path, file: Path | str) -> list[str]:
    every = REPORTS | CAPTURES | RECORDED
    return [*every[name].format(runs=runs).split(), str(file)]


def refused(result: Done, file: Path | str) -> None:
    """The command ended with 2, and the last sentence names the file."""
    assert result.returncode == 2, result
    assert str(file) in sentence(result)


@pytest.mark.sample(3)
@pytest.mark.parametrize("name", sorted({*REPORTS} - {PROFILE}))
def test_a_file_for_which_there_is_no_room_is_named(name: str, runs: Path) -> None:
    refused(command(*words(name, runs, "/dev/full")), "/dev/full")


def limited(size: int) -> Callable[[], None]:
    """Lets a process write files of so many bytes."""
    return partial(resource.setrlimit, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


@pytest.mark.sample(2)
@pytest.mark.waits
@pytest.mark.parametrize("name", REPORTS | CAPTURES)
def test_a_file_that_grows_too_large_is_named_and_nothing_is_left_of_it(
    name: str, runs: Path, tmp_path: Path
) -> None:
    file = tmp_path / "asked"

    refused(process(*words(name, runs, file), preexec_fn=limited(30)), file)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.waits
def test_a_recording_that_could_not_be_finished_is_named_and_no_verdict(tmp_path: Path) -> None:
    """It stays as far as it goes, since nobody can drive the same way again."""
    file = tmp_path / "run.mcap"
    arguments = [*words("conform --record", tmp_path, file), "--fault", "always-1"]
    refused(process(*arguments, preexec_fn=limited(1024)), file)


@pytest.mark.sample(6)
@pytest.mark.parametrize("name", REPORTS | CAPTURES | RECORDED)
@pytest.mark.parametrize("named", ["drive.mcap", "drive"])
def test_a_capture_is_not_overwritten_by_anything(
    name: str, named: str, runs: Path, tmp_path: Path
) -> None:
    file, whole = tmp_path / named, (runs / "run.mcap").read_bytes()
    file.write_bytes(whole[100:] if named.endswith(".mcap") else whole)  # damaged, and renamed
    before = file.read_bytes()

    refused(command(*words(name, runs, file)), file)
    assert file.read_bytes() == before


# -- links -----------------------------------------------------------------------------------------


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    """A file that somebody wants to be overwritten."""
    file = tmp_path / "victim"
    file.write_bytes(b"mine")
    return file


def test_the_temporary_file_beside_is_a_new_one_whoever_planted_what(
    victim: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here its name can be guessed, which it cannot otherwise."""
    asked = tmp_path / "asked"
    monkeypatch.setattr(os, "urandom", bytes)
    for planted in (f".asked.{'0' * 16}.part", f".asked.{os.getpid()}.part", ".asked.part"):
        (tmp_path / planted).symlink_to(victim)

    with pytest.raises(FileExistsError):
        write_whole(asked, b"new")

    assert victim.read_bytes() == b"mine"
    assert not asked.exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can make a link of another user")
@pytest.mark.parametrize("exists", [True, False])
def test_a_link_of_another_user_in_a_shared_folder_is_not_followed(
    exists: bool, victim: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "shared"
    folder.mkdir()
    folder.chmod(0o1777)
    asked = folder / "asked"
    asked.symlink_to(victim)
    os.lchown(asked, 12345, 12345)
    if not exists:
        victim.unlink()

    with pytest.raises(PermissionError, match="another user made this link"):
        write_whole(asked, b"new")

    assert victim.exists() is exists
