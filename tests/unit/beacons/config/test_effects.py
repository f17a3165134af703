"""Keys that are named as without effect have none: missions are the same, frame by frame, whatever is in them."""

from typing import Any

import pytest

from ccatp.beacons.config.effects import UNUSED, keys_without_effect
from ccatp.beacons.config.load import load_beacon_mission
from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.studies.mote_navigation import BeaconSilWorld
from tests.support.scenario import radio_config_of

MISSIONS: dict[str, dict[str, Any]] = {
    "zigbee": {},
    "radios that are not there": {"sim.beacons": {}},
    "a drive of two wheels": {
        "vehicle.kind": "differential",
        "control.speed_mode": "pi",
        "sim.target.motion": "random",
    },
    "scans": {"sim.radio.scan": "reflector", "control.speed_mode": "constant", "estimator.shadowing": "white"},
    "follow": {"system": "follow"},
    "no obstacles": {"system": "follow", "avoidance.is_active": False, "sim.target.motion": "waypoints"},
    "cricket": {"system": "cricket", "cricket.ranging.repeats": 5, "listener.mapping_rounds": 10},
    "motes beside radios": {"system": "cricket", "sim.beacons.a": {"x_m": 1.0, "y_m": 1.0, "reference_dbm": -40.0}},
}


def leaves(value: Any, at: str) -> dict[str, Any]:
    """Values by dotted key."""
    if not isinstance(value, dict):
        return {at: value}
    return {key: one for name in value for key, one in leaves(value[name], f"{at}.{name}").items()}


def other(value: Any) -> Any:
    """Another number, or numbers; booleans and names stay, because they decide which keys have an effect."""
    if isinstance(value, list):
        return [other(one) if one else one for one in value]  # a zero may have to stay: of angles, of an origin
    if isinstance(value, int) and not isinstance(value, bool):
        return value + 1
    return (0.8 * value or 0.1) if isinstance(value, float) else value


def mission(name: str, **changes: Any) -> RadioConfig:
    """A mission of the table, with changes by dotted key."""
    return load_beacon_mission(None, {"system": "zigbee", **MISSIONS[name], **changes})


def driven(cfg: RadioConfig) -> tuple[Any, ...]:
    """Everything that a mission is seen by, up to 20 s."""
    stage = BeaconSilWorld(cfg)
    while not stage.is_over and stage.robot.t_s < 20.0:
        stage.frame()
    found = stage.found
    return found.track, found.truth, found.states, found.verdicts, found.speeds_m_s, stage.mission.navigator.beacons


@pytest.mark.parametrize("name", MISSIONS)
def test_a_mission_is_the_same_with_other_values_of_keys_without_effect(name: str) -> None:
    cfg = mission(name)
    tree = cfg.model_dump(mode="json")
    changes: dict[str, Any] = {}
    for row in UNUSED:
        for key in row.keys if row.is_unused(cfg, True) else ():
            node = tree
            for part in key.split("."):
                node = node[part]
            changes |= {leaf: other(value) for leaf, value in leaves(node, key).items() if other(value) != value}
    changes.pop("cricket.dimension", None)  # it is checked with the places of the motes
    changed = mission(name, **changes)
    assert {line.split(" = ")[0] for line in keys_without_effect(changed, True)} >= changes.keys()
    assert driven(changed) == driven(cfg)


def test_each_row_is_of_a_mission() -> None:
    configs = [mission(name) for name in MISSIONS] + [mission("cricket", **{"cricket.phase2.prior": "printed"})]
    for row in UNUSED:
        assert any(row.is_unused(cfg, is_sim) for cfg in configs for is_sim in (True, False)), row.keys


@pytest.mark.parametrize("system", ["zigbee", "follow", "cricket"])
def test_the_shipped_configurations_have_no_key_without_effect(system: str) -> None:
    for is_sim in (True, False):
        assert keys_without_effect(radio_config_of(system), is_sim) == []


def test_when_a_real_robot_scans_is_its_own_matter() -> None:
    cfg = radio_config_of("zigbee", observation__every_steps=20)
    line = "observation.every_steps = 20 has no effect on a real robot; it is for the simulated one"
    assert (keys_without_effect(cfg, is_sim=True), keys_without_effect(cfg, is_sim=False)) == ([], [line])
