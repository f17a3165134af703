"""The on-board program around its robot: configuration, thresholds of the edge sensors, and its small package."""

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from math import nan
from pathlib import Path

import pytest

from ccatp.config.load import load_onboard_config
from ccatp.config.onboard_models import EdgeThresholdConfig
from ccatp.errors import ConfigError
from ccatp.onboard.edge_threshold import EdgeThreshold


def test_the_shipped_configuration_holds_and_names_what_is_not_verified() -> None:
    assert load_onboard_config().servo.loop_hz >= 500.0
    text = (Path(__file__).parents[3] / "configs" / "onboard.toml").read_text()
    devices = text[text.index("[devices.bno055]") :]
    for key in ("bus", "axes", "device", "baud", "supply_v", "right", "left", "line"):
        assert re.search(rf"^{key} = .*UNVERIFIED", devices, re.MULTILINE), key


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("robot.wheel_radius_m", 0.3, "robot.wheel_radius_m must be between 0.005 and 0.2"),
        ("robot.wheel_base_m", 0.01, "robot.wheel_base_m must be between 0.03 and 1"),
        ("robot.max_wheel_rad_s", 40.0, "robot.max_wheel_rad_s = 40 is 1.2 m/s; the link allows 1"),
        ("robot.edge_sensors_m", [[0.09, -0.08], [0.09, 0.08], [-0.09, 0.08], [-0.09, -0.08]], "is not front-left"),
        ("link.ttl_s", 0.015, "link.ttl_s must last for two frames at least"),
        ("servo.loop_hz", 120.0, "devices.timer.timeout_s = 0.03 brakes a loop with steps of 0.00833333 s"),
        ("servo.max_v", 24.0, "servo.max_v = 24 is more than devices.motors.supply_v = 12"),
        ("servo.static_v", 12.0, "servo.static_v must be below servo.max_v"),
        ("edges.threshold_v", 3.3, "edges.threshold_v and its band must lie between 0 and devices.daq.full_scale_v"),
        ("edges.hysteresis_v", 3.2, "edges.threshold_v and its band must lie between 0"),
        ("devices.daq.battery_empty_v", 12.6, "devices.daq.battery_empty_v must be below"),
        ("devices.bno055.axes", ["x", "y", "w"], "devices.bno055.axes"),
        ("devices.bno055.adress", 0x29, "devices.bno055.adress"),
    ],
)
def test_values_that_do_not_fit_are_refused_with_their_key(key: str, value: object, says: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load_onboard_config(overrides={key: value})
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


# -- from voltages of an edge sensor to bits ---------------------------------------------------------------------------

ABOVE = EdgeThresholdConfig(threshold_v=1.5, hysteresis_v=0.4, debounce_s=0.002, is_panel_above=True)


def bits(cfg: EdgeThresholdConfig, *voltages: float) -> list[int]:
    """Readings at 1 kHz."""
    sensor = EdgeThreshold(cfg)
    return [sensor.read(0.001 * k, voltage_v) for k, voltage_v in enumerate(voltages)]


@pytest.mark.parametrize(
    ("voltages", "expected"),
    [
        ((2.0, 2.0), [1, 1]),  # the first sample decides at once
        ((1.6, 1.6, 1.8), [0, 0, 0]),  # within the band it is no panel until it was above it
        ((2.0, 1.4, 1.31, 1.29), [1, 1, 1, 0]),  # hysteresis
        ((2.0, 0.5, 2.0, 2.0, 2.0), [1, 0, 0, 0, 1]),  # to no panel at once, back after 2 ms
        ((2.0, 0.5, 2.0, 0.5, 2.0, 2.0, 2.0), [1, 0, 0, 0, 0, 0, 1]),  # a flicker begins the 2 ms again
        ((nan, 2.0), [0, 0]),
        ((2.0, nan, 2.0), [1, 0, 0]),
    ],
)
def test_threshold_hysteresis_and_debouncing(voltages: tuple[float, ...], expected: list[int]) -> None:
    assert bits(ABOVE, *voltages) == expected


def test_a_sensor_that_gives_less_over_a_panel() -> None:
    below = ABOVE.model_copy(update={"is_panel_above": False})
    assert bits(below, 1.0, 1.6, 1.71) == [1, 1, 0]
    assert bits(below, 2.0) == [0]


# -- the small package for the robot's computer ------------------------------------------------------------------------

ROOT = Path(__file__).parents[3]
LEFT_OUT = ("scipy", "matplotlib", "starlette", "uvicorn", "zmq", "jinja2", "openpyxl", "mcap", "prometheus_client")
IMPORT_ALL = f"""
import importlib, pkgutil, sys
import ccatp
for module in pkgutil.walk_packages(ccatp.__path__, "ccatp."):
    importlib.import_module(module.name)
print(ccatp.__file__)
print(*sorted(set({LEFT_OUT!r}) & set(sys.modules)))
print(*sorted({{name.partition('.')[0] for name in sys.modules}} - set(sys.stdlib_module_names)))
"""


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the package is unpacked."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", "--no-input", "wheel"]
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", str(folder)]
    subprocess.run([*pip, *options, str(ROOT / "packaging" / "onboard")], check=True, timeout=120)
    (wheel,) = folder.glob("ccatp_onboard-*.whl")
    zipfile.ZipFile(wheel).extractall(folder / "unpacked")
    return folder / "unpacked"


def run(package: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(package)}
    return subprocess.run(
        [sys.executable, *arguments],
        env=environment,
        cwd=package,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_every_module_of_the_package_can_be_imported_and_none_needs_the_big_packages(package: Path) -> None:
    done = run(package, "-c", IMPORT_ALL)
    assert done.returncode == 0, done.stderr
    place, left_out, third_party = done.stdout.split("\n")[:3]
    assert Path(place).is_relative_to(package)
    assert left_out == ""
    # All that it imports is among its dependencies, or comes with one of them.
    project = tomllib.loads((ROOT / "packaging" / "onboard" / "pyproject.toml").read_text())["project"]
    named = {text.partition(">")[0].replace("-", "_") for text in project["dependencies"]}
    assert {"numpy", "pydantic", "structlog", "click", "msgspec"} <= named & set(third_party.split())


def test_the_command_of_the_package_says_what_is_missing(package: Path) -> None:
    start = "import sys; from ccatp.cli.onboard import main; sys.exit(main())"
    done = run(package, "-c", start, "--set", "devices.motors.gpio_chip=/nowhere", "--port", "0", "--host", "127.0.0.1")
    assert done.returncode == 5
    assert done.stderr.splitlines()[-1].startswith("ccatp: ")
    assert "Traceback" not in done.stderr
    assert run(package, "-c", start, "--help").stdout.startswith("Usage: ")
