"""Keys that are named as without effect have none: missions are the same, frame by frame, whatever is in them."""

from typing import Any

import numpy as np
import pytest

from ccatp.beacons.config.effects import UNUSED, UNUSED_BY, keys_without_effect, recording_keys_without_effect
from ccatp.beacons.config.load import load_beacon_mission, load_recordings_config
from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.studies.mote_navigation import BeaconSilWorld
from ccatp.beacons.studies.recordings import estimate
from tests.support.scenario import radio_config_of
from tests.unit.beacons.datasets.sets import recorded, world

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


def recording_changes(estimator: str) -> dict[str, Any]:
    """Other values of the keys that an estimator does not use on a recording of the format ``csv``."""
    changes: dict[str, Any] = {"plaza.priors.range_scale": 0.07, "filter.beacon_walk_m_sqrt_s": 0.3}
    shipped = load_recordings_config().model_dump(mode="json")
    for key in UNUSED_BY[estimator]:
        node: Any = shipped
        for part in (path := key.replace("FORMAT", "csv")).split("."):
            node = node[part]
        changes |= {leaf: other(value) for leaf, value in leaves(node, path).items()}
    return changes


@pytest.mark.parametrize("estimator", ["ekf-slam", "fixed-lag", "smoother"])
def test_an_estimate_is_the_same_with_other_values_of_keys_without_effect(estimator: str) -> None:
    shipped, changes = load_recordings_config(), recording_changes(estimator)
    cfg, run = load_recordings_config(None, changes), recorded(world(1, 30.0))
    named = recording_keys_without_effect(cfg, shipped, "csv", estimator)
    assert {line.split(" = ")[0] for line in named} == changes.keys()
    one, two = (estimate(run, each, estimator) for each in (shipped, cfg))
    assert np.array_equal(one.poses, two.poses)
    assert one.beacons.keys() == two.beacons.keys()


@pytest.mark.parametrize("estimator", ["fixed-lag", "smoother"])
@pytest.mark.parametrize("key", ["csv.priors.beacon_offset_m", "csv.priors.bearing_offset_rad", "csv.radio.freedom"])
def test_keys_that_ekf_slam_does_not_use_act_on_the_other_estimators(key: str, estimator: str) -> None:
    shipped, cfg = load_recordings_config(), load_recordings_config(None, {key: 2.0 if "freedom" in key else 0.2})
    assert recording_keys_without_effect(cfg, shipped, "csv", estimator) == []
    line = f"{key} = {2.0 if 'freedom' in key else 0.2} has no effect with --filter ekf-slam"
    assert recording_keys_without_effect(cfg, shipped, "csv", "ekf-slam") == [line]
    run = recorded(world(1, 30.0))
    one, two = (estimate(run, each, estimator) for each in (shipped, cfg))
    assert not np.array_equal(one.poses, two.poses)
