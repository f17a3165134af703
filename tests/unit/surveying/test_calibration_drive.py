"""A hold during the calibration drive does not end it."""

import pytest

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import PointId, Stop, StopKind
from ccatp.links.robot_messages import Sensors
from ccatp.studies.sil_run import SilRun
from ccatp.survey.planning.escape import is_on_drive

DRIVE = (
    Stop(0.0, 0.1, StopKind.CALIBRATE, reverse=True),
    Stop(0.0, 0.0, StopKind.CALIBRATE),
    Stop(0.0, 0.1, StopKind.CALIBRATE),
    Stop(0.5, 0.5, StopKind.MEASURE, PointId(1, 1, 1)),
)


@pytest.mark.parametrize(
    ("place", "expected"),
    [((0.0, 0.05), True), ((0.02, 0.11), True), ((0.0, -0.02), True), ((0.04, 0.05), False), ((0.0, 0.14), False)],
)
def test_near_its_line_the_drive_goes_on(place: tuple[float, float], expected: bool) -> None:
    assert is_on_drive(DRIVE, *place) is expected
    assert not is_on_drive(DRIVE[-1:], *place)


class Paused(SilRun):
    """An operator holds the robot for a moment."""

    def __init__(self, cfg: Config, pause_s: float) -> None:
        super().__init__(cfg, with_track=False)
        self.pause_s = pause_s

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        super()._serve(frame, dt_s)
        if self.pause_s <= frame.t < self.pause_s + 0.005:
            self.mission.pause("an operator")
        elif self.pause_s + 1.0 <= frame.t < self.pause_s + 1.005:
            self.mission.resume()


@pytest.mark.parametrize("pause_s", [6.0, 9.5])
def test_a_pause_leaves_nothing_out(pause_s: float) -> None:
    cfg = load_config(overrides={"run.panels": 1, "run.filter": "ekf"})
    result = Paused(cfg, pause_s).run()
    assert result.outcome == "complete"
    assert result.summary["mission_time_s"] > result.summary["lower_bound_s"] + 0.9
    assert result.summary["arrival_error_mm"]["max"] < 0.2
