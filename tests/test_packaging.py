"""The lock, and the wheel that is built from the sdist, in a clean environment.

The wheel stands beside a user's own `spec/`, `tests/` and `analyzer.py`: no names collide.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
import venv
from collections.abc import Iterator
from importlib.metadata import Distribution, distribution
from pathlib import Path

import pytest
from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.support import ROOT

LOCK = (ROOT / "requirements.lock").read_text(encoding="utf-8")
# A comment, or a package with one version, perhaps a marker, and the hashes of its files.
COMMENT = r"#[^\n]*\n"
HASH = r" \\\n    --hash=sha256:[0-9a-f]{64}"
PACKAGE = rf"(?P<name>[a-z0-9-]+)==(?P<version>[0-9a-z.]+)(?: ; (?P<marker>[^\\\n]+))?(?:{HASH})+\n"
BUILD_SDIST = "import sys, setuptools.build_meta as b; b.build_sdist(sys.argv[1])"
PIP = ("-m", "pip", "--quiet", "--disable-pip-version-check")
OFFLINE = ("--no-index", "--no-deps")

SCRIPT = """\
from bilprov import decode

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


def required() -> Iterator[Requirement]:
    """What pyproject.toml asks for: to build, to run, and in each extra."""
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    project = pyproject["project"]
    extras = project["optional-dependencies"].values()
    for lines in (pyproject["build-system"]["requires"], project["dependencies"], *extras):
        yield from map(Requirement, lines)


def needed(requirement: Requirement) -> Iterator[Distribution]:
    """The installed distribution that a requirement names, and those that it needs."""
    found = distribution(requirement.name)
    yield found
    for part in map(Requirement, found.requires or ()):
        extras = requirement.extras | {""}
        if not part.marker or any(part.marker.evaluate({"extra": extra}) for extra in extras):
            yield from needed(part)


def link_libraries(packages: Path) -> None:
    """Put what the package and its plugin for pytest need into an environment, and nothing else."""
    _, *libraries = needed(Requirement("bilprov[pytest]"))
    for library in libraries:
        for top in {file.parts[0] for file in library.files or ()} - {"..", "__pycache__"}:
            if not (packages / top).exists():
                (packages / top).symlink_to(Path(str(library.locate_file(top))))


def installed(wheel: Path) -> Path:
    """A folder of a user's: the wheel in a clean environment, and what collided once.

    Nothing is fetched: the libraries are links to those of this environment.
    """
    folder = wheel.parent
    venv.create(folder / "venv")
    python = folder / "venv" / "bin" / "python"
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    link_libraries(Path(run(python, "-c", where, cwd=folder).strip()))
    run(sys.executable, *PIP, "--python", python, "install", *OFFLINE, wheel, cwd=folder)
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

    package = page.parents[2]
    assert package.is_relative_to(site / "venv")
    assert {p.name for p in package.parent.glob("*") if p.name in ("spec", "analyzer")} == set()
    assert (package / "py.typed").exists()
    for room in ("spec", "captures", "analyzer", "conformance"):
        files = {
            path.relative_to(ROOT)
            for path in (ROOT / room).rglob("[!.]*")
            if path.is_file()
            and "__pycache__" not in path.parts
            and not path.is_relative_to(ROOT / "captures" / "samples")
        }
        assert {file for file in files if not (package / file).exists()} == set()


def runs_the_command(site: Path) -> None:
    for start in (["venv/bin/bilprov"], ["venv/bin/python", "-m", "bilprov"]):
        out = run(site / start[0], *start[1:], "decode", "11", "ff", cwd=site / "project")
        assert "Speed speed=255" in out
    bilprov = site / "venv/bin/bilprov"
    version = distribution("bilprov").version
    assert run(bilprov, "--version", cwd=site / "project") == f"bilprov {version}\n"


def runs_the_users_tests(site: Path) -> None:
    pytested = ("-m", "pytest", "-q", "-p", "no:cacheprovider")
    only = ("--robot-port", "sim", "--robot-only", "valid/LED/1", "tests/test_it.py")
    out = run(site / "venv/bin/python", *pytested, *only, cwd=site / "project")

    assert "passed" in out


@pytest.mark.slow
@pytest.mark.waits
@pytest.mark.timeout(300)
def test_a_wheel_built_from_the_sdist_is_whole_and_works_beside_the_users_own_modules(
    tmp_path: Path,
) -> None:
    made = shutil.ignore_patterns(".*", "build", "dist", "*.egg-info", "__pycache__")
    source = shutil.copytree(ROOT, tmp_path / "source", symlinks=True, ignore=made)
    run(sys.executable, "-c", BUILD_SDIST, tmp_path, cwd=source)
    shutil.rmtree(source)
    (sdist,) = tmp_path.glob("*.tar.gz")
    run(sys.executable, *PIP, "wheel", *OFFLINE, "--no-build-isolation", sdist, cwd=tmp_path)
    (wheel,) = tmp_path.glob("*.whl")

    site = installed(wheel)

    holds_one_package_and_all_of_it(site)
    runs_the_command(site)
    assert run(site / "venv/bin/python", "drive.py", cwd=site / "project") == "LED\n"
    runs_the_users_tests(site)


def test_the_lock_is_packages_with_their_hashes_and_names_no_registry() -> None:
    assert re.sub(rf"(?m)^(?:{COMMENT}|{PACKAGE})", "", LOCK) == ""
    assert "/" not in LOCK


def test_the_lock_has_each_package_that_is_asked_for_and_all_that_they_need() -> None:
    locked = {
        found["name"]: found["version"]
        for found in re.finditer(PACKAGE, LOCK)
        if not found["marker"] or Marker(found["marker"]).evaluate()
    }
    for requirement in required():
        assert locked[canonicalize_name(requirement.name)] in requirement.specifier

    installed = {d for requirement in required() for d in needed(requirement)}

    assert {canonicalize_name(d.name): d.version for d in installed} == locked
