"""Calibration drives of the simulated robot, in process, with the daemon's own mission, danger rules and gate."""

from collections.abc import Mapping
from pathlib import Path

import msgspec
import numpy as np

from ccatp.commissioning.calibration_drive import DriveBuilder, RecordedDrive
from ccatp.config.load import dump_config, load_config
from ccatp.core import Fix, FloatArray
from ccatp.links.robot_codec import encode
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import RECORD_FORMAT, TOPICS, FixMessage, SensorLines, pack, schema_of
from ccatp.records.recorder import Recorder
from ccatp.studies.sil_run import SilRun

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
        super().__init__(load_config(None, {**settings, **changes}), with_track=False)
        self.frames: list[Sensors] = []
        self.fixes: list[tuple[int, Fix]] = []
        self.run()

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        self.frames.append(frame)
        super()._serve(frame, dt_s)

    def _fuse(self, fix: Fix) -> None:
        self.fixes.append((self.frames[-1].seq, fix))
        super()._fuse(fix)

    @property
    def drive(self) -> RecordedDrive:
        """As the calibration takes it."""
        builder, fixes = DriveBuilder(self.mirror, self.cfg.robot.puck_height_m), list(self.fixes)
        for frame in self.frames:
            builder.frame(frame)
            while fixes and fixes[0][0] == frame.seq:
                builder.fix(fixes.pop(0)[1])
        return builder.build()

    def truth(self, mean_slip: float = 0.0) -> FloatArray:
        """Rolling radius (m), base (m) and gyroscope bias at boot (rad/s) of the simulated robot."""
        wheels = self.robot.world.wheels
        radius_m = 0.5 * wheels.radius_m * (wheels.right_scale + wheels.left_scale) * (1.0 - mean_slip)
        return np.array((radius_m, wheels.base_m, self.robot._sensors._imu._wz_bias._value))


def record(run_dir: Path, driven: CalibrationDrive) -> Path:
    """A run directory of the drive."""
    run_dir.mkdir(exist_ok=True)
    text = dump_config(driven.cfg)
    (run_dir / "config.toml").write_text(text)
    topics = [(topic.name, schema_of(topic.name)) for topic in TOPICS if topic.recorded]
    metadata = {"config": text, "format": str(RECORD_FORMAT)}
    recorder = Recorder(run_dir / "telemetry.mcap", topics, is_simulation=True, metadata=metadata)
    for seq, fix in driven.fixes:
        message = FixMessage(
            seq=seq, t_s=fix.t_s, point=None, is_fused=True, position_m=fix.position_m,
            covariance_m2=list(fix.covariance_m2), dop=fix.dop, residual_rms_m=fix.residual_rms_m,
            channels=list(fix.channels), jump_mm=0.0,
        )  # fmt: skip
        recorder.write("fix", fix.t_s, pack("fix", message).partition(b" ")[2])
    for begin in range(0, len(driven.frames), 100):
        frames = driven.frames[begin : begin + 100]
        lines = [msgspec.Raw(encode(frame).strip()) for frame in frames]
        batch = SensorLines(seq=frames[-1].seq, t_s=frames[-1].t, lines=lines)
        recorder.write("sensors", batch.t_s, pack("sensors", batch).partition(b" ")[2])
    recorder.close()
    return run_dir
