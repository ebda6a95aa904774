"""Settings, worlds and folders that cannot be: one line, exit code 2, and nothing written."""

from __future__ import annotations

import pytest

from command import kalmap_all_inside, write_log
from kalmap.cli.settings import parse_pairs

C = "course-35"

# name -> (content of a file, or None; the command line, where FILE stands for it; what the line must say)
FILES = {
    "unknown.toml": ("[motion]\nsigma = 1\n", ["unknown.toml", "field motion", "`sigma`"]),
    "top.toml": ("turbo = true\n", ["top.toml", "`turbo`"]),
    "type.json": ('{"filter": {"name": 3}}', ["type.json", "field filter.name", "`str`"]),
    "name.json": ('{"filter": {"name": "pf"}}', ["name.json", "field filter.name", "'pf'"]),
    "nan.toml": ("[sensor]\nmount_x = nan\n", ["nan.toml", "field sensor.mount_x", "finite"]),
    "negative.toml": ("[sensor]\nsigma_range = -0.1\n", ["negative.toml", "field sensor.sigma_range"]),
    "cut.json": ('{"filter": ', ["cut.json", "line 1"]),
    "cut.toml": ("[filter\n", ["cut.toml", "line 1"]),
    "list.json": ("[1]", ["list.json", "table"]),
    "deep.json": ("[" * 200_000, ["deep.json"]),
    "long.json": ('{"seed": ' + "1" * 5000 + "}", ["long.json"]),
    "latin.toml": (b"name = '\xff'\n", ["latin.toml"]),
    "world.toml": ("[world]\nlapps = 1\n", ["world.lapps"]),
    "missing.toml": (None, ["missing.toml", "no such file"]),
}
LINES = {
    "unknown key": (["run", C, "--set", "motion.sigma=1"], "`sigma` - at `$.motion`"),
    "unknown table": (["run", C, "--set", "nothing.at=all"], "`nothing`"),
    "wrong type": (["run", C, "--set", "sensor.sigma_range=wide"], "$.sensor.sigma_range"),
    "not finite": (["run", C, "--set", "motion.encoder_offset=Infinity"], "$.motion.encoder_offset"),
    "not a pair": (["run", C, "--set", "motion"], "key=value"),
    "no key": (["run", C, "--set", "=1"], "key=value"),
    "two values": (["run", C, "--set", "filter=1", "--set", "filter.name=ekf"], "filter has a value already"),
    "world's key": (["run", C, "--set", "world.lapps=1"], "world.lapps"),
    "world's type": (["run", C, "--set", "world.laps=1.5"], "world.laps: expected a whole number"),
    "world's truth": (["run", C, "--set", "world.laps=true"], "world.laps"),
    "world's sign": (["run", C, "--set", "world.speed=-1"], "speed must be positive"),
    "world as number": (["run", C, "--set", "world=3"], "world: expected settings"),
    "world of a log": (["run", "LOG", "--set", "world.laps=1"], "is a log, not a world"),
    "full ekf": (["run", C, "--filter", "ekf", "--scope", "full"], "filter.scope"),
    "full cr-ukf": (["run", C, "--filter", "cr-ukf", "--scope", "full"], "'cr-ukf' is by name the reduced"),
    "no world": (["run", "mars-35"], "mars-35: no such file or folder, and unknown world"),
    "world without features": (["run", "course-0"], "at least one landmark"),
    "world without end": (["run", "course-99999999"], "unknown world"),
    "robot of a world": (["run", C, "--robot", "1"], "--robot and --variant are for logs"),
    "robot of a car": (["run", "LOG", "--robot", "1"], "log of one vehicle"),
    "all robots of a car": (["run", "LOG", "--robot", "all"], "holds no log of several robots"),
    "all robots of nothing": (["run", "nowhere", "--robot", "all"], "nowhere"),
    "variant of a csv log": (["run", "LOG", "--variant", "scans"], "variant 'scans'"),
    "no method": (["compare", C, "--methods", "ekf,pf"], "unknown filter 'pf'; known are ekf"),
    "empty method": (["compare", C, "--methods", ""], "unknown filter ''"),
    "method twice": (["compare", C, "--methods", "ekf,ekf"], "'ekf' is asked for twice"),
    "method's suffix": (["compare", C, "--methods", "ekf:sideways"], "unknown suffix 'sideways'"),
    "seeds of a log": (["compare", "LOG", "--methods", "ekf", "--runs", "2"], "only a world"),
    "nothing to check": (["check", "nowhere"], "nowhere: no such file or folder"),
}
FOLDERS = {
    "foreign": "holds files that are no kalmap result",
    "file": "it is not a folder",
    "file/below": "cannot hold a result",
    "x" * 300: "file name too long",
}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with configuration files, a log, a folder with a letter in it, and a file."""
    root = tmp_path_factory.mktemp("settings")
    for name, (content, _) in FILES.items():
        if content is not None:
            (root / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    write_log(root / "log")
    (root / "foreign").mkdir()
    (root / "foreign" / "letter.txt").write_text("dear")
    (root / "file").write_text("a file")
    return root


@pytest.fixture(scope="module")
def answers(place):
    """All command lines, run."""
    calls = {name: ["run", C, "--config", place / name] for name in FILES}
    for name, (words, _) in LINES.items():
        calls[name] = [place / "log" if word == "LOG" else word for word in words]
    calls = {
        name: [*words, *(["--out", place / "new"] * (words[0] != "check"))] for name, words in calls.items()
    }
    return kalmap_all_inside(calls | {name: ["run", C, "--out", place / name] for name in FOLDERS})


@pytest.mark.parametrize(
    ("text", "value"),
    [
        (".5", 0.5),
        ("5.", 5.0),
        ("+2e-3", 0.002),
        ("0.5", 0.5),
        ("7", 7),
        ("true", True),
        ("1.2.3", "1.2.3"),
        (".", "."),
    ],
)
def test_numbers_as_people_write_them(text, value):
    parsed = parse_pairs((f"sensor.x={text}",))["sensor"]["x"]
    assert parsed == value and type(parsed) is type(value)


@pytest.mark.parametrize("name", FILES)
def test_a_configuration_file_that_cannot_be_is_named(answers, place, name):
    """The line names the file and the field; no result folder appears."""
    assert answers[name].code == 2 and answers[name].out == ""
    assert all(word in answers[name].error for word in FILES[name][1])
    assert not (place / "new").exists()


@pytest.mark.parametrize("name", LINES)
def test_a_setting_that_cannot_be_is_named(answers, place, name):
    """The line names the setting, method, world or log; no result folder appears."""
    assert answers[name].code == 2 and answers[name].out == ""
    assert LINES[name][1] in answers[name].error
    assert not (place / "new").exists()


@pytest.mark.parametrize("name", FOLDERS)
def test_a_folder_that_cannot_hold_a_result_is_refused_before_the_run(answers, place, name):
    """Somebody's files stay as they are, and the line says why."""
    assert answers[name].code == 2 and answers[name].out == ""
    assert FOLDERS[name] in answers[name].error
    assert [path.name for path in (place / "foreign").iterdir()] == ["letter.txt"]
    assert (place / "file").read_text() == "a file"
