"""Reading the configuration, what a problem looks like, changing keys of a file, and the commands that show it."""

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ccatp.beacons.config.load import load_radio_config
from ccatp.beacons.kind import BEACONS
from ccatp.cli import main
from ccatp.config.describe import comments, differences, json_schema, template
from ccatp.config.files import write_file
from ccatp.config.load import (
    available,
    dump_config,
    kind_in,
    load_config,
    load_mission,
    load_onboard_config,
    with_values,
)
from ccatp.config.messages import find_line
from ccatp.config.mission import CommonConfig
from ccatp.config.models import Config
from ccatp.config.package import configs_dir
from ccatp.errors import ConfigError
from ccatp.links.runtime_dir import RUN_LOCK, locked
from ccatp.survey.kind import SURVEY
from tests.support.command import answered, printed, refused


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


MIRRORS, WORLDS = ["fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2"], ["extreme", "hard", "thesis", "thesis-x2"]


@pytest.mark.parametrize("mirror", MIRRORS)
@pytest.mark.parametrize("world", WORLDS)
def test_every_shipped_mirror_and_world_is_valid(mirror: str, world: str) -> None:
    cfg = load_config(overrides={"run.mirror": mirror, "run.world": world})
    assert (cfg.mirror.name, cfg.world.name) == (mirror, world)
    assert (available("mirror"), available("world")) == (MIRRORS, WORLDS)  # those of the contract


@pytest.mark.parametrize("world", ["thesis", "thesis-x2"])
def test_the_worlds_of_the_thesis_have_no_disturbance(world: str) -> None:
    values = load_config(overrides={"run.world": world}).world.model_dump()
    noise = {key for key, value in values.items() if value and not key.endswith("_walk_time_s")}
    assert noise == {
        "name", "accelerometer_sigma_m_s2", "gyroscope_sigma_rad_s", "encoder_sigma_rad_s",
        "start_position_sigma_m", "start_heading_sigma_rad",
    }  # fmt: skip


@pytest.mark.parametrize("world", ["hard", "extreme"])
def test_the_disturbed_worlds_have_every_disturbance(world: str) -> None:
    values = load_config(overrides={"run.world": world}).world.model_dump()
    assert [key for key, value in values.items() if not value] == ["encoder_sigma_rad_s"]  # counts are counted


def test_a_simulation_takes_any_ports_but_those_that_are_named(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("[sim.etalon]\nport = 2001\n")
    sim = load_config(file, any_ports=True).sim
    assert (sim.robot.port, sim.etalon.port) == (0, 2001)
    assert load_config(None, {"sim.robot.port": 7010}, any_ports=True).sim.robot.port == 7010
    assert (load_config().sim.robot.port, load_config().sim.etalon.port) == (7010, 2001)
    assert load_radio_config(None, any_ports=True).sim.robot.port == 0


def test_a_file_needs_only_what_differs_and_the_command_line_is_stronger(tmp_path: Path, config: Config) -> None:
    file = write(tmp_path / "mine.toml", "[limits]\nv_max_m_s = 0.05\n[run]\nseed = 2\npanels = 3\n")
    cfg = load_config(file, {"run.seed": 5, "run.panels": None})
    assert (cfg.limits.v_max_m_s, cfg.run.seed, cfg.run.panels) == (0.05, 5, 3)
    assert cfg.model_copy(update={"limits": config.limits, "run": config.run}) == config


def test_a_set_of_gains_may_be_added(tmp_path: Path) -> None:
    pid = "{ kp = 1.0, ki = 0.0, kd = 0.0, derivative_filter_s = 0.0, integral_limit = 0.0 }"
    text = (
        '[control]\ngains = "mine"\n[control.gain_sets.mine]\nshaped = true\nposition_tolerance_m = 0.001\n'
        f"heading_tolerance_rad = 0.01\nforward = {pid}\nangular = {pid}\n"
    )
    cfg = load_config(write(tmp_path / "mine.toml", text))
    assert set(cfg.control.gain_sets) == {"mine", "shipped", "thesis"}
    assert cfg.control.gain_sets["mine"].forward.kp == 1.0


def test_single_keys_of_the_mirror_are_laid_over_the_named_one(tmp_path: Path) -> None:
    file = write(tmp_path / "mine.toml", '[run]\nmirror = "fyst-m2"\n[mirror.base]\nrow = 2\n')
    cfg = load_config(file)
    assert cfg.mirror.base.row == 2
    assert cfg.mirror.panels == load_config(overrides={"run.mirror": "fyst-m2"}).mirror.panels


def test_a_mirror_may_be_a_file_beside_the_configuration_and_go_once_it_is_written(tmp_path: Path) -> None:
    shipped = (configs_dir() / "mirrors" / "fyst-m1.toml").read_text(encoding="utf-8")
    mirror = write(tmp_path / "mine.toml", shipped.replace('name = "fyst-m1"', 'name = "ours"'))
    cfg = load_config(write(tmp_path / "config.toml", '[run]\nmirror = "mine.toml"\n'))
    assert (cfg.mirror.name, cfg.mirror.panels.count) == ("ours", 77)
    mirror.unlink()
    assert load_config(write(tmp_path / "written.toml", dump_config(cfg))) == cfg


def test_a_mirror_file_without_gravity_is_of_a_telescope_at_the_zenith(tmp_path: Path, config: Config) -> None:
    text = (configs_dir() / "mirrors" / "fyst-m1.toml").read_text()
    rows = [row for row in text.splitlines() if not row.startswith("gravity_world")]
    write(tmp_path / "old.toml", "\n".join(rows))
    old = load_config(write(tmp_path / "mine.toml", '[run]\nmirror = "old.toml"\n'))
    assert len(rows) < len(text.splitlines())
    assert old.mirror == config.mirror


def test_a_fault_in_a_mirror_file_is_found_there(tmp_path: Path) -> None:
    shipped = (configs_dir() / "mirrors" / "fyst-m1.toml").read_text(encoding="utf-8")
    mirror = write(tmp_path / "mine.toml", shipped.replace("count = 77", "count = 87"))
    line = next(n for n, text in enumerate(shipped.splitlines(), start=1) if text.startswith("count = 77"))
    with pytest.raises(ConfigError, match="panels_per_row adds up to 77") as caught:
        load_config(overrides={"run.mirror": str(mirror)})
    assert str(caught.value).startswith(f"{mirror}:{line}: mirror.panels.count = 87")


@pytest.mark.parametrize("mirror", ["fyst-m1", "thesis-m2"])
def test_what_is_written_loads_back_equal(tmp_path: Path, mirror: str) -> None:
    cfg = load_config(overrides={"run.mirror": mirror, "run.seed": 7, "limits.v_max_m_s": 0.1 + 0.2 - 0.25})
    assert load_config(write(tmp_path / "config.toml", dump_config(cfg))) == cfg


def test_another_mirror_replaces_the_one_written_in_full(tmp_path: Path, config: Config) -> None:
    file = write(tmp_path / "config.toml", dump_config(config))
    assert load_config(file, {"run.mirror": "fyst-m1"}) == config
    assert load_config(file, {"mirror.base.row": 3}).mirror.base.row == 3
    changed = load_config(file, {"run.mirror": "fyst-m2", "mirror.base.row": 3}).mirror
    assert (changed.name, changed.base.row) == ("fyst-m2", 3)


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        ({"run.mirror": "fyst-m"}, 'run.mirror = "fyst-m" is no mirror; did you mean'),
        ({"run.sed": 2}, r"run.sed is unknown; did you mean run.seed\?"),
        (
            {"robot.wheel_radius_m": 30},
            r"robot.wheel_radius_m = 30 must be less than or equal to 0.2; looks like millimetres",
        ),
        ({"run": 3}, "run = 3 must be a section"),
        ({"robot": 3, "robot.port": 4}, "robot.port: robot is given as a value already"),
        ({"mirror": "fyst-m2"}, "mirror: must be a section; name a mirror with run.mirror"),
        ({"mirror.frame.gravity_world": [0.0, 0.0, -1.0]}, r".* contradicts overhang = false; give the direction"),
        ({"mirror.frame.gravity_world": [0.0, 0.0, 9.8]}, r".* must be of length 1"),
    ],
)
def test_a_fault_of_the_command_line_names_it(overrides: dict[str, object], line: str) -> None:
    with pytest.raises(ConfigError, match=f"^command line: {line}"):
        load_config(overrides=overrides)


def test_a_contradiction_points_to_what_the_user_wrote(tmp_path: Path) -> None:
    file = write(tmp_path / "mine.toml", "[robot]\nwheel_radius_m = 0.01\n")
    with pytest.raises(ConfigError, match=r"limits\.v_max_m_s = 0\.1 is more than the wheels give") as caught:
        load_config(file)
    assert str(caught.value).startswith(f"{file}:2: ")


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        ("none.toml", None, r"none.toml: no such file or directory; name a TOML file that exists"),
        ("", None, "is a directory; name a TOML file"),
        ("latin.toml", '[run]\nmirror = "Mirör"'.encode("latin-1"), r"is not UTF-8 text \(byte 19\); save it as UTF-8"),
        ("mine.toml", b"[run]\nseed =", r"mine.toml:2: is not TOML: "),
        ("mine.toml", b'[run]\nmirror = "bad.toml"\n', r"mine.toml:2: run.mirror.*is not TOML"),
    ],
)
def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, name: str, content: bytes | None, what: str) -> None:
    (tmp_path / "bad.toml").write_text("no toml")
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(ConfigError, match=what):
        load_config(tmp_path / name)


def test_the_schema_allows_what_the_loader_allows(capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(capsys, "config", "schema")
    schema = json.loads(text)
    assert schema["title"] == "ccatp configuration"
    assert schema["additionalProperties"] is False
    assert set(schema["properties"]) == set(Config.model_fields)
    assert '"required"' not in text  # a file needs only what differs
    assert schema["$defs"]["RobotConfig"]["properties"]["wheel_radius_m"]["maximum"] == 0.2


@pytest.mark.parametrize("system", ["zigbee", "follow", "cricket"])
def test_each_system_has_a_file_and_loads_back_equal(tmp_path: Path, system: str) -> None:
    file = configs_dir() / f"{system}.toml"
    assert load_radio_config(file).system == system
    assert kind_in(file) is BEACONS
    assert kind_in(configs_dir() / "ccatp.toml") is SURVEY
    assert load_mission(file) == load_radio_config(file)
    cfg = load_radio_config(None, {"system": system, "run.seed": 7})
    assert load_radio_config(write(tmp_path / "config.toml", dump_config(cfg))) == cfg
    assert len(cfg.cricket.networks) == 6


def test_what_a_file_lists_replaces_all_and_one_of_the_command_line_is_moved(tmp_path: Path) -> None:
    beacons = "[sim.beacons]\nsole = { x_m = 1.0, y_m = 2.0, reference_dbm = -40.0 }\n"
    file = write(tmp_path / "mine.toml", f'system = "zigbee"\n{beacons}')
    assert list(load_radio_config(file).sim.beacons) == ["sole"]
    moved = load_radio_config(None, {"sim.beacons.beacon2.x_m": 0.5}).sim.beacons
    assert len(moved) == 4
    assert (moved["beacon2"].x_m, moved["beacon2"].y_m) == (0.5, 3.0)


MOTES: list[tuple[dict[str, Any], str]] = [
    ({"dimension": 3}, 'cricket.dimension = 3 needs layout = "motes" or "random"; stands lie in a plane'),
    ({"layout": "motes"}, "cricket.motes has 0; a map needs two"),
    ({"stand_m": [[0.0, 0.0]]}, "cricket.stand_m has 1 motes; trilateration needs 3"),
    ({"stand_m": [[0.0, 0.0, 0.0]] * 3}, "cricket.stand_m[0] has 3 coordinates, cricket.dimension = 2 asks for 2"),
    ({"anchors": {"C": [0.0, 1.0]}}, "cricket.anchors has 3 motes, not 2: the origin and the axis"),
    ({"anchors": {"A": [0.0, 1.0, 2.0]}}, "cricket.anchors.A has 3 coordinates"),
    ({"layout": "random", "random.size_m": [1.0, 2.0, 3.0]}, "cricket.random.size_m has 3 coordinates"),
    ({"networks.N1.facing": [0.0, 0.0]}, "cricket.networks.N1.facing is no direction: all its parts are 0"),
    ({"networks.N1.place_m": [0.0, 0.0, 1.0]}, "cricket.networks.N1.place_m has 3 coordinates"),
    ({"transducer.reach_m": [1.0, 2.0]}, "cricket.transducer.reach_m has 2 values for 5 angles"),
    ({"transducer.off_axis_rad": [0.1, 0.2, 0.3, 0.4, 0.5]}, "must begin with 0 and rise"),
    ({"phase1.draws": 3}, "cricket.phase1.draws = 3 must be greater than or equal to 100"),
    ({"phase2.pairs": "few"}, "cricket.phase2.pairs = \"few\" must be 'zigzag', 'adjacent' or 'all'"),
]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"run.sed": 3}, "run.sed is unknown; did you mean run.seed"),
        ({"system": "zigbe"}, "is no system; did you mean zigbee"),
        ({"vehicle.speed_max_m_s": -1.0}, "must be greater than 0"),
        ({"workspace.waypoints_m": [[9.0, 1.0]]}, "lies outside the room of 3 by 3 m"),
        ({"follow.band_m": 0.9}, "must be less than follow.safe_distance_m"),
        ({"avoidance.stop_m": 0.9}, "must be less than avoidance.influence_m"),
        ({"follow.is_active": True, "follow.target": "beacon1"}, "is also a static beacon"),
        ({"control.fuzzy.rules": [{"when": {"distance_m": "nigh"}, "then": "slow"}]}, "available: far, middle, near"),
        ({"control.fuzzy.rules": [{"when": {"range": "near"}, "then": "slow"}]}, "no input"),
        ({"control.fuzzy.rules": [{"when": {"distance_m": "near"}, "then": "crawl"}]}, "is no output"),
        ({"control.fuzzy.inputs.distance_m.terms.near": [1.0, 0.0, 2.0, 3.0]}, "must rise"),
        *(({"system": "cricket", **{f"cricket.{k}": v for k, v in keys.items()}}, what) for keys, what in MOTES),
    ],
)
def test_a_mistake_among_beacons_is_one_line(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_radio_config(None, keys)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


RANDOM_MOTES = {"system": "cricket", "cricket.layout": "random"}
THREE_MOTES = {
    "system": "cricket",
    "cricket.layout": "motes",
    "cricket.motes": {f"M{k}": {"place_m": [k, k * k], "facing": [1.0, 0.0]} for k in range(3)},
}


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (RANDOM_MOTES, 'cricket.layout = "random" has no plan by which the motes of a robot map themselves'),
        (THREE_MOTES, 'cricket.layout = "motes" has no plan'),
        (
            {"system": "cricket", "follow.is_active": True},
            "follow.is_active = true needs radios; motes are not followed",
        ),
        (
            {"system": "zigbee", "workspace.loops": False},
            "workspace.loops = false visits each waypoint once, but mission.laps = 2",
        ),
    ],
)
def test_a_mission_that_could_not_end_is_refused(keys: dict[str, Any], message: str) -> None:
    """``ccatp radio map`` and the studies of radios have a use for these values."""
    load_radio_config(None, keys)
    with pytest.raises(ConfigError) as caught:
        load_mission(None, keys)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_one_lap_needs_no_loop() -> None:
    for keys in ({"system": "zigbee", "mission.laps": 1}, {"system": "follow"}):
        assert load_mission(None, {**keys, "workspace.loops": False}).system == keys["system"]


def test_files_without_a_system_or_with_one_stand_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "radio.toml", "[run]\nseed = 1\n")
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr("ccatp.config.load.configs_dir", lambda: tmp_path)
        with pytest.raises(ConfigError, match="system is missing"):
            load_radio_config()
    stand = "[cricket.networks]\nP = { place_m = [0.0, 0.0], facing = [1.0, 0.0] }\n"
    with pytest.raises(ConfigError, match="networks has 1; phase 1 goes from one network to the next"):
        load_radio_config(write(tmp_path / "one.toml", f'system = "cricket"\n{stand}'))


FOLDER = Path(__file__).parents[2] / "configs"
FILES = sorted(FOLDER.glob("*.toml"))


@pytest.mark.fault("P20")
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_the_fault_is_reported_in_one_line(file: Path) -> None:
    assert len(FILES) > 50
    expected = file.read_text().splitlines()[0].removeprefix("# fault: ").replace("<folder>", str(FOLDER))
    with pytest.raises(ConfigError) as caught:
        load_config(file)
    assert caught.value.problems[0] == f"{file}:{expected}"
    assert "\n" not in str(caught.value)
    assert caught.value.exit_status == 2


TEXT = """# comment with x = 1
top = 1
[robot]   # [not] a = header
port = 7010
edge = [
  [1, 2],
]
[control.gain_sets."mine too"]
forward = { kp = 3.0 }
a.b = 1
"""


@pytest.mark.parametrize(
    ("key", "line"),
    [
        (("top",), 2),
        (("robot",), 3),
        (("robot", "port"), 4),
        (("robot", "edge", 0, 1), 5),
        (("robot", "missing"), 3),
        (("control",), 8),
        (("control", "gain_sets", "mine too", "forward", "kp"), 9),
        (("control", "gain_sets", "mine too", "a", "b"), 10),
        (("x",), None),
        ((), None),
    ],
)
def test_a_key_is_found_at_its_line(key: tuple[str | int, ...], line: int | None) -> None:
    assert find_line(TEXT, key) == line


TEXT_CONFIG_EDIT = """# head

[run]  # what
seed = 3      # three
[robot]
port = 7010
edge_sensors_m = [[1, 2],   # left
                  [3, 4]]
"""


FILE = Path("x.toml")
TWO_KEYS = "[robot]\na_m = 0.03  # UNVERIFIED; 1 % wrong\nb_m = 0.1  # UNVERIFIED\n"


@pytest.mark.parametrize(
    ("text", "values", "after"),
    [
        (TEXT_CONFIG_EDIT, {"run.seed": 4.5},
         TEXT_CONFIG_EDIT.replace("seed = 3      # three", "seed = 4.5      # three")),
        (TWO_KEYS, {"robot.a_m": 0.031},
         TWO_KEYS.replace("0.03  # UNVERIFIED", "0.031  # measured by ccatp calibrate")),
        (TEXT_CONFIG_EDIT, {"robot.wheel_base_m": 0.151, "a.b": 1.0},
         TEXT_CONFIG_EDIT + "wheel_base_m = 0.151\n\n[a]\nb = 1.0\n"),
        ("", {"a.b": 1.0}, "[a]\nb = 1.0\n"),
        ("[a.c]\nd = 2.0\n", {"a.b": 1.0}, "[a]\nb = 1.0\n\n[a.c]\nd = 2.0\n"),
    ],
    ids=["only the value", "unverified no more", "new keys and sections", "empty", "nested"],
)  # fmt: skip
def test_values_are_set_and_all_else_stays(text: str, values: dict[str, float], after: str) -> None:
    assert with_values(text, values, FILE) == after
    assert with_values(after, values, FILE) == after


def test_what_is_no_toml_or_no_section_is_reported() -> None:
    with pytest.raises(ConfigError, match=r"x\.toml: is not TOML"):
        with_values("[robot", {"robot.a": 1.0}, FILE)
    with pytest.raises(ConfigError, match=r"x\.toml: robot is a value, not a section"):
        with_values("robot = 3\n", {"robot.a": 1.0}, FILE)


def test_a_link_stays_a_link_and_the_mode_stays(tmp_path: Path) -> None:
    file, link = tmp_path / "real.toml", tmp_path / "link.toml"
    file.write_text("a = 1\n")
    file.chmod(0o604)
    link.symlink_to(file)
    write_file(link, "a = 2\n")
    assert link.is_symlink()
    assert file.read_text() == "a = 2\n"
    assert file.stat().st_mode & 0o777 == 0o604


def test_a_failure_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "a.toml"
    file.write_text("a = 1\n")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(ConfigError, match=r"a\.toml: cannot be written: No space left"):
            write_file(file, "a = 2\n")
    assert file.read_text() == "a = 1\n"
    assert list(tmp_path.iterdir()) == [file]
    with pytest.raises(ConfigError, match="cannot be written: No such file"):
        write_file(tmp_path / "missing" / "a.toml", "")


# -- ``ccatp config init``, ``show``, ``diff`` and ``schema``; ``ccatp runs`` ------------------------------------------


def leaves(schema: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Every value of a schema by its dotted key; * for any name."""
    found: dict[str, dict[str, Any]] = {}

    def visit(node: dict[str, Any], key: str) -> None:
        model = schema["$defs"].get(str(node.get("$ref")).removeprefix("#/$defs/"), node)
        for name, value in model.get("properties", {}).items():
            if "$ref" not in value:
                found[f"{key}{name}"] = value
            visit(value, f"{key}{name}.")
        if isinstance(model.get("additionalProperties"), dict):
            visit(model["additionalProperties"], f"{key}*.")

    visit(schema, "")
    return found


def test_every_key_has_a_description_and_its_unit() -> None:
    found = leaves(json_schema())
    assert len(found) > 300
    assert [key for key, value in found.items() if len(value.get("description", "")) < 5] == []
    units = {key: value["unit"] for key, value in found.items() if "unit" in value}
    assert (units["limits.v_max_m_s"], units["mirror.panels.gap_mm"], units["run.budget_s"]) == ("m/s", "mm", "s")
    assert found["robot.max_wheel_rad_s"] == {
        "description": "interface control document 1", "exclusiveMinimum": 0.0, "maximum": 1e6, "unit": "rad/s",
        "title": "Max Wheel Rad S", "type": "number",
    }  # fmt: skip


def test_comments_of_keys_and_sections() -> None:
    text = "# head\n[a]  # section\nk = 1\nm = [1, 2] # both\n[a.b-c]\nk = 'x' #\n"
    assert comments(text, "s") == {
        "s": "", "s.a": "section", "s.a.k": "", "s.a.m": "both", "s.a.b-c": "", "s.a.b-c.k": "",
    }  # fmt: skip


def test_the_template_changes_nothing_and_has_every_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "mine.toml"
    assert main(["config", "init", str(file)]) == 0
    assert load_config(file) == load_config()
    file.write_text(re.sub(r"(?m)^# (?=[\w-]+ = )", "", template()), encoding="utf-8")
    assert load_config(file) == load_config()
    capsys.readouterr()
    assert f"{file}: exists; choose another name" in refused(capsys, "config", "init", str(file))
    assert main(["config", "init", str(file), "--force"]) == 0


def test_show_and_diff(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, other = tmp_path / "mine.toml", tmp_path / "other.toml"
    file.write_text('[run]\nmirror = "fyst-m2"\n[robot]\nwheel_radius_m = 0.031\n', encoding="utf-8")
    other.write_text(printed(capsys, "config", "show", file, "--set", "run.seed=7"), encoding="utf-8")
    assert load_config(other) == load_config(file, {"run.seed": 7})
    assert printed(capsys, "config", "diff", file).splitlines() == [
        'run.mirror: "fyst-m1" -> "fyst-m2"', "robot.wheel_radius_m: 0.03 -> 0.031",
    ]  # fmt: skip
    assert answered(capsys, "config", "diff", file, other) == {"run.seed": [1, 7]}
    assert printed(capsys, "config", "diff", "follow") == "no difference\n"
    assert differences(load_radio_config(None, {"run.seed": 9})) == [("run.seed", 1, 9)]


# -- runs --------------------------------------------------------------------------------------------------------------


def make_run(folder: Path, status: int | None, measured: int) -> Path:
    folder.mkdir(parents=True)
    (folder / "config.toml").write_text("")
    events: list[dict[str, Any]] = [
        {"event": "run_started", "timestamp": f"2026-01-0{measured}T00:00:00.5Z", "seed": 3, "mirror": "fyst-m1"}
    ]
    if status is not None:
        events.append({"event": "run_finished", "timestamp": "2026-02-01T00:00:00Z", "status": status})
        summary = {"mirror": "fyst-m1", "world": "hard", "points": {"total": 9, "measured": measured}}
        (folder / "summary.json").write_text(json.dumps(summary))
        (folder / "origin.json").write_text('{"simulation": true}')
    lines = [json.dumps(event) for event in events]
    # Between the first and the last ones of a long log nobody looks.
    (folder / "log.jsonl").write_text("\n".join([lines[0], '{"cut', *["{}"] * 100_000, *lines[1:]]) + "\n")
    return folder


def test_runs_with_how_they_ended(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_run(tmp_path / "b", 0, 9)
    make_run(tmp_path / "a", 4, 2)
    killed, going_on = make_run(tmp_path / "c", None, 3), make_run(tmp_path / "d", None, 4)
    (tmp_path / "no run").mkdir()
    with locked(going_on / RUN_LOCK, "test"):
        assert main(["runs", "list", str(tmp_path), "--json"]) == 0
    runs = json.loads(capsys.readouterr().out)["runs"]
    assert [(run["run"][-1], run["state"], run["points"], run["what"]) for run in runs] == [
        ("a", "held", "2/9", "fyst-m1, hard, simulated"), ("c", "not finished", "", "fyst-m1"),
        ("d", "running", "", "fyst-m1"), ("b", "complete", "9/9", "fyst-m1, hard, simulated"),
    ]  # fmt: skip
    assert printed(capsys, "runs", "list", tmp_path).splitlines()[1].split() == [
        "2026-01-02T00:00:00", "held", "2/9", "0.3", "fyst-m1,", "hard,", "simulated", str(tmp_path / "a"),
    ]  # fmt: skip
    shown = printed(capsys, "runs", "show", killed)
    assert "state           not finished\n" in shown
    assert "config.toml                   0.000 MB  the exact configuration\n" in shown
    assert answered(capsys, "runs", "show", killed)["files"]["config.toml"] == 0
    assert "no such folder" in refused(capsys, "runs", "list", str(tmp_path / "none"))

    path = tmp_path / "a" / "summary.json"  # what ended it, not the exit status that it shares with other ends
    path.write_text(json.dumps({**json.loads(path.read_text()), "ended": {"what": "failed", "by": "program"}}))
    assert "state           failed\n" in printed(capsys, "runs", "show", tmp_path / "a")
    with (tmp_path / "a" / "log.jsonl").open("a") as log:  # resumed, then killed: the summary is of before
        log.write('{"event": "run_started"}\n')
    shown = printed(capsys, "runs", "show", tmp_path / "a")
    assert "state           not finished\n" in shown
    assert "points" not in shown
    assert "no run directory (it has no config.toml)" in refused(capsys, "runs", "show", str(tmp_path))


def test_an_error_is_an_object_where_json_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["runs", "show", str(tmp_path), "--json"]) == 2
    caught = capsys.readouterr()
    assert caught.out == ""
    assert json.loads(caught.err) == {
        "error": f"{tmp_path}: no run directory (it has no config.toml); ccatp runs list shows them", "status": 2,
    }  # fmt: skip


@pytest.mark.parametrize("section", ["robot", "dashboard", "observatory"])
@pytest.mark.parametrize("kind", ["device", "folder", "pipe", "long", "empty"])
def test_the_check_of_a_configuration_reads_the_files_that_it_names(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], section: str, kind: str
) -> None:
    named = Path("/dev/zero") if kind == "device" else tmp_path / "named"
    if kind == "folder":
        named.mkdir()
    elif kind == "pipe":
        os.mkfifo(named)
    elif kind in ("long", "empty"):
        named.touch(0o600)
        os.truncate(named, 1 << 30 if kind == "long" else 0)  # a gigabyte of zeros takes no room on the disk
    file = tmp_path / "telescope.toml"
    key = {"robot": "key_file", "dashboard": "token_file", "observatory": "clients_file"}[section]
    text = f'[{section}]\n{key} = "{named}"\n'
    if section == "observatory":
        text += f'key_file = "{named}"\nendpoint = "tcp://127.0.0.1:7020"\n'
    file.write_text(text)
    assert main(["config", "check", str(file)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == (2 if section == "observatory" else 1)
    for line in lines:
        assert line.startswith(f"ccatp: {section}.")
        assert str(named) in line


def test_the_check_of_a_configuration_reports_each_file_that_cannot_be_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where a file is missing, and its neighbours are there and unusable."""
    keys = "observatory.clients_file", "observatory.key_file", "robot.key_file", "dashboard.token_file"
    names = {key: tmp_path / key for key in keys}
    text = 'observatory.endpoint = "tcp://127.0.0.1:7020"\n'
    file = tmp_path / "telescope.toml"
    file.write_text(text + "".join(f'{key} = "{path}"\n' for key, path in names.items()))
    for there in ({}, {"robot.key_file": ""}, {"dashboard.token_file": "short"}, {"observatory.key_file": "no key"}):
        for key, path in names.items():
            path.unlink(missing_ok=True)
            if key in there:
                path.touch(0o600)
                path.write_text(there[key])
        assert main(["config", "check", str(file)]) == 2
        out, err = capsys.readouterr()
        assert not out
        lines = err.splitlines()
        assert len(lines) == len(names)
        for line, (key, path) in zip(lines, names.items(), strict=True):
            assert line.startswith(f"ccatp: {key}: ")
            assert str(path) in line
            assert ("No such file or directory" in line) is (key not in there)


def test_the_check_of_a_configuration_reports_each_missing_file_of_mirror_and_world(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "telescope.toml"
    file.write_text('[run]\nmirror = "none.toml"\nworld = "nowhere.toml"\n')
    assert main(["config", "check", str(file)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert "none.toml" in lines[0]
    assert "nowhere.toml" in lines[1]


# -- keys of older versions ------------------------------------------------------------------------------------------


def test_keys_that_have_moved_mean_what_they_meant(tmp_path: Path) -> None:
    """Files of users, recordings and run directories hold them at their old place."""
    file = tmp_path / "telescope.toml"
    file.write_text("[localizer]\nslip_fraction = 0.1\ncrossing_gate_sigma = 4.0\n")
    found = load_config(file).localizer.four_state
    assert (found.slip_fraction, found.crossing_gate_sigma) == (0.1, 4.0)
    assert load_config(file, {"localizer.four_state.slip_fraction": 0.2}).localizer.four_state.slip_fraction == 0.2
    assert load_config(None, {"localizer.slip_fraction": 0.3}).localizer.four_state.slip_fraction == 0.3
    file.write_text("[localizer]\nslip_fraction = -1.0\n")
    with pytest.raises(ConfigError, match=r"telescope\.toml:1: localizer\.four_state\.slip_fraction = -1\.0 must be"):
        load_config(file)


@pytest.mark.parametrize("load", [load_config, load_radio_config])
def test_the_time_after_which_a_frame_is_late_has_been_named_after_a_slip(
    load: Callable[..., CommonConfig], tmp_path: Path
) -> None:
    file = tmp_path / "old.toml"
    file.write_text("[robot]\nslip_after_s = 0.03\n")
    assert load(file).robot.late_after_s == 0.03
    assert load(None, {"robot.slip_after_s": 0.04}).robot.late_after_s == 0.04
    file.write_text("[robot]\nslip_after_s = 0.03\nlate_after_s = 0.05\n")
    assert load(file).robot.late_after_s == 0.05


def test_the_limit_of_a_slide_has_been_named_after_a_slip(tmp_path: Path) -> None:
    file = tmp_path / "old.toml"
    file.write_text("[health]\ngrip_slip_m_s = 0.06\n")
    assert load_config(file).health.grip_slide_m_s == 0.06
    file.write_text("[robot]\ngrip_slip_m_s = 0.06\n")
    assert load_onboard_config(file).robot.grip_slide_m_s == 0.06


def test_the_shipped_robot_is_that_of_the_shipped_controller() -> None:
    controller, robot = load_config().robot, load_onboard_config().robot
    assert controller.edge_sensors_m == robot.edge_sensors_m
    assert (controller.wheel_radius_m, controller.wheel_base_m) == (robot.wheel_radius_m, robot.wheel_base_m)
    assert (0.0, 0.0, controller.puck_height_m) == robot.puck_m
    assert controller.max_wheel_rad_s == robot.max_wheel_rad_s
