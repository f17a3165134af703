"""Pure. What is asked of a fix before it is used: our frame and unit, on the surface, repeated where it is doubted."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ccatp.config.models import Config
from ccatp.filters.base import FloatArray
from ccatp.localizer import FOUR_STATE
from ccatp.metrology.frame_check import FrameCheck, explain_lengths
from ccatp.metrology.judge import FixJudge
from ccatp.mirror.mirror import Mirror
from ccatp.samples import DeckPose, Fix, Vector3


class Finding(NamedTuple):
    """What was found: nothing where both are empty.

    Attributes:
        doubt: why to measure again.
        refusal: why this laser system must not be used for this mission.
    """

    doubt: str = ""
    refusal: str = ""


class Scrutiny:
    """Looks at every fix of a mission before the localizer gets it.

    Args:
        mirror: the ideal surface.
        cfg: the configuration.
    """

    def __init__(self, mirror: Mirror, cfg: Config) -> None:
        """No fix seen."""
        gate = None if cfg.run.filter in FOUR_STATE else cfg.localizer.full_state.fix_gate_nis
        self._judge = FixJudge(mirror, cfg.etalon, cfg.robot.puck_height_m, gate)
        self._frame = FrameCheck(cfg.etalon)
        self._cfg = cfg.etalon
        self._collimators_m = dict(zip(mirror.channels, np.asarray(mirror.collimators_m), strict=True))
        self._is_first = True

    def begin(self) -> None:
        """The robot stands anew."""
        self._judge.begin()

    def review(
        self, fix: Fix, expected_m: Vector3, pose: DeckPose, covariance: FloatArray, *, is_lost: bool = False
    ) -> Finding:
        """Judge a fix.

        Args:
            fix: as measured.
            expected_m: of the puck, world frame, by the estimate.
            pose: the estimate for the fix's time.
            covariance: of the estimate's (x, y, heading), shape (3, 3).
            is_lost: the estimate is known to be wrong.
        """
        is_first, self._is_first = self._is_first, False
        fault = None if is_lost else self._frame.look(fix.position_m, expected_m)
        if fault is not None and (is_first or fault.is_explained):
            where = "its base" if is_first else "the place it drove to"
            return Finding(refusal=f"the laser system sees the robot {fault.distance_m:.2f} m from {where}: {fault}")
        return Finding(doubt=self._judge.doubt(fix, pose, covariance))

    def refusal_of(self, lengths_m: Mapping[int, float], expected_m: Vector3) -> str:
        """Why lengths that gave no position speak against the laser system; empty once a fix has been right.

        Args:
            lengths_m: by channel, as measured.
            expected_m: where the puck must be, world frame.
        """
        if not self._is_first:
            return ""
        why = explain_lengths(self._cfg, expected_m, lengths_m, self._collimators_m)
        return f"the laser system's lengths do not lead to the robot's base: {why}" if why else ""
