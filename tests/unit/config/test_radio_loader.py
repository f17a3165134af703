"""The configuration of robots among radio beacons: layers, refusals, round trip."""

from pathlib import Path

import pytest

from ccatp.config.load import dump_radio_config, is_radio_file, load_radio_config, shipped_config_dir
from ccatp.errors import ConfigError


@pytest.mark.parametrize("system", ["zigbee", "follow"])
def test_shipped_files_are_valid_and_name_their_system(system: str) -> None:
    file = shipped_config_dir() / f"{system}.toml"
    assert load_radio_config(file).system == system
    assert is_radio_file(file)
    assert not is_radio_file(shipped_config_dir() / "ccatp.toml")


def test_dump_loads_back_equal(tmp_path: Path) -> None:
    cfg = load_radio_config(None, {"system": "follow", "run.seed": 7})
    (tmp_path / "config.toml").write_text(dump_radio_config(cfg))
    assert load_radio_config(tmp_path / "config.toml") == cfg


def test_beacons_of_a_file_replace_all_and_one_of_the_command_line_is_moved(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('system = "zigbee"\n[sim.beacons]\nsole = { x_m = 1.0, y_m = 2.0, reference_dbm = -40.0 }\n')
    assert list(load_radio_config(file).sim.beacons) == ["sole"]
    moved = load_radio_config(None, {"sim.beacons.beacon2.x_m": 0.5}).sim.beacons
    assert len(moved) == 4
    assert (moved["beacon2"].x_m, moved["beacon2"].y_m) == (0.5, 3.0)


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
        (
            {"control.fuzzy.rules": [{"when": {"distance_m": "nigh"}, "then": "slow"}]},
            "is no term of it; available: far, middle, near",
        ),
        ({"control.fuzzy.rules": [{"when": {"range": "near"}, "then": "slow"}]}, "no input"),
        ({"control.fuzzy.rules": [{"when": {"distance_m": "near"}, "then": "crawl"}]}, "is no output"),
        ({"control.fuzzy.inputs.distance_m.terms.near": [1.0, 0.0, 2.0, 3.0]}, "must rise"),
    ],
)
def test_one_line_says_what_is_wrong(keys: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_radio_config(None, keys)


def test_a_base_file_without_a_system_is_told(tmp_path: Path) -> None:
    (tmp_path / "radio.toml").write_text("[run]\nseed = 1\n")
    with pytest.raises(ConfigError, match="system is missing"):
        load_radio_config(None, None, tmp_path)
