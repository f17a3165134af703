"""Pure. The page of a survey: its points, the errors against laser and truth, the path."""

from collections.abc import Iterable
from math import dist
from typing import Any

from ccatp.config.models import Config
from ccatp.dashboard.against_truth import Second, TruthCompare
from ccatp.dashboard.ground import ARRIVED, MEASURED, PLANNED, SKIPPED, point_name, survey_points
from ccatp.dashboard.view import View
from ccatp.mirror.batches import deck_poses
from ccatp.mirror.errors import ConvergenceError
from ccatp.mirror.mirror import Mirror
from ccatp.samples import PanelId, PanelPose, PointId, Vector3
from ccatp.wire.topics import Arrival, FixMessage, MissionStatus, Picture, Track, Truth

SERIES = ("arrival", "jump", "nis", "error")
"""Rows of robot time (s) and: arrival error by the laser (mm); how far a fix moved the estimate (mm); NIS and degrees
of freedom; true error and three sigma of the position (mm), the latter alone where nobody knows the truth."""


class SurveyView(View):
    """What a page shows of a survey.

    Args:
        mirror: where it takes place.
        cfg: the run's configuration.
        is_sim: robot and laser system are stand-ins.
    """

    def __init__(self, mirror: Mirror, cfg: Config, *, is_sim: bool) -> None:
        """Nothing heard."""
        super().__init__(is_sim=is_sim, series=SERIES)
        self._mirror, self._puck_height_m = mirror, cfg.robot.puck_height_m
        self.points = survey_points(mirror, cfg)
        self._index = {point: k for k, point in enumerate(self.points)}
        self._by_name = {point_name(point): k for k, point in enumerate(self.points)}
        self._states = [PLANNED] * len(self.points)
        self._errors_mm: list[float | None] = [None] * len(self.points)
        self._changed: set[int] = set()
        self._truth = TruthCompare()
        self._sigma_second = -1
        self._takers |= {
            Arrival: self._take_arrival,
            FixMessage: self._take_fix,
            Track: self._take_track,
            Truth: self._take_truth,
        }

    def begin_with(self, measured: Iterable[tuple[PointId, float, Vector3]], skipped: Iterable[PointId]) -> None:
        """What was done before this process began.

        Args:
            measured: points with the time (s) and the puck (world frame, m) of their fixes, in any order.
            skipped: points left out.
        """
        for point, t_s, position_m in sorted(measured, key=lambda row: row[1]):
            self._measured(point, t_s, position_m)
        for point in skipped:
            self._mark(self._index.get(point), SKIPPED)

    def _take_status(self, status: MissionStatus, now_s: float) -> None:
        super()._take_status(status, now_s)
        for names in status.left_out.values():
            for name in names:
                index = self._by_name.get(name)
                if index is not None and self._states[index] != MEASURED:
                    self._mark(index, SKIPPED)

    def _take_picture(self, picture: Picture, now_s: float) -> None:
        before = self._picture
        super()._take_picture(picture, now_s)
        if picture.size and (before is None or picture.nis != before.nis):
            self._series["nis"].add(round(picture.t_s, 2), round(picture.nis, 3), picture.size)

    def _take_arrival(self, arrival: Arrival, _now_s: float) -> None:
        index = self._index.get(PointId(*arrival.point))
        if index is not None and self._states[index] != MEASURED:
            self._mark(index, ARRIVED)

    def _take_fix(self, fix: FixMessage, now_s: float) -> None:
        self.links.fix_s = now_s
        if fix.is_fused:
            self._series["jump"].add(round(fix.t_s, 2), round(fix.jump_mm, 4))
        if fix.is_fused and fix.point is not None:
            self._measured(PointId(*fix.point), fix.t_s, fix.position_m)

    def _measured(self, point: PointId, t_s: float, position_m: Vector3) -> None:
        index = self._index.get(point)
        if index is None:
            return
        self._mark(index, MEASURED)
        mirror = self._mirror
        try:
            x_m, y_m, _ = mirror.foot_of_puck(position_m, self._puck_height_m)
        except ConvergenceError:
            return  # whatever it is a fix of, it is not on this mirror
        target = mirror.surface_point(*mirror.point_on_deck(point))
        error_mm = round(1e3 * dist(mirror.surface_point(x_m, y_m), target), 3)
        self._errors_mm[index] = error_mm
        self._series["arrival"].add(round(t_s, 2), error_mm)
        if not self.is_tracking:
            self._trail.add(x_m, y_m)

    def _take_track(self, track: Track, _now_s: float) -> None:
        rows = [row for row in track.rows if TruthCompare.is_compared(row[0])]
        if not rows:
            return
        poses = deck_poses(self._mirror, [PanelPose(PanelId(r[2], r[3]), r[4], r[5], r[6]) for r in rows])
        for row, (x_m, y_m) in zip(rows, poses[:, :2].tolist(), strict=True):
            self._trail.add(x_m, y_m)
            if self._is_sim:
                self._compared(self._truth.estimate(row[0], x_m, y_m, row[7]))
            elif int(row[1]) != self._sigma_second:
                self._sigma_second = int(row[1])
                self._series["error"].add(round(row[1], 2), None, round(3e3 * row[7], 3))

    def _take_truth(self, truth: Truth, _now_s: float) -> None:
        self._compared(self._truth.truth(row[:4] for row in truth.rows))

    def _compared(self, seconds: Iterable[Second]) -> None:
        for second in seconds:
            self._series["error"].add(round(second.t_s, 2), round(second.error_mm, 3), round(second.three_sigma_mm, 3))

    def _mark(self, index: int | None, state: int) -> None:
        if index is not None:
            self._states[index] = state
            self._changed.add(index)

    def _own_news(self) -> dict[str, Any]:
        points = [[k, self._states[k], self._errors_mm[k]] for k in sorted(self._changed)]
        self._changed.clear()
        return {"points": points}

    def _own_all(self) -> dict[str, Any]:
        return {"points": [[k, s, self._errors_mm[k]] for k, s in enumerate(self._states) if s != PLANNED]}

    def _next_point(self) -> str:
        """On the way to a stop that is no point the mission names none; then it is the first to be done."""
        if self.status is None or self.status.point or self.status.outcome or PLANNED not in self._states:
            return super()._next_point()
        return point_name(self.points[self._states.index(PLANNED)])
