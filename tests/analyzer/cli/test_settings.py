"""Settings: which place comes first, what a project's file may not do, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bilprov import __main__ as front_door
from bilprov.analyzer.cli.settings import PORTS
from bilprov.analyzer.settings import COMMON, DEVICE_KEYS, FORMER, read_settings
from tests.support import ROOT, commands
from tests.support.commands import Done

SAMPLE = ROOT / "captures" / "samples" / "examples.mcap"


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder; the user's file would stand in `home/bilprov` beside it."""
    folder = tmp_path / "work"
    folder.mkdir()
    (tmp_path / "home" / "bilprov").mkdir(parents=True)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))
    return folder


def command(*arguments: str) -> Done:
    return commands.command(*arguments, cwd=Path.cwd())


def mine(place: Path, text: str) -> None:
    (place.parent / "home" / "bilprov" / "config.toml").write_text(text)


def theirs(place: Path, text: str) -> None:
    (place / "bilprov.toml").write_text(text)


def shown(*arguments: str) -> dict[tuple[str, str], tuple[object, str, bool]]:
    """What `config show` says: value, source and use, by command and setting."""
    result = command("config", "show", *arguments, "--format", "json")
    assert (result.returncode, result.stderr) == (0, b"")
    return {
        (row["command"], row["setting"]): (row["value"], row["source"], row["used"])
        for row in json.loads(result.stdout)
    }


def refused(*arguments: str) -> str:
    result = command(*arguments)
    lines = result.stderr.decode().splitlines()
    assert (result.returncode, result.stdout, len(lines)) == (2, b"", 1)
    return lines[0].removeprefix("bilprov: ")


def test_the_users_file_is_in_the_home_where_no_other_place_is_set(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (place / ".config" / "bilprov").mkdir(parents=True)
    (place / ".config" / "bilprov" / "config.toml").write_text("baud = 9600")
    monkeypatch.delenv("XDG_CONFIG_HOME")
    monkeypatch.setenv("HOME", str(place))
    source = str(place / ".config" / "bilprov" / "config.toml")
    assert shown()["all", "baud"] == (9600, source, True)


@pytest.mark.parametrize("name", FORMER)
def test_the_table_of_a_former_name_is_refused_with_the_new_one(
    place: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    now = f"bilprov {name} is now bilprov {' '.join(FORMER[name])}"
    theirs(place, f"[{name}]\nforce = 0")
    assert refused("encode", "Stop") == f"bilprov.toml [{name}]: {now}"

    theirs(place, "")
    monkeypatch.setenv(f"BILPROV_{name.upper()}_FORMAT", "json")
    assert refused("encode", "Stop") == f"BILPROV_{name.upper()}_FORMAT: {now}"


def test_the_options_of_a_device_come_before_the_files_and_after_the_environment(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine(place, "baud = 1200\n[device.car]\nport = '/dev/x'\nbaud = 9600")
    settings = read_settings(front_door.COMMANDS, {"XDG_CONFIG_HOME": str(place.parent / "home")})
    device = settings.device("car")
    assert settings.values_of("send", device)["baud"].value == 9600

    monkeypatch.setenv("BILPROV_BAUD", "300")
    settings = read_settings(front_door.COMMANDS)
    assert settings.values_of("send", device)["baud"].value == "300"


@pytest.mark.parametrize("word", ["sim", "./car", "/dev/car", "socket://car:1", "cart"])
def test_a_path_a_url_and_sim_are_never_a_name(place: Path, word: str) -> None:
    mine(place, "[device.car]\nport = '/dev/x'")

    assert read_settings(front_door.COMMANDS).device(word) is None


def test_a_file_of_that_name_is_a_path(place: Path) -> None:
    mine(place, "[device.car]\nport = '/dev/x'")
    assert read_settings(front_door.COMMANDS).device("car") is not None

    (place / "car").touch()
    assert read_settings(front_door.COMMANDS).device("car") is None


@pytest.mark.parametrize("path", ["out.html", "up/out.html", "nowhere.html"])
def test_a_projects_file_cannot_write_elsewhere_by_a_link(place: Path, path: str) -> None:
    (place.parent / "victim").write_text("mine")
    (place / "out.html").symlink_to("../victim")
    (place / "up").symlink_to("..")
    (place / "nowhere.html").symlink_to("../new")
    theirs(place, f"[conform]\nhtml = '{path}'")

    assert "outside this folder" in refused("encode", "Stop")
    assert (place.parent / "victim").read_text() == "mine"


def test_a_flag_may_be_a_number_or_a_word(place: Path) -> None:
    for value in ("0", "false", "'no'"):
        mine(place, f"yes = {value}")
        assert "no terminal to ask on" in refused("send", "/dev/ptmx", "00")
    mine(place, "yes = 2")
    assert "yes = 2: " in refused("send", "/dev/ptmx", "00")


@pytest.mark.waits
def test_settings_for_ports_are_left_alone_where_the_target_is_none(place: Path) -> None:
    mine(place, "probe = 'tcp:127.0.0.1:9'\n[conform]\npower = 'exec:false'")

    sim = ("conform", "sim", "--only", "valid/Stop*")
    assert command(*sim).returncode == 0
    assert "is for ports" in refused(*sim, "--probe", "tcp:127.0.0.1:9")
    assert "is for ports" in refused(*sim, "--power", "exec:true")
    shell = commands.command("send", "sim", stdin=b"Stop\n", cwd=place)
    assert (shell.returncode, b"Stop" in shell.stdout) == (0, True)


def test_a_device_at_another_port_has_not_what_was_allowed_for_the_first(place: Path) -> None:
    mine(place, "[device.car]\nport = '/nowhere/mine'\nbaud = 9600\nyes = true")
    theirs(place, "[device.car]\nbaud = 1200")
    assert "/nowhere/mine" in refused("send", "car", "00")

    theirs(place, "[device.car]\nport = '/nowhere/theirs'")
    device = read_settings(front_door.COMMANDS).device("car")
    assert device is not None
    assert {key: value.value for key, value in device.items()} == {"port": "/nowhere/theirs"}
    assert [used for *_, used in shown().values()] == [True, False, False]


@pytest.mark.waits
def test_a_ring_of_links_and_a_nul_are_no_bug(place: Path) -> None:
    (place / "a").symlink_to("b")
    (place / "b").symlink_to("a")
    theirs(place, "[conform]\nhtml = 'a'")
    assert command("encode", "Stop").stdout == b"00\n"
    assert command("conform", "sim", "--level", "smoke", "--only", "valid/Stop*").returncode == 0

    theirs(place, '[conform]\nhtml = "x\\u0000"')
    assert "bilprov.toml [conform]: html holds a NUL character" in refused("encode", "Stop")


def test_every_common_setting_is_an_option_of_some_command() -> None:
    options = {"grammar"}
    for name in front_door.COMMANDS:
        result = command("config", "show", name, "--format", "json")
        assert result.returncode == 0, result.stderr
        options |= {row["setting"] for row in json.loads(result.stdout)}

    assert set(COMMON) <= options
    assert set(DEVICE_KEYS) - {"port"} <= options


@pytest.mark.parametrize("name", PORTS)
def test_the_parameters_that_may_be_a_device_are_there(name: str) -> None:
    found, _ = commands.command_named(name)
    assert set(PORTS[name]) <= {param.name for param in found.params}
