"""Gravity that leaks into the acceleration on an inclined mirror: each rest shows it as part of the bias."""

from math import cos, sin

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from ccatp.config.load import load_config
from ccatp.links.robot_messages import Sensors
from ccatp.studies.sil_run import SilRun

SEEDS = (1, 2, 3)
TWO_DEGREES_M_S2 = 0.34  # of an attitude that is two degrees wrong; sixty times the sensor's noise


class Leaking(SilRun):
    """The robot's own attitude is wrong: a part of gravity along its heading stays in the acceleration."""

    largest_m_s2 = 0.0

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        down_x, down_y, _ = self.mirror.rotate_deck_from_world((0.0, 0.0, -1.0))
        heading_rad = self.localizer.deck_pose.heading_rad
        leak_m_s2 = TWO_DEGREES_M_S2 * (down_x * cos(heading_rad) + down_y * sin(heading_rad))
        self.largest_m_s2 = max(self.largest_m_s2, abs(leak_m_s2))
        imu = [sample._replace(ax_m_s2=sample.ax_m_s2 + leak_m_s2) for sample in frame.imu]
        super()._serve(msgspec.structs.replace(frame, imu=imu), dt_s)


@pytest.mark.fault("S10")
def test_innovations_stay_within_their_band() -> None:
    found = list[float]()
    for seed in SEEDS:
        overrides = {
            "run.world": "hard",
            "run.filter": "ekf",
            "run.panels": 1,
            "run.mirror": "fyst-m1",
            "run.seed": seed,
        }
        rehearsal = Leaking(load_config(overrides=overrides), with_track=False)
        found += [stop.nis for stop in rehearsal.run().stops]
        assert rehearsal.largest_m_s2 > 0.1
    low, high = (chi2.ppf(share, 2 * len(found)) / len(found) for share in (0.025, 0.975))
    assert len(found) == 9 * len(SEEDS)
    assert low < np.mean(found) < high
