"""Pure. The measurements of a rehearsal: lengths of the stand-in's model, fixes, rows of what was found at a stop."""

from math import hypot

import numpy as np

from ccatp.angles import difference
from ccatp.config.models import Config
from ccatp.localizer import Localizer
from ccatp.mirror.alignment import fit_panel
from ccatp.mirror.errors import PanelFitError
from ccatp.mirror.mirror import Mirror
from ccatp.radio.puck_fix import solve_fix
from ccatp.samples import DeckPose, Fix, PanelId, PointId
from ccatp.sim.etalon import SEED_STREAM, EtalonModel, PuckTruth
from ccatp.sim.robot import Robot
from ccatp.sim.world import TruthRow
from ccatp.studies.rehearsal_result import StopRow
from ccatp.surveying.approaches import Approaches
from ccatp.wire import multiline

_MIN_FIXES = 3


class LaserDesk:
    """Measures the puck of a simulated robot and keeps what came of it.

    Args:
        cfg: the configuration; its seed seeds the lengths' noise.
        mirror: the mirror.
        robot: carries the puck.

    Attributes:
        stops: measurements whose fix was fused, in their order.
    """

    def __init__(self, cfg: Config, mirror: Mirror, robot: Robot) -> None:
        """Nothing measured."""
        self._cfg, self._mirror, self._robot = cfg, mirror, robot
        channels, collimators_m = mirror.channels, mirror.collimators_m
        rng = np.random.default_rng([cfg.run.seed, SEED_STREAM])
        self._etalon = EtalonModel(cfg.sim.etalon, channels, collimators_m, rng)
        self._collimators_m = dict(zip(channels, collimators_m, strict=True))
        self._approaches = Approaches(cfg.mission.correction_tolerance_m, cfg.mission.max_approaches)
        self._fixes: dict[PanelId, list[Fix]] = {}
        self.stops: list[StopRow] = []

    def fix(self, t_s: float, estimate: DeckPose) -> Fix:
        """Measure now.

        Args:
            t_s: time of the frame to which the fix belongs.
            estimate: says where the puck is expected.

        Raises:
            MultilaterationError: no solution, or one past a limit.
        """
        robot, channels = self._robot, self._mirror.channels
        puck = PuckTruth(robot.t_s, robot.world.puck_world(), robot.world.moved_m())
        data = multiline.ChannelData(self._etalon.records(channels, puck))
        lengths_m, _ = multiline.valid_lengths(data, channels)
        expected_m = self._mirror.puck_world(estimate, self._cfg.robot.puck_height_m)
        return solve_fix(self._cfg.etalon, t_s, expected_m, lengths_m, self._collimators_m)

    def stop_row(self, t_s: float, point: PointId, truth: TruthRow, localizer: Localizer) -> StopRow:
        """The state in which a point is measured, before its fix."""
        _, _, true_x_m, true_y_m, true_heading_rad, *_ = truth
        deck = localizer.deck_pose
        x_m, y_m = self._mirror.point_on_deck(point)
        return StopRow(
            t_s=t_s,
            point=(point.row, point.col, point.point),
            approach=0,
            error=(true_x_m - deck.x_m, true_y_m - deck.y_m, difference(true_heading_rad, deck.heading_rad)),
            covariance=localizer.pose_covariance.copy(),
            distance_m=hypot(true_x_m - x_m, true_y_m - y_m),
        )

    def is_too_far(self, row: StopRow, point: PointId, fix: Fix, distance_m: float, localizer: Localizer) -> bool:
        """Keep a fix that was fused; whether the point has to be approached again.

        Args:
            row: the state before it.
            point: where it was taken.
            fix: the fix.
            distance_m: of the robot from the point, as the fix shows it.
            localizer: has fused it.
        """
        row.fix_distance_m = distance_m
        if localizer.innovation is not None and localizer.innovation.size == 2:
            row.nis = localizer.innovation.nis
        is_too_far = self._approaches.is_too_far(point, distance_m, localizer.position_sigma_m)
        row.approach = self._approaches.count
        self.stops.append(row)
        if not is_too_far:
            self._fixes.setdefault(point.panel, []).append(fix)
        return is_too_far

    def panel_fits(self) -> dict[PanelId, tuple[float, float, float]]:
        """Piston (m), tip and tilt (rad) of every panel with enough fixes."""
        fits = {}
        for panel, fixes in sorted(self._fixes.items()):
            if len(fixes) < _MIN_FIXES:
                continue
            points = np.array([fix.position_m for fix in fixes])
            covariances = np.array([fix.covariance_m2 for fix in fixes]).reshape(-1, 3, 3)
            try:
                fit = fit_panel(self._mirror, panel, points, covariances, self._cfg.robot.puck_height_m)
            except PanelFitError:
                continue
            fits[panel] = fit.piston_m, fit.tip_rad, fit.tilt_rad
        return fits
