"""Tests of the calibration: the true robot is found within the uncertainty that is stated."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from ccatp.cli import main
from ccatp.commissioning.calibration import Calibration, CalibrationError, calibrate, check_usable, lines, rows
from ccatp.commissioning.calibration_drive import DriveBuilder, RecordedDrive, WheelParameters, carry
from ccatp.config.load import dump_config, load_config
from ccatp.core import Fix, FloatArray, WheelSample
from ccatp.links.robot_codec import encode
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import FixMessage, SensorLines
from ccatp.records.recorder import RECORD_FORMAT
from ccatp.sim.robot import Robot
from ccatp.studies.sil_run import SilRun
from ccatp.survey.fix_review import ReviewedFix
from tests.support.command import answered, printed, refused
from tests.support.recorded import recorder_in

# A robot that is not what the configuration says, in a world without slip: thesis with these.
OTHER_ROBOT = {
    "world.wheel_radius_sigma": 0.005,
    "world.wheel_base_sigma": 0.01,
    "world.gyroscope_bias_sigma_rad_s": 0.0175,
    "world.gyroscope_scale_sigma": 0.01,
}


class CalibrationDrive(SilRun):
    """A mission of the calibration drive alone; keeps what a recording would hold."""

    def __init__(self, seed: int, world: str, rounds: int, changes: Mapping[str, object]) -> None:
        settings = {
            "run.seed": seed, "run.world": world, "run.order": "calibration", "mission.calibration_rounds": rounds,
        }  # fmt: skip
        super().__init__(load_config(None, {**settings, **changes}))
        self.frames: list[Sensors] = []
        self.fixes: list[tuple[int, Fix]] = []
        self.run()

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        self.frames.append(frame)
        super()._serve(frame, dt_s)

    def _fuse(self, fix: Fix) -> ReviewedFix:
        self.fixes.append((self.frames[-1].seq, fix))
        return super()._fuse(fix)

    @property
    def drive(self) -> RecordedDrive:
        """As the calibration takes it."""
        builder, fixes = DriveBuilder(self.mirror, self.cfg.robot.puck_height_m), list(self.fixes)
        for frame in self.frames:
            builder.frame(frame.seq, frame)
            while fixes and fixes[0][0] == frame.seq:
                builder.fix(fixes.pop(0)[1])
        return builder.build()

    def truth(self, mean_slip: float = 0.0) -> FloatArray:
        """Rolling radius (m), base (m) and gyroscope bias at boot (rad/s) of the simulated robot."""
        assert isinstance(self.robot, Robot)
        wheels = self.robot.world.wheels
        radius_m = 0.5 * wheels.radius_m * (wheels.right_scale + wheels.left_scale) * (1.0 - mean_slip)
        return np.array((radius_m, wheels.base_m, self.robot._sensors._imu._wz_bias._value))


def record(run_dir: Path, driven: CalibrationDrive) -> Path:
    """A run directory of the drive."""
    run_dir.mkdir(exist_ok=True)
    text = dump_config(driven.cfg)
    (run_dir / "config.toml").write_text(text)
    recorder = recorder_in(run_dir, {"config": text, "format": str(RECORD_FORMAT)})
    for seq, fix in driven.fixes:
        message = FixMessage(
            seq=seq, t_s=fix.t_s, point=None, is_fused=True, position_m=fix.position_m,
            covariance_m2=list(fix.covariance_m2), dop=fix.dop, residual_rms_m=fix.residual_rms_m,
            channels=list(fix.channels), jump_mm=0.0,
        )  # fmt: skip
        recorder.write("fix", fix.t_s, msgspec.json.encode(message))
    for begin in range(0, len(driven.frames), 100):
        frames = driven.frames[begin : begin + 100]
        lines = [msgspec.Raw(encode(frame).strip()) for frame in frames]
        batch = SensorLines(seq=frames[-1].seq, t_s=frames[-1].t, lines=lines)
        recorder.write("sensors", batch.t_s, msgspec.json.encode(batch))
    recorder.close()
    return run_dir


@pytest.fixture(scope="module")
def driven() -> CalibrationDrive:
    return CalibrationDrive(5, "thesis", 2, OTHER_ROBOT)


@pytest.fixture(scope="module")
def drive(driven: CalibrationDrive) -> RecordedDrive:
    return driven.drive


def test_a_second_fix_at_a_place_drops_the_rest_between_them(driven: CalibrationDrive) -> None:
    frames, (seq, fix), builder = driven.frames, driven.fixes[0], DriveBuilder(driven.mirror, 0.0)
    stop = next(k for k, frame in enumerate(frames) if frame.seq == seq)
    end = next(k for k, frame in enumerate(frames) if frame.seq == driven.fixes[1][0])
    for rest in range(stop + 1):
        builder.frame(frames[rest].seq, frames[rest])
    for seconds in range(3):  # measured again while it stands
        for k in range(100):
            t_s, number = frames[stop].t + seconds + 0.01 * (k + 1), seq + 100 * seconds + k + 1
            still = [WheelSample(t_s - 0.01 + 0.001 * (j + 1), 0.0, 0.0) for j in range(10)]
            builder.frame(number, msgspec.structs.replace(frames[stop], seq=number, t=t_s, enc=still, imu=[]))
        builder.fix(fix)
    for frame in frames[stop + 1 : end + 1]:
        t_s, samples = frame.t + 3.0, [row._replace(t_s=row.t_s + 3.0) for row in frame.enc]
        builder.frame(frame.seq + 300, msgspec.structs.replace(frame, seq=frame.seq + 300, t=t_s, enc=samples))
    builder.fix(driven.fixes[1][1])
    (segment,) = builder.build().segments
    assert len(segment.right_rad) == end - stop
    assert segment.duration_s == pytest.approx(0.01 * (end - stop))


@pytest.fixture(scope="module")
def found(driven: CalibrationDrive, drive: RecordedDrive) -> Calibration:
    return calibrate(driven.mirror, drive, driven.cfg)


def nees(found: Calibration, truth: FloatArray) -> float:
    error = np.array([found.radius.value, found.base.value, found.bias.value]) - truth
    return float(error @ np.linalg.solve(found.covariance, error))


def test_the_true_robot_is_found(driven: CalibrationDrive, found: Calibration) -> None:
    truth, cfg = driven.truth(), driven.cfg
    assert abs(truth[0] - cfg.robot.wheel_radius_m) > 5e-5  # it is another one than configured
    assert abs(truth[1] - cfg.robot.wheel_base_m) > 5e-4
    assert nees(found, truth) < chi2.ppf(0.999, 3)
    assert found.radius.sigma < 1e-6
    assert found.base.sigma < 5e-6
    assert found.bias.sigma < 3e-4
    wheels = driven.robot.world.wheels
    difference_m = wheels.radius_m * (wheels.right_scale - wheels.left_scale)
    assert abs(found.radius_difference_m.value - difference_m) < 5.0 * found.radius_difference_m.sigma


def test_a_drive_has_a_segment_for_each_leg(drive: RecordedDrive) -> None:
    assert len(drive.segments) == 8  # two rounds of four legs
    assert len(drive.places) == 9
    assert drive.encoder_sigma_rad_s == pytest.approx(0.001, rel=0.1)  # of the world
    assert drive.encoder_period_s == pytest.approx(0.001)
    assert drive.gyro_sigma_rad_s == pytest.approx(0.0087, rel=0.15)
    for segment in drive.segments:  # no frame is left out
        assert segment.motions[0][0] == 0
        assert segment.motions[-1][1] == len(segment.right_rad)
        assert all(one[1] == other[0] for one, other in pairwise(segment.motions))
    # a turn in place and the way behind it are parted
    assert max(len(segment.motions) for segment in drive.segments) >= 2


def test_derivatives_are_those_of_the_motion(driven: CalibrationDrive, drive: RecordedDrive) -> None:
    segment = max(drive.segments, key=lambda one: len(one.motions))
    start = np.array([drive.places[0].x_m, drive.places[0].y_m, 0.7])
    wheels = WheelParameters(0.0301, 0.0299, 0.151, 0.01)
    led = carry(driven.mirror, segment, start, wheels)
    for k, step in enumerate((1e-6, 1e-6, 1e-6, 1e-4)):
        up, down = (carry(driven.mirror, segment, start, wheels._replace(**{wheels._fields[k]: wheels[k] + s})).end
                    for s in (step, -step))  # fmt: skip
        assert led.of_wheels[:, k] == pytest.approx((up - down) / (2 * step), rel=2e-3, abs=2e-4)
    turned = [carry(driven.mirror, segment, start + np.array([0.0, 0.0, s]), wheels).end for s in (1e-4, -1e-4)]
    assert led.of_start[:, 2] == pytest.approx((turned[0] - turned[1]) / 2e-4, abs=1e-4)
    # all motions of a wheel gaining together is the same as a larger wheel
    right = led.of_slip[:, 0::2].sum(axis=1)
    assert right == pytest.approx(led.of_wheels[:, 0] * wheels.right_m, rel=2e-3, abs=1e-6)


def test_slip_that_varies_widens_the_uncertainty(found: Calibration) -> None:
    slipping = CalibrationDrive(3, "hard", 2, {})
    result = calibrate(slipping.mirror, slipping.drive, slipping.cfg)
    assert 0.004 < result.slip_sigma < 0.03  # drawn from 1 to 5 %: standard deviation 0.0115
    assert result.radius.sigma > 50.0 * found.radius.sigma
    world = slipping.cfg.world
    truth = slipping.truth(0.5 * (world.slip_min + world.slip_max))  # what rolls is the radius less the mean slip
    assert nees(result, truth) < chi2.ppf(0.999, 3)
    assert result.creep.value == pytest.approx(world.creep_fraction, abs=5.0 * result.creep.sigma)


def test_what_cannot_show_the_wheels_is_refused(driven: CalibrationDrive, drive: RecordedDrive) -> None:
    before = driven.cfg
    few = replace(drive, segments=drive.segments[:3], places=drive.places[:4])
    with pytest.raises(CalibrationError, match="the drive has 3 legs with a fix at each end, 4 are needed"):
        calibrate(driven.mirror, few, before)
    still = tuple(replace(s, right_rad=0.1 * s.right_rad, left_rad=0.1 * s.left_rad) for s in drive.segments)
    with pytest.raises(CalibrationError, match="no turn by more than a radian"):
        calibrate(driven.mirror, replace(drive, segments=still), before)
    turning = tuple(replace(s, left_rad=-s.right_rad) for s in drive.segments)
    with pytest.raises(CalibrationError, match="no way of more than 50 mm"):
        calibrate(driven.mirror, replace(drive, segments=turning), before)


def test_what_must_not_be_written_is_refused(driven: CalibrationDrive, found: Calibration) -> None:
    table = rows(driven.cfg, found)
    check_usable(table)
    with pytest.raises(CalibrationError, match="no better than a measuring tape"):
        check_usable((table[0]._replace(sigma=0.001), *table[1:]))
    with pytest.raises(CalibrationError, match="more than 5% apart: another robot"):
        check_usable((table[0], table[1]._replace(configured=0.2), table[2]))
    assert "robot.wheel_base_m" in "\n".join(lines(table, found))
    assert table[0]._replace(found=0.0301234567, sigma=3.2e-6).rounded == 0.0301235


def test_the_command_writes_what_it_found(
    driven: CalibrationDrive, found: Calibration, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_dir, config = record(tmp_path / "run", driven), tmp_path / "telescope.toml"
    text = "# ours\n[robot]\nwheel_radius_m = 0.03  # by a tape\n\n[limits]\nv_max_m_s = 0.05\n"
    config.write_text(text)
    config.chmod(0o640)
    command = ["calibrate", "--from", str(run_dir), "--config", str(config)]
    assert main([*command, "--dry-run"]) == 0
    shown = capsys.readouterr()
    assert "-wheel_radius_m = 0.03  # by a tape" in shown.out
    assert "nothing written" in shown.err
    assert config.read_text() == text
    result = answered(capsys, *command)
    reported = result["parameters"]["robot.wheel_radius_m"]
    assert reported["found"] == pytest.approx(found.radius.value, abs=1e-9)  # of a few decimals of the recorded samples
    assert result["written"] == str(config)
    written = config.read_text()
    assert f"wheel_radius_m = {round(found.radius.value, 8)}  # by a tape" in written
    assert written.startswith("# ours\n[robot]\n")
    assert "[limits]\nv_max_m_s = 0.05\n" in written
    assert "[localizer]\ngyroscope_bias_rad_s = " in written
    assert config.stat().st_mode & 0o777 == 0o640
    assert set(tmp_path.iterdir()) == {run_dir, config}
    assert "nothing to change" in printed(capsys, *command)


def test_what_is_replaced_is_shown_and_nothing_without_a_configuration(
    driven: CalibrationDrive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_dir, config = record(tmp_path / "run", driven), tmp_path / "telescope.toml"
    config.write_text('[run]\nmirror = "fyst-m2"\n[robot]\nwheel_radius_m = 0.0301\n')
    assert main(["calibrate", "--from", str(run_dir), "--config", str(config), "--dry-run"]) == 0
    shown = capsys.readouterr()
    (row,) = (line for line in shown.out.splitlines() if line.startswith("robot.wheel_radius_m "))
    assert row.split()[1] == "0.0301"
    assert f"the drive was on fyst-m1, {config} is for fyst-m2" in shown.err
    assert "robot.wheel_radius_m = " in printed(capsys, "calibrate", "--from", run_dir)


def test_misuse(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reported = "name the robot's configuration with --config FILE, or add --sim"
    assert reported in refused(capsys, "calibrate")
    assert "no telemetry.mcap there" in refused(capsys, "calibrate", "--from", tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(("world", "changes", "mean_slip"), [("thesis", OTHER_ROBOT, 0.0), ("hard", {}, 0.03)])
def test_over_many_robots_errors_are_as_large_as_stated(
    world: str, changes: dict[str, object], mean_slip: float
) -> None:
    found, offsets = [], []
    for seed in range(1, 25):
        one = CalibrationDrive(seed, world, 3, changes)
        result, truth = calibrate(one.mirror, one.drive, one.cfg), one.truth(mean_slip)
        found.append(nees(result, truth))
        estimates = (result.radius, result.base, result.bias)
        offsets.append([(one.value - true) / one.sigma for one, true in zip(estimates, truth, strict=True)])
    low, high = float(chi2.ppf(0.001, 3 * len(found))), float(chi2.ppf(0.999, 3 * len(found)))
    print(f"{world}: NEES mean {np.mean(found):.2f} of 3, allowed {low / len(found):.2f} to {high / len(found):.2f}")
    assert low < sum(found) < high
    # One way or the other: an error common to all drives, as of a wheel's last run-down left out, is no noise.
    assert np.abs(np.mean(offsets, axis=0)) == pytest.approx(0.0, abs=3.5 / np.sqrt(len(offsets)))
