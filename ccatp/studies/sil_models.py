"""Truth and estimate of every frame of a rehearsal, on their way to the summary.

What comes of a rehearsal.

The measurements of a rehearsal: lengths of the stand-in's model, fixes, rows of what was found at a stop.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import hypot
from typing import Any

import numpy as np

from ccatp.config.models import Config
from ccatp.core import DeckPose, Fix, FloatArray, PanelId, PanelPose, PointId, difference
from ccatp.links import multiline
from ccatp.localizer import Localizer
from ccatp.mirror.mirror import Mirror, deck_poses
from ccatp.mirror.misalignment import PanelMisalignment, fit_panel
from ccatp.mirror.multilateration import solve_fix
from ccatp.mirror.surface import PanelFitError
from ccatp.records.summary import RunFacts, SummaryBuilder, puck_targets
from ccatp.sim.laser import SEED_STREAM, EtalonModel, PuckTruth
from ccatp.sim.robot import Robot
from ccatp.sim.world import TruthRow
from ccatp.survey.composition import SurveyParts
from ccatp.survey.mission import Mission
from ccatp.survey.state import ApproachCounter

_BATCH = 1000  # frames that go to the summary at a time
_RECENT = 64  # frames of truth at hand: more than any delay of the sensors


class SilTrace:
    """Keeps rows as they come and converts a thousand at a time.

    Args:
        with_track: keep true and estimated pose of every frame.
    """

    def __init__(self, parts: SurveyParts, *, with_track: bool) -> None:
        cfg, mirror = parts.cfg, parts.mirror
        facts = RunFacts(
            mirror=cfg.mirror.name,
            world=cfg.world.name,
            filter=cfg.run.filter,
            seed=cfg.run.seed,
            total_points=parts.total_points,
            lower_bound_s=parts.lower_bound_s,
            budget_s=cfg.run.budget_s,
            puck_height_m=cfg.robot.puck_height_m,
            has_truth=True,
        )
        targets = puck_targets(mirror, parts.points, cfg.robot.puck_height_m)
        self.builder = SummaryBuilder(facts, targets, mirror.surface.normal)
        self._mirror, self._with_track = mirror, with_track
        self._truth: list[TruthRow] = []
        self._recent: deque[TruthRow] = deque(maxlen=_RECENT)
        self._estimates: list[tuple[int, float, PanelPose]] = []
        self._true_rows: list[FloatArray] = []
        self._track_rows: list[FloatArray] = []

    def note_truth(self, row: TruthRow) -> None:
        """The truth at the newest frame."""
        self._truth.append(row)
        self._recent.append(row)

    def note_estimate(self, seq: int, t_s: float, pose: PanelPose) -> None:
        """The estimate after frame ``seq``."""
        self._estimates.append((seq, t_s, pose))
        if len(self._estimates) >= _BATCH:
            self._flush()

    def truth_at(self, seq: int) -> TruthRow:
        """The truth at one of the newest frames."""
        return next(row for row in self._recent if row[0] == seq)

    def _flush(self) -> None:
        if self._truth:
            truth = np.array(self._truth, dtype=np.float64)
            self._truth.clear()
            self.builder.add_truth(truth)
            if self._with_track:
                self._true_rows.append(truth[:, :5])
        if self._estimates:
            seqs, times_s, poses = zip(*self._estimates, strict=True)
            self._estimates.clear()
            x, y, heading, z = deck_poses(self._mirror, poses).T
            rows = np.column_stack([np.array(seqs, dtype=np.float64), times_s, x, y, heading, x, y, z])
            self.builder.add_track(rows)
            if self._with_track:
                self._track_rows.append(rows[:, :5])

    def summary(
        self,
        mission: Mission,
        mission_time_s: float,
        fits: Mapping[PanelId, tuple[float, float, float]],
        misalignments: Mapping[PanelId, PanelMisalignment],
    ) -> dict[str, Any]:
        """The summary of the whole run.

        Args:
            fits: panels as fitted: piston (m), tip and tilt (rad).
        """
        self._flush()
        injected = {panel: (m.piston_m, m.tip_rad, m.tilt_rad) for panel, m in misalignments.items()}
        self.builder.set_mission(len(mission.done), len(mission.skipped), mission_time_s)
        self.builder.set_panels(fits, injected)
        return self.builder.build()

    def track(self) -> FloatArray | None:
        """Rows of t, true x, y, heading, estimated x, y, heading, shape (k, 7), after the summary; None without."""
        if not self._track_rows:
            return None
        true, rows = np.concatenate(self._true_rows), np.concatenate(self._track_rows)
        _, i, j = np.intersect1d(true[:, 0], rows[:, 0], return_indices=True)
        return np.column_stack([true[i, 1:], rows[j, 2:]])


@dataclass(slots=True)
class StopRow:
    """One measurement of a point, before its fix is fused.

    Attributes:
        approach: 1 at the first arrival.
        error: true minus estimated pose: x, y (deck, m), heading (rad).
        covariance: of the estimate of the three, shape (3, 3).
        distance_m: true distance of the puck's foot from the point.
        nis: normalised innovation squared of the fix (two degrees of freedom), NaN where it is not known.
        fix_distance_m: the same distance as the fix shows it, after fusing.
    """

    t_s: float
    point: tuple[int, int, int]
    approach: int
    error: tuple[float, float, float]
    covariance: np.ndarray[Any, np.dtype[np.float64]]
    distance_m: float
    nis: float = float("nan")
    fix_distance_m: float = float("nan")


@dataclass(slots=True)
class SilResult:
    """What came of it.

    Attributes:
        summary: as in ``summary.json``.
        corrections: moves after a fix that showed the robot too far from its point.
        track: rows of t, true x, y, heading, estimated x, y, heading (deck), shape (k, 7), where it was asked for.
    """

    summary: dict[str, Any]
    stops: list[StopRow]
    corrections: int
    counts: dict[str, int]
    outcome: str
    cause: str
    states_s: dict[str, float]
    track: np.ndarray[Any, np.dtype[np.float64]] | None = None
    notices: list[str] = field(default_factory=list)

    @property
    def mission_time_s(self) -> float:
        """Robot time from start to end."""
        return float(self.summary["mission_time_s"])

    @property
    def wall_s(self) -> float:
        """Wall time, where the caller measured it; 0 otherwise."""
        return float(self.summary["wall"]["time_s"] or 0.0)


_MIN_FIXES = 3


class SilLaser:
    """Measures the puck of a simulated robot and keeps what came of it.

    Args:
        cfg: the configuration; its seed seeds the lengths' noise.

    Attributes:
        stops: measurements whose fix was fused, in their order.
    """

    def __init__(self, cfg: Config, mirror: Mirror, robot: Robot) -> None:
        self._cfg, self._mirror, self._robot = cfg, mirror, robot
        channels, collimators_m = mirror.channels, mirror.collimators_m
        rng = np.random.default_rng([cfg.run.seed, SEED_STREAM])
        self._etalon = EtalonModel(cfg.sim.etalon, channels, collimators_m, rng)
        self._collimators_m = dict(zip(channels, collimators_m, strict=True))
        self._approaches = ApproachCounter(cfg.mission.correction_tolerance_m, cfg.mission.max_approaches)
        self._fixes: dict[PanelId, list[Fix]] = {}
        self.stops: list[StopRow] = []

    def fix(self, t_s: float, estimate: DeckPose) -> Fix:
        """Measure now.

        Args:
            t_s: time of the frame to which the fix belongs.

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
            distance_m: of the robot from the point, as the fix shows it.
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
