"""A filter that breaks in mid-mission: frozen and held in the same frame, and found again by one fix."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.links.robot_messages import Sensors
from ccatp.survey.state import MissionState
from tests.faults.laser import DeskRehearsal
from tests.faults.test_operator import one_panel

Note = Callable[[str, float], None]


def nan_noise(filter_: Any) -> None:
    """The next prediction has a covariance that is no number."""
    predict = filter_.predict

    def harmed(F: Any, Q: Any) -> None:
        filter_.predict = predict
        predict(F, Q * np.nan)

    filter_.predict = harmed


def nan_reading(filter_: Any) -> None:
    """The next measurement is no number."""
    _harm_update(filter_, lambda z, R: (z * np.nan, R))


def indefinite(filter_: Any) -> None:
    """The next measurement has a negative variance."""
    _harm_update(filter_, lambda z, R: (z, -1e3 * np.abs(R) - 1e3))


def _harm_update(filter_: Any, harm: Callable[[Any, Any], tuple[Any, Any]]) -> None:
    update = filter_.update

    def harmed(z: Any, H: Any, R: Any) -> Any:
        filter_.update = update
        z, R = harm(z, R)
        return update(z, H, R)

    filter_.update = harmed


class Broken(DeskRehearsal):
    """The filter is broken while the robot drives."""

    harm: Callable[[Any], None]
    broken_at_s: float | None = None
    held_at_s: float | None = None
    drive = (0.0, 0.0)

    def _foresee(self, number: int, right: float, left: float) -> None:
        super()._foresee(number, right, left)
        self.drive = right, left

    def look(self, frame: Sensors) -> None:
        if self.broken_at_s is None and self.mission.done and self.mission.state is MissionState.DRIVING:
            self.broken_at_s = frame.t
            localizer: Any = self.localizer
            # The end of a block of frames: the filter is asked in this one.
            localizer._block.dt_s = localizer._full.update_period_s
            type(self).harm(localizer._estimate._filter)

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        before = self.localizer.deck_pose
        super()._serve(frame, dt_s)
        if self.broken_at_s is not None and self.held_at_s is None and self.localizer.is_frozen:
            self.held_at_s = frame.t
            assert self.mission.cause.startswith("filter: ")
            assert self.mission.state in (MissionState.HELD, MissionState.SETTLING)  # for a fix, and for nothing else
            assert self.mission.measuring_point is None
            assert self.drive == (0.0, 0.0)
            now = self.localizer.deck_pose
            assert np.isfinite((now.x_m, now.y_m, now.heading_rad)).all()
            assert np.hypot(now.x_m - before.x_m, now.y_m - before.y_m) < 0.002  # a frame of the way


@pytest.mark.fault("S27")
@pytest.mark.parametrize("harm", [nan_noise, nan_reading, indefinite])
def test_a_broken_filter_freezes_holds_and_begins_anew_with_a_fix(
    harm: Callable[[Any], None], tmp_path: Path, measured: Note
) -> None:
    run = type("Harmed", (Broken,), {"harm": staticmethod(harm)})(one_panel(), tmp_path)
    result = run.run()
    assert run.broken_at_s is not None
    assert run.held_at_s is not None
    ticks = round((run.held_at_s - run.broken_at_s) * run.cfg.sim.robot.frame_hz)
    measured("S27", ticks)
    assert ticks <= 1
    assert (result.outcome, result.summary["points"]["measured"]) == ("complete", 9)
    assert result.counts["diverged"] == 1
    first = next(m for m in run.asked if m.t_s > run.held_at_s)
    assert first.point is None  # nothing but a fix comes first
