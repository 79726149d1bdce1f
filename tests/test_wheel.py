"""The installed wheel beside a user's own `spec/`, `tests/` and `analyzer.py`: no names collide."""

from __future__ import annotations

import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from tests.support import ROOT

pytestmark = pytest.mark.waits

SCRIPT = """\
from bilprov import Robot, decode


def drive(url: str) -> int:
    with Robot(url) as robot:
        return robot.speed(127).code


print(decode(b"\\x81\\x05")[0].value.name)
"""
TEST = """\
import analyzer
import spec.mine
import tests.shared


def test_ours_and_theirs(robot):
    assert (analyzer.MINE, spec.mine.MINE, tests.shared.MINE) == (1, 2, 3)
    assert robot.send("Stop").code == 0
"""


def run(*words: str | Path, cwd: Path) -> str:
    """The output of a program that must end well."""
    done = subprocess.run(
        [str(word) for word in words], cwd=cwd, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of a user's with the wheel in an environment of its own, and what collided once.

    The libraries are those of this environment: a path file after the wheel's own.
    """
    folder = tmp_path_factory.mktemp("user")
    source = folder / "source"
    shutil.copytree(ROOT, source, symlinks=True, ignore=shutil.ignore_patterns(".*", "build"))
    build = ("-m", "pip", "wheel", "-q", "--no-deps", "--disable-pip-version-check")
    run(sys.executable, *build, "-w", folder, source, cwd=folder)
    (wheel,) = folder.glob("*.whl")
    venv.create(folder / "venv", with_pip=True)
    python = folder / "venv" / "bin" / "python"
    install = ("-m", "pip", "install", "-q", "--no-deps", "--disable-pip-version-check")
    run(python, *install, wheel, cwd=folder)
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    mine = Path(run(python, "-c", where, cwd=folder).strip())
    theirs = run(sys.executable, "-c", where, cwd=folder).strip()
    (mine / "libraries.pth").write_text(f"{theirs}\n")
    project = folder / "project"
    for name, text in {
        "spec/__init__.py": "",
        "spec/mine.py": "MINE = 2\n",
        "tests/__init__.py": "",
        "tests/shared.py": "MINE = 3\n",
        "tests/test_it.py": TEST,
        "analyzer.py": "MINE = 1\n",
        "drive.py": SCRIPT,
    }.items():
        file = project / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return folder


def holds_one_package_and_all_of_it(site: Path) -> None:
    code = "import bilprov.conformance.report.html as h; print(h.__path__[0])"
    page = Path(run(site / "venv/bin/python", "-c", code, cwd=site / "project").strip())

    installed = page.parents[2]
    assert installed.is_relative_to(site / "venv")
    assert {p.name for p in installed.parent.glob("*") if p.name in ("spec", "analyzer")} == set()
    for package in ("spec", "captures", "analyzer", "conformance"):
        files = {p.relative_to(ROOT / package) for p in (ROOT / package).rglob("*.py")}
        assert {f for f in files if not (installed / package / f).exists()} == set()
    for data in (
        "py.typed",
        "analyzer/client/robot.pyi",
        "conformance/report/html/assets/report.js",
    ):
        assert (installed / data).exists()


def runs_the_command(site: Path) -> None:
    for start in (["venv/bin/bilprov"], ["venv/bin/python", "-m", "bilprov"]):
        out = run(site / start[0], *start[1:], "decode", "11", "ff", cwd=site / "project")
        assert "Speed speed=255" in out


def runs_a_script(site: Path) -> None:
    assert run(site / "venv/bin/python", "drive.py", cwd=site / "project") == "LED\n"


def type_checks_a_script(site: Path) -> None:
    mypy = (sys.executable, "-m", "mypy", "--strict", "--no-incremental")
    python = f"--python-executable={site / 'venv/bin/python'}"

    assert "Success" in run(*mypy, python, "drive.py", cwd=site / "project")


def runs_the_users_tests(site: Path) -> None:
    pytested = (
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:randomly",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:xdist",
    )
    only = ("--robot-port", "sim", "--robot-only", "valid/LED/1", "tests/test_it.py")
    out = run(site / "venv/bin/python", *pytested, *only, cwd=site / "project")

    assert "passed" in out


@pytest.mark.timeout(300)
def test_the_installed_wheel_works_beside_the_users_own_modules(site: Path) -> None:
    # One test, so that no second process builds the wheel again.
    holds_one_package_and_all_of_it(site)
    runs_the_command(site)
    runs_a_script(site)
    type_checks_a_script(site)
    runs_the_users_tests(site)
