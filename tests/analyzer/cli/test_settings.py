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


def test_later_places_come_before_earlier_ones(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine(place, "[decode]\nformat = 'jsonl'\nfrom = 'device'")
    assert b'"kind":"response"' in command("decode", "00").stdout

    theirs(place, "[decode]\nfrom = 'host'")
    assert b'"kind":"instruction"' in command("decode", "00").stdout

    monkeypatch.setenv("BILPROV_DECODE_FROM", "device")
    assert b'"kind":"response"' in command("decode", "00").stdout

    assert b'"kind":"instruction"' in command("decode", "00", "--from", "host").stdout


def test_a_setting_for_all_commands_is_left_alone_by_those_without_it(place: Path) -> None:
    mine(place, "baud = 9600")

    assert command("encode", "Stop").stdout == b"00\n"
    assert shown("sniff")["sniff", "baud"][0] == 9600


def test_a_commands_own_table_comes_before_what_is_for_all(place: Path) -> None:
    mine(place, "baud = 9600\n[sniff]\nbaud = 1200")

    assert shown("sniff")["sniff", "baud"][0] == 1200
    assert shown("conform")["conform", "baud"][0] == 9600


def test_show_says_where_each_value_comes_from_and_which_are_not_used(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine(place, "baud = 9600\nparity = 'E'\n[device.car]\nport = '/dev/ttyUSB7'")
    theirs(place, "baud = 1200")
    monkeypatch.setenv("BILPROV_PARITY", "O")

    user = str(place.parent / "home" / "bilprov" / "config.toml")
    found = command("config", "show", "--format", "json").stdout
    rows = [tuple(row.values()) for row in json.loads(found)]
    assert rows == [
        ("all", "baud", 9600, user, False),
        ("all", "parity", "E", user, False),
        ("device car", "port", "/dev/ttyUSB7", f"{user} [device.car]", True),
        ("all", "baud", 1200, "bilprov.toml", True),
        ("all", "parity", "O", "BILPROV_PARITY", True),
    ]
    for row in rows:
        assert all(str(part) in command("config", "show").stdout.decode() for part in row[:3])


def test_the_users_file_is_in_the_home_where_no_other_place_is_set(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (place / ".config" / "bilprov").mkdir(parents=True)
    (place / ".config" / "bilprov" / "config.toml").write_text("baud = 9600")
    monkeypatch.delenv("XDG_CONFIG_HOME")
    monkeypatch.setenv("HOME", str(place))
    source = str(place / ".config" / "bilprov" / "config.toml")
    assert shown()["all", "baud"] == (9600, source, True)


def test_keys_are_the_long_spellings_of_options_with_dashes_or_underscores(place: Path) -> None:
    theirs(place, "truncation_timeout = 70\n[sniff]\nwrite = 'x.mcap'\n[replay]\nto = '/dev/x'")
    assert shown("replay")["replay", "truncation-timeout"][0] == 70
    assert shown("sniff")["sniff", "write"][0] == "x.mcap"
    assert shown("replay")["replay", "to"][0] == "/dev/x"  # a port may be outside of the folder

    for key in ("w", "help", "version"):
        theirs(place, f"[sniff]\n{key} = 'x.mcap'")
        assert f"sniff has no option {key}" in refused("config", "show")


def test_several_values_are_a_list_or_stand_side_by_side_in_the_environment(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    listed = ("conform", "sim", "--list")
    both = command(*listed, "--only", "valid/Stop*", "--only", "bad-data/LED/9").stdout
    assert both.count(b"bad-data/LED/9") == 1

    theirs(place, "[conform]\nonly = ['valid/Stop*', 'bad-data/LED/9']")
    assert command(*listed).stdout == both
    theirs(place, "")
    monkeypatch.setenv("BILPROV_CONFORM_ONLY", "valid/Stop* bad-data/LED/9")
    assert command(*listed).stdout == both


def test_the_option_comes_before_the_grammar_of_the_settings(place: Path, horn_text: str) -> None:
    (place / "horn.py").write_text(horn_text)
    mine(place, "grammar = 'nowhere.py'")
    assert b"Horn" in command("--grammar", "horn.py", "decode", "9100").stdout


def test_show_of_a_command_has_all_its_options(place: Path) -> None:
    theirs(place, "[conform]\nlevel = 'smoke'")

    found = shown("conform")
    assert found["conform", "level"] == ("smoke", "bilprov.toml [conform]", True)
    assert found["conform", "seed"] == (1, "the command's default", True)


def test_show_refuses_what_a_command_would_refuse(place: Path) -> None:
    theirs(place, "[decode]\nformat = 'xml'")
    assert "bilprov.toml [decode]: format = xml" in refused("config", "show")


def test_a_command_of_commands_has_no_settings(place: Path) -> None:
    theirs(place, "[spec]\nformat = 'json'")
    for arguments in (("config", "show"), ("spec", "show")):
        assert "bilprov.toml [spec]: spec has no option format" in refused(*arguments)


def test_the_commands_of_a_group_have_tables_below_its_own(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    theirs(place, "[capture.info]\nformat = 'json'\n[spec.emit.c]\noutput = 'x.h'")
    assert json.loads(command("capture", "info", str(SAMPLE)).stdout)["start"]
    assert command("spec", "emit", "c").stdout == b""
    assert (place / "x.h").exists()
    source = "bilprov.toml [capture.info]"
    assert shown("capture", "info")["capture info", "format"] == ("json", source, True)

    monkeypatch.setenv("BILPROV_CAPTURE_INFO_FORMAT", "text")
    assert command("capture", "info", str(SAMPLE)).stdout.startswith(bytes(SAMPLE))

    theirs(place, "[capture.inf]\nformat = 'json'")
    assert "[capture]: inf is not a command, did you mean info?" in refused("decode", "00")


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


def test_a_named_device_stands_for_each_port_that_is_examined(place: Path) -> None:
    mine(place, "[device.car]\nport = '/nowhere/tty7'\n[device.tap]\nport = '/nowhere/tty8'")

    done = command("ports", "car", "tap")
    assert (done.returncode, done.stderr) == (2, b"")
    assert b"/nowhere/tty7" in done.stdout
    assert b"/nowhere/tty8" in done.stdout


def test_a_grammar_behind_the_command_comes_before_that_of_the_settings(
    place: Path, horn_text: str
) -> None:
    (place / "horn.py").write_text(horn_text)
    mine(place, "grammar = 'nowhere.py'\n[decode]\nfilter = 'name == Horn'")

    assert command("decode", "9100", "--grammar", "horn.py").stdout.count(b"Horn") == 1


def test_show_says_that_a_later_place_comes_before_a_commands_own_table(place: Path) -> None:
    mine(place, "baud = 9600\n[sniff]\nbaud = 1200\nparity = 'E'\n[send]\nbaud = 300")
    theirs(place, "[sniff]\nbaud = 2400")

    found = command("config", "show", "--format", "json").stdout
    rows = [(row["command"], row["value"], row["used"]) for row in json.loads(found)]
    assert rows == [
        ("all", 9600, True),
        ("sniff", 1200, False),
        ("sniff", "E", True),
        ("send", 300, True),
        ("sniff", 2400, True),
    ]


def test_nothing_set_is_said(place: Path) -> None:
    assert command("config", "show").stdout.startswith(b"nothing is set")


def test_a_named_device_stands_for_its_port_and_brings_its_options(place: Path) -> None:
    device = "[device.car]\nport = '/nowhere/tty7'\nprobe = 'tcp:never:x'\npower = 'exec:true'"
    mine(place, f"baud = 1200\n{device}")

    assert "/nowhere/tty7" in refused("send", "car", "00", "--yes")
    assert "/nowhere/tty7" in refused("conform", "car", "--yes")
    assert "/nowhere/tty7" in refused("sniff", "--bridge", "car")


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


DANGEROUS = [
    ("yes = true", "yes = True"),
    ("grammar = 'evil.py'", "grammar = evil.py"),
    ("probe = 'exec:rm -r x'", "exec:rm -r x"),
    ("[conform]\npower = 'exec:reboot'", "power"),
    ("[plot]\nforce = true", "force = True"),
    ("[conform]\nprobe = 'EXEC:x'", "EXEC:x"),
    ("[conform]\nyes = false", "yes = False"),
    ("[device.car]\nport = '/dev/x'\nprobe = 'exec:x'", "[device.car]"),
    ("[device.car]\nport = '/dev/x'\nyes = true", "[device.car]"),
    ("[device.car]\nport = 'spy:///dev/x?file=/etc/passwd'", "spy:"),
    ("[device.car]\nport = 'alt://x?class=os.system'", "alt:"),
    ("[sniff]\nwrite = '/home/x/.bashrc'", "/home/x/.bashrc"),
    ("[conform]\nhtml = '../x.html'", "../x.html"),
    ("[conform]\nonly = ['a', '~/x']", "only"),
]


@pytest.mark.parametrize(("text", "part"), DANGEROUS, ids=[text for text, _ in DANGEROUS])
def test_a_projects_file_cannot_run_code_or_answer_or_write_elsewhere(
    place: Path, text: str, part: str
) -> None:
    theirs(place, text)

    sentence = refused("encode", "Stop")
    assert sentence.startswith("bilprov.toml")
    assert part in sentence
    assert "which a project's file may not" in sentence


@pytest.mark.parametrize("path", ["out.html", "up/out.html", "nowhere.html"])
def test_a_projects_file_cannot_write_elsewhere_by_a_link(place: Path, path: str) -> None:
    (place.parent / "victim").write_text("mine")
    (place / "out.html").symlink_to("../victim")
    (place / "up").symlink_to("..")
    (place / "nowhere.html").symlink_to("../new")
    theirs(place, f"[conform]\nhtml = '{path}'")

    assert "outside this folder" in refused("encode", "Stop")
    assert (place.parent / "victim").read_text() == "mine"


@pytest.mark.parametrize(("text", "part"), DANGEROUS, ids=[text for text, _ in DANGEROUS])
def test_the_users_own_file_may(place: Path, text: str, part: str) -> None:
    mine(place, text)
    if text.startswith("grammar"):
        assert "evil.py cannot be read" in refused("encode", "Stop")
    else:
        assert command("encode", "Stop").stdout == b"00\n"


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("boud = 1", "boud is not a setting of all commands, did you mean baud?"),
        ("[snif]\nbaud = 1", "snif is not a command, did you mean sniff?"),
        ("[send]\nformta = 'json'", "send has no option formta, did you mean format?"),
        ("[send.x]\na = 1", "x is a table, allowed is a value"),
        ("[device.car]\nprot = 1", "prot is not a setting of a device, did you mean port?"),
        ("[device.'a/b']\nport = 'x'", "a device's name is letters, digits, - and _"),
        ("[device.sim]\nport = 'x'", "a device's name is letters, digits, - and _, and not sim"),
        ("[device]\ncar = 'x'", "it must be a table with a port"),
        ("baud = [1, 2]", "baud is a list, allowed is one value"),
        ("[device.car]\nport = ['a']", "names no port: add port = PATH or URL, a text"),
        ("[device.car]\nbaud = 3", "names no port"),
        ("baud = 2026-11-22", "baud is a date, allowed is a value"),
        ("baud = ", "cannot be read"),
        ("\x1b[31m = 1", "cannot be read"),
    ],
)
def test_what_is_no_setting_is_one_sentence_with_its_place(
    place: Path, text: str, part: str
) -> None:
    theirs(place, text)

    sentence = refused("send", "/dev/null", "00")
    assert "bilprov.toml" in sentence
    assert part in sentence
    assert sentence.isprintable()


def test_a_value_that_its_option_does_not_take_is_one_sentence(place: Path) -> None:
    theirs(place, "[decode]\nformat = 'xml'")
    assert "bilprov.toml [decode]: format = xml: 'xml' is not one of" in refused("decode", "00")
    theirs(place, "[sniff]\nbaud = 'x'")
    assert "bilprov.toml [sniff]: baud = x: 'x' is not a whole number" in refused("sniff", "/dev/x")


@pytest.mark.parametrize("value", ["1e900", "nan", "true", "9600.5"])
def test_a_number_of_another_kind_is_refused_as_if_it_were_typed(place: Path, value: str) -> None:
    theirs(place, f"baud = {value}")

    assert "is not a whole number" in refused("sniff", "/dev/x")


def test_a_flag_may_be_a_number_or_a_word(place: Path) -> None:
    for value in ("0", "false", "'no'"):
        mine(place, f"yes = {value}")
        assert "no terminal to ask on" in refused("send", "/dev/ptmx", "00")
    mine(place, "yes = 2")
    assert "yes = 2: " in refused("send", "/dev/ptmx", "00")


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("[stats]\nfilter = 'speed > 3s'", " [stats]: filter = speed > 3s: filter column 10: 's'"),
        ("columns = 'time,nam'", ": columns = time,nam: there is no column 'nam'"),
    ],
)
def test_a_name_that_the_grammar_does_not_have_is_told_with_its_file(
    place: Path, text: str, part: str
) -> None:
    name = "stats" if "stats" in text else "replay"
    mine(place, text)
    user = place.parent / "home" / "bilprov" / "config.toml"
    for arguments in ((name, str(SAMPLE)), ("config", "show")):
        assert refused(*arguments).startswith(f"{user}{part}")

    mine(place, "")
    theirs(place, text)
    assert refused(name, str(SAMPLE)).startswith(f"bilprov.toml{part}")


def test_a_filter_of_the_settings_is_checked_by_the_grammar_that_is_in_use(
    place: Path, monkeypatch: pytest.MonkeyPatch, horn_text: str
) -> None:
    (place / "horn.py").write_text(horn_text)
    monkeypatch.setenv("BILPROV_DECODE_FILTER", "name == Horn")

    assert refused("decode", "00").startswith("BILPROV_DECODE_FILTER: filter = name == Horn: ")
    assert command("--grammar", "horn.py", "decode", "9100").stdout.count(b"Horn") == 1
    mine(place, "grammar = 'horn.py'")
    assert command("decode", "9100").stdout.count(b"Horn") == 1


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


def test_a_device_without_a_port_is_one_sentence(place: Path) -> None:
    theirs(place, "[device.car]\nbaud = 9600")
    assert "bilprov.toml [device.car] names no port" in refused("send", "car", "00")


def test_help_and_version_do_not_need_settings_that_can_be_read(place: Path) -> None:
    theirs(place, "not toml")

    assert command("--version").returncode == 0
    assert command("sniff", "--help").returncode == 0


def test_a_short_h_is_help_behind_a_command_that_had_settings(place: Path) -> None:
    mine(place, "[capture.check]\nformat = 'json'")

    assert command("capture", "check", "/nowhere").returncode == 2
    assert command("capture", "check", "-h").returncode == 0


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
