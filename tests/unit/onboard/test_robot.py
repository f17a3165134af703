"""The robot's own program over simulated hardware: what reaches the motors, its frames, configuration, package."""

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from itertools import pairwise
from math import nan
from pathlib import Path

import numpy as np
import pytest

from ccatp.config.load import load_config, load_onboard_config
from ccatp.config.onboard_models import EdgeThresholdConfig
from ccatp.errors import ConfigError
from ccatp.links.robot_codec import MAX_LINE_BYTES, decode_from_robot
from ccatp.links.robot_messages import Sensors
from ccatp.mirror.mirror import build_mirror
from ccatp.onboard.hardware import HardwareError, Readings
from ccatp.onboard.robot import EdgeThreshold, OnboardRobot
from ccatp.sim.hardware import MOTOR_12V, DriveTrain, SimulatedHardware

CFG = load_onboard_config(overrides={"link.sample_latency_s": 0.0})
STEP_S = 1.0 / CFG.servo.loop_hz
STEPS_A_FRAME = round(CFG.servo.loop_hz / CFG.link.frame_hz)


class Bench:
    """The robot on a level mirror with a controller; the steps of its loop, and its frames."""

    def __init__(self, mirror: str = "thesis-m1", **robot: float) -> None:
        cfg = load_config(overrides={"run.mirror": mirror})
        train = DriveTrain(CFG.servo.loop_hz, CFG.servo.counts_per_rev)
        self.hardware = SimulatedHardware(cfg, build_mirror(cfg.mirror), np.random.default_rng(1), train)
        onboard = CFG.model_copy(update={"robot": CFG.robot.model_copy(update=robot)})
        self.robot = OnboardRobot(onboard, self.hardware)
        self.robot.join("controller")
        self.steps = self.seq = 0
        self.frames: list[Sensors] = []

    @property
    def t_s(self) -> float:
        return self.steps * STEP_S

    def run(self, duration_s: float, right: float | None = None, left: float = 0.0) -> list[Sensors]:
        """Frames of a time; with a (right, left) drive for each frame."""
        first = len(self.frames)
        for _ in range(round(duration_s / STEP_S)):
            if right is not None and self.steps % STEPS_A_FRAME == 0:
                self.seq += 1
                assert self.robot.drive(self.seq, right, left, self.t_s)
            self.robot.control(self.t_s)
            self.steps += 1
            if self.steps % STEPS_A_FRAME == 0:
                self.robot.advance_to(self.t_s - STEP_S)
                assert len(self.robot.delivered_line) <= MAX_LINE_BYTES
                frame = decode_from_robot(self.robot.delivered_line[:-1])
                assert isinstance(frame, Sensors)
                self.frames.append(frame)
        return self.frames[first:]

    @property
    def rates(self) -> list[float]:
        plant = self.hardware.world.plant
        return [plant.right_rad_s, plant.left_rad_s]


def test_a_drive_turns_the_wheels_and_frames_hold_every_sample_once() -> None:
    bench = Bench()
    frames = bench.run(1.0, 3.0, 2.0)
    assert bench.rates == pytest.approx([3.0, 2.0], abs=0.2)
    times = [row.t_s for frame in frames for row in frame.enc]
    assert np.allclose(np.diff(times), STEP_S)
    turned = sum(row.right_rad_s or 0.0 for frame in frames for row in frame.enc) * STEP_S
    assert turned == pytest.approx(bench.hardware.world.plant.right_angle_rad, abs=0.01)
    assert [frame.seq for frame in frames] == list(range(frames[0].seq, frames[0].seq + len(frames)))
    assert {frame.cmd.held for frame in frames[1:]} == {False}
    assert all(row[1:] == (1, 1, 1, 1) for frame in frames for row in frame.edge)
    assert any(frame.gravity for frame in frames)
    assert all(len(frame.imu) == 1 for frame in frames[1:])


def stops(bench: Bench) -> float:
    """Time until the wheels get no more voltage than holds them, after what stopped them."""
    start_s = bench.t_s
    while bench.robot.rules.is_held is False:
        bench.run(STEP_S)
    return bench.t_s - start_s


@pytest.mark.parametrize("why", ["controller", "monitor", "ttl", "zero"])
def test_what_ends_a_drive_holds_the_wheels_within_a_step_of_the_loop(why: str) -> None:
    bench = Bench()
    if why == "monitor":
        bench.robot.join("monitor")
        assert bench.robot.permit(1, True, True, True, bench.t_s + 10.0)
    bench.run(0.5, 3.0, 3.0)
    assert not bench.robot.rules.is_held
    if why in {"controller", "monitor"}:
        bench.robot.lose(why)  # type: ignore[arg-type]
        assert stops(bench) <= 2.0 * STEP_S
    elif why == "ttl":
        assert stops(bench) == pytest.approx(CFG.link.ttl_s, abs=STEPS_A_FRAME * STEP_S)
    else:
        bench.run(0.01, 0.0, 0.0)
    bench.run(0.5)
    assert bench.rates == pytest.approx([0.0, 0.0], abs=0.01)


@pytest.mark.parametrize("name", ["imu", "edge", "encoder_right", "encoder_left"])
def test_a_device_that_is_needed_holds_the_wheels_until_it_works(name: str) -> None:
    bench = Bench()
    bench.run(0.5, 3.0, 3.0)
    bench.hardware.faults[name] = "no reading"
    frames = bench.run(0.5, 3.0, 3.0)
    assert frames[-1].faults == [name]
    assert frames[-1].cmd.held
    assert bench.rates == pytest.approx([0.0, 0.0], abs=0.2)
    bench.hardware.faults.clear()
    frames = bench.run(0.5, 3.0, 3.0)
    assert not frames[-1].cmd.held
    assert bench.rates[0] == pytest.approx(3.0, abs=0.2)


def test_a_wheel_without_its_encoder_is_braked_and_not_driven_blindly() -> None:
    bench = Bench()
    bench.run(0.5, 3.0, 3.0)
    bench.hardware.faults["encoder_left"] = "no sample"
    bench.run(STEP_S, 3.0, 3.0)
    assert bench.hardware.voltages_v == (0.0, 0.0)


def test_a_stalled_wheel_is_reported_and_held_until_a_drive_of_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    monkeypatch.setattr(bench.hardware, "_motor", MOTOR_12V._replace(friction_nm=1.0))
    bench.run(1.5, 3.0, 3.0)
    assert bench.frames[-1].faults == ["stall"]
    assert bench.frames[-1].cmd.held
    frames = bench.run(0.5, 3.0, 3.0)
    assert frames[-1].cmd.held  # the controller has not seen it yet
    monkeypatch.undo()
    bench.run(0.6, 0.0, 0.0)
    frames = bench.run(0.5, 3.0, 3.0)
    assert (frames[-1].faults, frames[-1].cmd.held) == ([], False)


def test_a_loop_that_stood_longer_than_the_external_timer_brakes_for_that_step() -> None:
    bench = Bench()
    bench.run(0.5, 3.0, 3.0)
    bench.steps += 30  # 60 ms
    bench.robot.control(bench.t_s)
    assert bench.robot.late_steps == 1
    assert bench.hardware.voltages_v == (0.0, 0.0)
    bench.steps += 1
    bench.run(0.3, 3.0, 3.0)
    assert bench.rates[0] == pytest.approx(3.0, abs=0.3)


def test_a_motor_that_cannot_be_set_holds_and_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()

    def refuse(right_v: float, left_v: float) -> None:
        raise HardwareError("pwm0: Input/output error")

    monkeypatch.setattr(bench.hardware, "drive", refuse)
    frames = bench.run(0.1, 3.0, 3.0)
    assert frames[-1].faults == ["stall"]
    assert bench.robot.faults["motors"] == "pwm0: Input/output error"


def test_fans_keep_the_duty_that_was_in_force_and_change_by_command_alone() -> None:
    bench = Bench(fan_floor=0.6)
    bench.hardware.command_fans(0.7, 0.8)
    robot = OnboardRobot(bench.robot._cfg, bench.hardware)
    bench.robot = robot
    robot.join("controller")
    assert bench.run(0.1)[-1].fans == (0.7, 0.8)
    robot.lose("controller")
    bench.hardware.faults["imu"] = "no reading"
    bench.run(0.5)
    assert bench.hardware.fans() == (0.7, 0.8)
    robot.join("controller")
    assert robot.command_fans(1, 0.3, 0.9)
    assert bench.run(0.1)[-1].fans == (0.6, 0.9)  # the floor
    assert bench.hardware.fans() == (0.6, 0.9)


def test_duties_that_come_before_the_first_step_are_set() -> None:
    bench = Bench()
    assert bench.robot.command_fans(1, 0.8, 0.7)
    bench.run(STEP_S)
    assert bench.hardware.fans() == (0.8, 0.7)


def test_a_fan_that_cannot_be_set_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()

    def refuse(left: float, right: float) -> None:
        raise HardwareError("pwm1: Permission denied")

    bench.run(0.02)
    monkeypatch.setattr(bench.hardware, "command_fans", refuse)
    assert bench.robot.command_fans(1, 0.5, 0.5)
    assert bench.run(0.05)[-1].faults == ["fan_left", "fan_right"]


def test_counts_after_a_gap_give_no_speed_and_a_wheel_that_was_not_read_none(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    bench.run(0.1)
    rows = [(0.2, 10, 10), (0.202, 12, None), (0.204, 14, 13), (0.5, 1000, 1000), (0.502, 1002, 1003)]
    monkeypatch.setattr(bench.hardware, "read", lambda _: Readings([], rows, [], None, 1.0, {}))
    bench.robot.control(0.51)
    per_step = 2.0 * np.pi / CFG.servo.counts_per_rev / STEP_S
    assert [row[0] for row in bench.robot._enc][-3:] == [0.202, 0.204, 0.502]
    assert [row[1] for row in bench.robot._enc][-3:] == pytest.approx([2 * per_step] * 3)
    assert [row[2] for row in bench.robot._enc][-3:] == [None, None, pytest.approx(3 * per_step)]


def test_a_burst_of_samples_keeps_the_newest_in_a_line_that_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    bench.run(0.1)
    rows = [(0.2 + 0.001 * k, k, k) for k in range(400)]
    monkeypatch.setattr(bench.hardware, "read", lambda _: Readings([], rows, [], None, 1.0, {}))
    bench.robot.control(0.61)
    bench.robot.advance_to(0.61)
    frame = decode_from_robot(bench.robot.delivered_line[:-1])
    assert isinstance(frame, Sensors)
    assert frame.enc[-1].t_s == pytest.approx(0.599)
    assert len(frame.enc) < 100
    assert bench.robot.dropped_samples > 300


def test_a_frame_of_the_lowest_rate_holds_every_sample_of_the_fastest_sensors(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    bench.run(0.1)
    link = CFG.link.model_copy(update={"frame_hz": 20.0})
    robot = OnboardRobot(CFG.model_copy(update={"link": link}), bench.hardware)
    start_s = 1e5 + 1.0 / 3.0  # after a day, times have as many digits as they can

    def read(now_s: float) -> Readings:
        times = [now_s - 0.05 + 0.001 * (k + 1) for k in range(50)]
        counts = [(t, round(1e3 * t), -round(1e3 * t)) for t in times]
        edges = [(t, 2.4, 2.4, 0.5, 2.4) for t in times]
        imu = [(t, -1.0 / 3.0, -2.0 / 3.0, 0.0) for t in times[::10]]
        return Readings(imu, counts, edges, None, 1.0, {})

    monkeypatch.setattr(bench.hardware, "read", read)
    for k in range(3):
        now_s = start_s + 0.05 * k
        robot.control(now_s)
        robot.advance_to(now_s)
        assert len(robot.delivered_line) - 1 <= MAX_LINE_BYTES
    frame = decode_from_robot(robot.delivered_line[:-1])
    assert isinstance(frame, Sensors)
    assert (len(frame.enc), len(frame.edge), len(frame.imu)) == (50, 50, 5)
    assert robot.dropped_samples == 0


def test_a_robot_that_slides_holds_itself_with_full_fans_and_reports_it(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench("fyst-m1")
    read, slide = bench.hardware.read, 0.0

    def sliding(now_s: float) -> Readings:
        readings = read(now_s)
        gx, gy = readings.gravity[1:3] if readings.gravity else (0.0, 0.0)
        downhill[:] = (gx, gy) if readings.gravity else downhill
        rows = [(t, ax + slide * downhill[0], wz, ay + slide * downhill[1]) for t, ax, wz, ay in readings.imu]
        return readings._replace(imu=rows)

    downhill = [0.0, 0.0]
    monkeypatch.setattr(bench.hardware, "read", sliding)
    assert bench.robot.command_fans(1, 0.2, 0.2)
    sound = bench.run(1.5, 2.0, 2.0)
    assert b"sliding" not in bench.robot.delivered_line
    assert not any(frame.sliding for frame in sound)
    slide = 9.0
    frames = bench.run(0.1, 2.0, 2.0)
    assert any(frame.sliding for frame in frames[:6])
    assert (frames[-1].sliding, frames[-1].cmd.held, frames[-1].fans) == (True, True, (1.0, 1.0))
    slide = 0.0
    assert bench.run(0.4, 2.0, 2.0)[-1].cmd.held
    assert bench.robot.command_fans(2, 0.5, 0.5)
    later = bench.run(0.4, 2.0, 2.0)[-1]
    assert (later.sliding, later.cmd.held, later.fans) == (False, False, (0.5, 0.5))


def test_frames_that_a_stop_left_out_are_not_made_up_for() -> None:
    bench = Bench()
    bench.run(0.1)
    before = bench.robot.seq
    bench.robot.advance_to(0.5)
    assert (bench.robot.seq, bench.robot.t_s) == (50, 0.5)
    assert before == 10


def test_a_frame_is_delayed_so_that_it_contains_every_sample_since_the_last_one() -> None:
    bench = Bench()
    link = CFG.link.model_copy(update={"sample_latency_s": 0.015})
    bench.robot = OnboardRobot(CFG.model_copy(update={"link": link}), bench.hardware)
    arrived = bench.hardware.read

    def read_late(now_s: float) -> Readings:
        return arrived(now_s - 0.013)

    bench.hardware.read = read_late  # type: ignore[method-assign]
    bench.run(0.1)
    dropped = bench.robot.dropped_samples
    frames = bench.run(0.5)
    assert frames[-1].t == pytest.approx(bench.t_s - STEP_S - 0.015)
    for before, frame in pairwise(frames):
        times = [row.t_s for row in frame.edge]
        assert before.t < times[0]
        assert times[-1] <= frame.t + 1e-6
        assert len(times) == 10  # at 1 kHz
    assert bench.robot.dropped_samples == dropped


# -- the program around its robot: configuration, thresholds of the edge sensors, and its small package ----------------


def test_the_shipped_configuration_holds_and_names_what_is_not_verified() -> None:
    assert load_onboard_config().servo.loop_hz >= 500.0
    text = (Path(__file__).parents[3] / "configs" / "onboard.toml").read_text()
    devices = text[text.index("[devices.bno055]") :]
    for key in ("bus", "axes", "device", "baud", "supply_v", "right", "left", "line"):
        assert re.search(rf"^{key} = .*UNVERIFIED", devices, re.MULTILINE), key


def test_a_time_to_live_of_less_than_two_frames_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"link\.ttl_s must last for two frames at least"):
        load_onboard_config(overrides={"link.frame_hz": 30.0, "link.ttl_s": 0.05})


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("robot.wheel_radius_m", 0.3, "robot.wheel_radius_m = 0.3 must be less than or equal to 0.2"),
        ("robot.wheel_base_m", 0.01, "robot.wheel_base_m = 0.01 must be greater than or equal to 0.03"),
        ("robot.max_wheel_rad_s", 40.0, "robot.max_wheel_rad_s = 40 is 1.2 m/s; the robot link allows 0.02 to 1"),
        ("robot.max_wheel_rad_s", 0.5, "robot.max_wheel_rad_s = 0.5 is 0.015 m/s; the robot link allows 0.02 to 1"),
        ("robot.edge_sensors_m", [[0.09, -0.08], [0.09, 0.08], [-0.09, 0.08], [-0.09, -0.08]], "is not front-left"),
        ("link.ttl_s", 0.015, "link.ttl_s = 0.015 must be greater than or equal to 0.05"),
        ("devices.daq.sample_hz", 2000.0, "devices.daq.sample_hz = 2000.0 must be less than or equal to 1000"),
        ("devices.bno055.rate_hz", 200.0, "devices.bno055.rate_hz = 200.0 must be less than or equal to 100"),
        ("link.frame_hz", 10.0, "link.frame_hz = 10.0 must be greater than or equal to 20"),
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


def test_the_command_of_the_package_names_what_is_missing(package: Path) -> None:
    start = "import sys; from ccatp.cli.onboard import main; sys.exit(main())"
    done = run(package, "-c", start, "--set", "devices.motors.gpio_chip=/nowhere", "--port", "0", "--host", "127.0.0.1")
    assert done.returncode == 5
    assert done.stderr.splitlines()[-1].startswith("ccatp: ")
    assert "Traceback" not in done.stderr
    assert run(package, "-c", start, "--help").stdout.startswith("Usage: ")
