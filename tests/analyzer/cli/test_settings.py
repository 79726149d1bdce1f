"""Settings: what the user's file gives to commands, devices by name, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bilprov.analyzer.cli.settings import COMMON, DEVICE_KEYS, PortName
from bilprov.analyzer.former_names import FORMER
from tests.support import ROOT, commands
from tests.support.commands import Done

SAMPLE = ROOT / "captures" / "samples" / "examples.mcap"


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder; the user's file stands in `home/bilprov` beside it."""
    folder = tmp_path / "work"
    folder.mkdir()
    (tmp_path / "home" / "bilprov").mkdir(parents=True)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))
    return folder


def command(*arguments: str) -> Done:
    return commands.command(*arguments, cwd=Path.cwd())


def mine(place: Path, text: str) -> str:
    """Write the user's file; gives its path."""
    file = place.parent / "home" / "bilprov" / "config.toml"
    file.write_text(text)
    return str(file)


def shown() -> dict[tuple[str, str], object]:
    """What `config` shows: values by command and setting."""
    result = command("config", "--format", "json")
    assert (result.returncode, result.stderr) == (0, b"")
    return {(row["command"], row["setting"]): row["value"] for row in json.loads(result.stdout)}


def baud_of(*words: str) -> str:
    """The baud rate that a command takes, which must be none: as the sentence about it has it."""
    return refused(*words).partition("'--baud': ")[2].partition(" ")[0]


def refused(*arguments: str) -> str:
    result = command(*arguments)
    lines = result.stderr.decode().splitlines()
    assert (result.returncode, result.stdout, len(lines)) == (2, b"", 1), result
    return lines[0].removeprefix("bilprov: ")


def test_an_option_that_is_typed_comes_before_the_file(place: Path) -> None:
    mine(place, "[decode]\nformat = 'jsonl'\nfrom = 'device'")

    assert b'"kind":"response"' in command("decode", "00").stdout
    assert b'"kind":"instruction"' in command("decode", "00", "--from", "host").stdout


def test_neither_a_file_of_the_working_folder_nor_the_environment_sets_anything(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (place / "bilprov.toml").write_text("[decode]\nfrom = 'device'")
    monkeypatch.setenv("BILPROV_DECODE_FROM", "device")

    assert b'"kind":"instruction"' in command("decode", "00", "--format", "jsonl").stdout
    assert command("config").stdout.startswith(b"nothing is set")


def test_a_setting_for_all_commands_is_left_alone_by_those_without_it(place: Path) -> None:
    mine(place, "baud = 'nine'")

    assert command("encode", "Stop").stdout == b"00\n"
    assert baud_of("sniff", "/dev/x") == "'nine'"


def test_a_commands_own_table_comes_before_what_is_for_all(place: Path) -> None:
    mine(place, "baud = 'nine'\n[sniff]\nbaud = 'one'")

    assert baud_of("sniff", "/dev/x") == "'one'"
    assert baud_of("conform", "/dev/x") == "'nine'"


def test_config_shows_what_is_in_force(place: Path) -> None:
    mine(place, "baud = 9600\n[device.car]\nport = '/dev/ttyUSB7'\n[sniff]\nwait = true")

    assert shown() == {
        ("all", "baud"): 9600,
        ("device car", "port"): "/dev/ttyUSB7",
        ("sniff", "wait"): True,
    }
    for key, value in shown().items():
        assert all(part in command("config").stdout.decode() for part in (*key, str(value)))


def test_the_former_form_of_config_is_one_sentence(place: Path) -> None:
    assert "unexpected extra argument (show); see bilprov config" in refused("config", "show")


def test_the_users_file_is_in_the_home_where_no_other_place_is_set(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (place / ".config" / "bilprov").mkdir(parents=True)
    (place / ".config" / "bilprov" / "config.toml").write_text("baud = 9600")
    monkeypatch.delenv("XDG_CONFIG_HOME")
    monkeypatch.setenv("HOME", str(place))
    assert shown() == {("all", "baud"): 9600}


def test_keys_are_the_long_spellings_of_options_with_dashes_or_underscores(place: Path) -> None:
    mine(place, "truncation_timeout = 'x'")
    assert "'--truncation-timeout': 'x'" in refused("sniff", "/dev/x")
    mine(place, f"[export]\noutput = '{SAMPLE}'")
    assert "names no format" in refused("export", str(SAMPLE))

    for key in ("w", "help", "version"):
        mine(place, f"[sniff]\n{key} = 'x.mcap'")
        assert f"{key} is not an option of sniff" in refused("sniff", "/dev/x")


def test_several_values_are_a_list(place: Path) -> None:
    listed = ("conform", "sim", "--list")
    both = command(*listed, "--only", "valid/Stop*", "--only", "bad-data/LED/9").stdout
    one = command(*listed, "--only", "valid/Stop*").stdout
    assert both.count(b"bad-data/LED/9") == 1

    mine(place, "[conform]\nonly = ['valid/Stop*', 'bad-data/LED/9']")
    assert command(*listed).stdout == both
    mine(place, "[conform]\nonly = 'valid/Stop*'")
    assert command(*listed).stdout == one


@pytest.mark.parametrize(
    "words",
    [
        ["--grammar", "horn.py", "decode", "9100"],
        ["decode", "9100", "--grammar", "horn.py"],
    ],
)
@pytest.mark.parametrize("own", ["", "[decode]\n"])
def test_the_option_comes_before_the_grammar_of_the_settings(
    place: Path, horn_text: str, words: list[str], own: str
) -> None:
    (place / "horn.py").write_text(horn_text)
    mine(place, f"{own}grammar = 'nowhere.py'")

    assert b"Horn" in command(*words).stdout
    assert "nowhere.py cannot be read" in refused("decode", "00")


def test_a_filter_of_the_settings_is_checked_by_the_grammar_that_is_in_use(
    place: Path, horn_text: str
) -> None:
    (place / "horn.py").write_text(horn_text)
    user = mine(place, "[decode]\nfilter = 'name == Horn'")

    assert refused("decode", "00").endswith(f"as set in {user}")
    assert command("--grammar", "horn.py", "decode", "9100").stdout.count(b"Horn") == 1
    mine(place, "grammar = 'horn.py'\n[decode]\nfilter = 'name == Horn'")
    assert command("decode", "9100").stdout.count(b"Horn") == 1


def test_the_commands_of_a_group_have_tables_below_its_own(place: Path) -> None:
    mine(place, "[capture.info]\nformat = 'json'\n[spec.emit.c]\noutput = 'x.h'")
    assert json.loads(command("capture", "info", str(SAMPLE)).stdout)["start"]
    assert command("spec", "emit", "c").stdout == b""
    assert (place / "x.h").exists()

    mine(place, "[capture.inf]\nformat = 'json'")
    assert "[capture.inf]: capture inf is not a command, did you mean capture info?" in refused(
        *("decode", "00")
    )
    mine(place, "[spec]\nformat = 'json'")
    assert "[spec]: format is not an option of spec" in refused("spec", "show")


@pytest.mark.parametrize("name", FORMER)
def test_the_table_of_a_former_name_is_refused_with_the_new_one(place: Path, name: str) -> None:
    now = f"bilprov {name} is now bilprov {' '.join(FORMER[name])}"
    user = mine(place, f"[{name}]\nforce = 0")
    assert refused("encode", "Stop") == f"{user} [{name}]: {now}"


def test_a_named_device_stands_for_each_port_that_is_examined(place: Path) -> None:
    mine(place, "[device.car]\nport = '/nowhere/tty7'\n[device.tap]\nport = '/nowhere/tty8'")

    done = command("ports", "car", "tap")
    assert (done.returncode, done.stderr) == (2, b"")
    assert b"/nowhere/tty7" in done.stdout
    assert b"/nowhere/tty8" in done.stdout


def test_a_named_device_stands_for_its_port(place: Path) -> None:
    mine(place, "baud = 1200\n[device.car]\nport = '/nowhere/tty7'\nprobe = 'tcp:never:x'")

    for words in (
        ("send", "car", "00", "--yes"),
        ("conform", "--yes", "car"),
        ("sniff", "car"),
        ("sniff", "--bridge", "car"),
        ("replay", str(SAMPLE), "--to", "car", "--yes"),
        ("lab", "line", "car", "pty"),
    ):
        assert "/nowhere/tty7" in refused(*words)


def test_every_port_of_a_command_may_be_a_named_device() -> None:
    found = {
        name: {
            param.name
            for param in commands.command_named(name)[0].params
            if isinstance(param.type, PortName)
        }
        for name in commands.COMMANDS
    }
    assert {name: params for name, params in found.items() if params} == {
        "sniff": {"host", "device", "bridge"},
        "replay": {"port"},
        "send": {"target"},
        "ports": {"names"},
        "lab learn": {"target"},
        "lab line": {"a", "b"},
        "conform": {"target"},
    }


@pytest.mark.parametrize("words", [("sniff", "car"), ("sniff", "--bridge", "car")])
def test_the_options_of_a_device_come_before_the_files_and_after_those_typed(
    place: Path, words: tuple[str, ...]
) -> None:
    mine(place, "[sniff]\nbaud = 1200\n[device.car]\nport = '/nowhere/x'\nbaud = 'nine'")

    assert "'nine' is not a whole number" in refused(*words)
    assert "/nowhere/x" in refused(*words, "--baud", "300")
    assert "/nowhere/x" in refused(words[0], "--baud", "300", *words[1:])


def test_a_port_of_the_settings_is_no_name(place: Path) -> None:
    mine(place, "[device.car]\nport = '/nowhere/x'\n[sniff]\nbridge = 'car'")
    assert refused("sniff").startswith("there is no car")


@pytest.mark.parametrize("word", ["./car", "/nowhere/car", "socket://car:1", "cart"])
def test_a_path_and_a_url_are_never_a_name(place: Path, word: str) -> None:
    mine(place, "[device.car]\nport = '/nowhere/x'")

    assert "/nowhere/x" not in refused("sniff", word)


def test_a_file_of_that_name_is_a_path(place: Path) -> None:
    mine(place, "[device.car]\nport = '/nowhere/x'")
    assert "/nowhere/x" in refused("sniff", "car")

    (place / "car").touch()
    assert "/nowhere/x" not in refused("sniff", "car")


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("boud = 1", ": boud is not a setting of all, did you mean baud?"),
        ("[snif]\nbaud = 1", " [snif]: snif is not a command, did you mean sniff?"),
        ("[send]\nformta = 'json'", " [send]: formta is not an option of send, did you mean forma"),
        ("[send.x]\na = 1", " [send.x]: send x is not a command"),
        ("[device.car]\nprot = 1\nport = 'x'", "prot is not a setting of car, did you mean port"),
        ("[device.'a/b']\nport = 'x'", "[device.a/b]: a device's name is letters"),
        ("[device.sim]\nport = 'x'", "a device's name is letters, digits, - and _, and not sim"),
        ("[device]\ncar = 'x'", " [device]: car is not a setting of device"),
        ("[device.car]\nbaud = 3", " [device.car]: a device needs a port: add port = PATH or URL"),
        ('yes = "x\\u0000"', "yes must be one value without NUL characters, as set in "),
        ("baud = ", "cannot be read"),
        ("\x1b[31m = 1", "cannot be read"),
    ],
)
def test_what_is_no_setting_is_one_sentence_with_its_place(
    place: Path, text: str, part: str
) -> None:
    user = mine(place, text)

    sentence = refused("send", "/dev/null", "00")
    assert user in sentence
    assert part in sentence
    assert sentence.isprintable()


@pytest.mark.parametrize(
    ("text", "words", "part"),
    [
        ("[decode]\nformat = 'xml'", ("decode", "00"), "'xml' is not one of"),
        ("[sniff]\nbaud = 'x'", ("sniff", "/dev/x"), "'x' is not a whole number"),
        ("baud = [1, 2]", ("sniff", "/dev/x"), "baud must be one value"),
        ("baud = 2026-11-22", ("sniff", "/dev/x"), "'2026-11-22' is not a whole number"),
        ("baud = 1e900", ("sniff", "/dev/x"), "is not a whole number"),
        ("baud = nan", ("sniff", "/dev/x"), "is not a whole number"),
        ("baud = true", ("sniff", "/dev/x"), "is not a whole number"),
        ("baud = 9600.5", ("sniff", "/dev/x"), "is not a whole number"),
        ("yes = 2", ("send", "/dev/ptmx", "00"), "'2' is not a valid boolean"),
        ("[stats]\nfilter = 'speed > 3s'", ("stats", str(SAMPLE)), "filter column 10: 's'"),
        ("columns = 'time,nam'", ("replay", str(SAMPLE)), "there is no column 'nam'"),
    ],
)
def test_a_value_that_its_option_does_not_take_is_one_sentence_with_the_file(
    place: Path, text: str, words: tuple[str, ...], part: str
) -> None:
    user = mine(place, text)

    sentence = refused(*words)
    assert part in sentence
    assert f"as set in {user}" in sentence


def test_a_flag_may_be_a_number_or_a_word(place: Path) -> None:
    for value in ("0", "false", "'no'"):
        mine(place, f"yes = {value}")
        assert "no terminal to ask on" in refused("send", "/dev/ptmx", "00")


def test_settings_are_left_alone_where_a_command_has_no_use_for_them(place: Path) -> None:
    mine(place, "time = 'absolute'\ncolumns = 'time,name'")

    jsonl = ("replay", str(SAMPLE), "--rate", "0", "--format", "jsonl")
    assert json.loads(command(*jsonl, "--count", "1").stdout)["kind"] == "instruction"
    export = ("export", str(SAMPLE), "-o", "-", "--format", "jsonl")
    assert command(*export).returncode == 0
    lines = command("replay", str(SAMPLE), "--rate", "0", "--count", "1", "--columns", "name")
    assert (lines.returncode, lines.stdout) == (0, b"Forward\n")

    for asked in ("--time", "utc"), ("--columns", "name"):
        assert "are for lines and csv" in refused(*jsonl, *asked)
        assert "not for jsonl" in refused(*export, *asked)
    assert "name it in --columns too" in refused(
        "replay", str(SAMPLE), "--format", "lines", "--time", "utc", "--columns", "name"
    )


@pytest.mark.waits
def test_settings_for_ports_are_left_alone_where_the_target_is_none(place: Path) -> None:
    mine(place, "probe = 'tcp:127.0.0.1:9'\n[conform]\npower = 'exec:false'")

    sim = ("conform", "sim", "--only", "valid/Stop*")
    assert command(*sim).returncode == 0
    assert "is for ports" in refused(*sim, "--probe", "tcp:127.0.0.1:9")
    assert "is for ports" in refused(*sim, "--power", "exec:true")
    shell = commands.command("send", "sim", stdin=b"Stop\n", cwd=place)
    assert (shell.returncode, b"Stop" in shell.stdout) == (0, True)


def test_help_and_version_do_not_need_settings_that_can_be_read(place: Path) -> None:
    mine(place, "not toml")

    assert command("--version").returncode == 0
    assert command("sniff", "--help").returncode == 0


def test_a_short_h_is_help_behind_a_command_that_has_settings(place: Path) -> None:
    mine(place, "[capture.check]\nformat = 'json'")

    assert command("capture", "check", "/nowhere").returncode == 2
    assert command("capture", "check", "-h").returncode == 0


def test_every_common_setting_is_an_option_of_some_command() -> None:
    found = (commands.command_named(name)[0].params for name in commands.COMMANDS)
    options = {word for params in found for param in params for word in param.opts}

    assert {f"--{key}" for key in COMMON} <= options
    assert {f"--{key}" for key in DEVICE_KEYS if key != "port"} <= options
