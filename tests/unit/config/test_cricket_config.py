"""The motes' configuration: the shipped one, and one line for each thing wrong."""

from pathlib import Path
from typing import Any

import pytest

from ccatp.config.load import dump_radio_config, load_radio_config
from ccatp.errors import ConfigError


def problem(**keys: Any) -> str:
    dotted = {f"cricket.{name.replace('__', '.')}": value for name, value in keys.items()}
    with pytest.raises(ConfigError) as caught:
        load_radio_config(None, {"system": "cricket", **dotted})
    return str(caught.value)


def test_the_shipped_field_comes_back_from_a_run(tmp_path: Path) -> None:
    cfg = load_radio_config(None, {"system": "cricket"})
    (tmp_path / "config.toml").write_text(dump_radio_config(cfg))
    assert load_radio_config(tmp_path / "config.toml") == cfg
    assert len(cfg.cricket.networks) == 6


def test_a_file_with_networks_of_its_own_has_no_others(tmp_path: Path) -> None:
    path = tmp_path / "hall.toml"
    path.write_text(
        'system = "cricket"\n[cricket.networks]\nP = { place_m = [0.0, 0.0], facing = [1.0, 0.0] }\n'
        "Q = { place_m = [4.0, 0.0], facing = [-1.0, 0.0] }\n"
    )
    assert list(load_radio_config(path).cricket.networks) == ["P", "Q"]


@pytest.mark.parametrize(
    ("keys", "what"),
    [
        ({"dimension": 3}, 'cricket.dimension = 3 needs layout = "motes" or "random"; stands lie in a plane'),
        ({"layout": "motes"}, "cricket.motes has 0; a map needs two"),
        ({"stand_m": [[0.0, 0.0]]}, "cricket.stand_m has 1 motes; trilateration needs 3"),
        ({"stand_m": [[0.0, 0.0, 0.0]] * 3}, "cricket.stand_m[0] has 3 coordinates, cricket.dimension = 2 asks for 2"),
        ({"anchors": {"C": [0.0, 1.0]}}, "cricket.anchors has 3 motes, not 2: the origin and the axis"),
        ({"anchors": {"A": [0.0, 1.0, 2.0]}}, "cricket.anchors.A has 3 coordinates"),
        ({"layout": "random", "random__size_m": [1.0, 2.0, 3.0]}, "cricket.random.size_m has 3 coordinates"),
        ({"networks__N1__facing": [0.0, 0.0]}, "cricket.networks.N1.facing is no direction: all its parts are 0"),
        ({"networks__N1__place_m": [0.0, 0.0, 1.0]}, "cricket.networks.N1.place_m has 3 coordinates"),
        ({"transducer__reach_m": [1.0, 2.0]}, "cricket.transducer.reach_m has 2 values for 5 angles"),
        ({"transducer__off_axis_rad": [0.1, 0.2, 0.3, 0.4, 0.5]}, "must begin with 0 and rise"),
        ({"phase2__pairs": "few"}, "cricket.phase2.pairs = \"few\" must be 'zigzag', 'adjacent' or 'all'"),
    ],
)
def test_what_is_wrong_is_one_line(keys: dict[str, Any], what: str) -> None:
    found = problem(**keys)
    assert what in found
    assert "\n" not in found


def test_a_field_of_one_stand(tmp_path: Path) -> None:
    path = tmp_path / "one.toml"
    path.write_text('system = "cricket"\n[cricket.networks]\nP = { place_m = [0.0, 0.0], facing = [1.0, 0.0] }\n')
    with pytest.raises(ConfigError, match="networks has 1; phase 1 goes from one network to the next"):
        load_radio_config(path)
