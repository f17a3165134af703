"""Glue. What the main loop tells of a survey: estimates, arrivals, fixes, how the localizer is treated."""

import structlog

from ccatp.bus import Publisher
from ccatp.localizer import Localizer
from ccatp.processes.painting import Look, Painter
from ccatp.processes.telling import Teller
from ccatp.samples import Fix, PointId
from ccatp.wire.topics import (
    Arrival,
    Estimate,
    FixMessage,
    Message,
    MissionStatus,
    Rest,
    Track,
    Treatment,
    TreatmentKind,
    is_estimate_due,
)


class SurveyTeller(Teller):
    """Publishes for a survey.

    Args:
        publisher: main's publisher.
        log: the process's logger.
    """

    def __init__(self, publisher: Publisher, log: structlog.typing.FilteringBoundLogger) -> None:
        """Start with empty batches."""
        super().__init__(publisher, log)
        self._painter = Painter(publisher, look_at_localizer)
        self._track: list[tuple[int, float, int, int, float, float, float, float]] = []

    def frame(
        self,
        seq: int,
        t_s: float,
        localizer: Localizer,
        state: str,
        raw: bytes,
        told: tuple[tuple[float, float, float, float], int] | None = None,
        *,
        is_first: bool = False,
    ) -> None:
        """Keep the estimate after frame ``seq`` and the frame's line for the batch; publish it where it is due.

        Args:
            seq, t_s: the frame.
            localizer: has the estimate.
            state: of the mission.
            raw: the frame's line.
            told: span of the set points since the last estimate, rad/s, and the number of the newest drive.
            is_first: of a session; it is always due, because the danger loop may wait for it.
        """
        self.seq, self.t_s = seq, t_s
        self._painter.sees(localizer, raw)
        pose, sigma = localizer.pose, localizer.position_sigma_m
        if is_first or is_estimate_due(seq):
            deck = localizer.deck_pose
            x, y, heading = deck.x_m, deck.y_m, deck.heading_rad
            commanded, drive_seq = told if told is not None else (None, -1)
            message = Estimate(
                seq=seq,
                t_s=t_s,
                x_m=x,
                y_m=y,
                heading_rad=heading,
                sigma_m=sigma,
                state=state,
                commanded=commanded,
                drive_seq=drive_seq,
            )
            self._publisher.send("estimate", message)
        row, col = pose.panel
        self._track.append((seq + self._frames_before, t_s, row, col, pose.x_m, pose.y_m, pose.heading_rad, sigma))
        self.keep(raw)

    def take_estimates(self) -> tuple[str, Message] | None:
        """The pending rows of the track."""
        rows, self._track = self._track, []
        return ("track", Track(seq=self.seq, t_s=self.t_s, rows=rows)) if rows else None

    def arrival(self, seq: int, t_s: float, point: PointId, error_m: float) -> None:
        """The robot came to rest in frame ``seq``, at a point for the first time."""
        message = Arrival(
            seq=seq + self._frames_before, t_s=t_s, point=(point.row, point.col, point.point), error_mm=1e3 * error_m
        )
        self._publisher.send("arrival", message)

    def rest(self, seq: int, t_s: float) -> None:
        """The mission takes the robot to be at rest from frame ``seq`` on."""
        self._publisher.send("rest", Rest(seq=seq, t_s=t_s))

    def treatment(self, seq: int, t_s: float, kind: TreatmentKind, values: tuple[float, ...] = ()) -> None:
        """The localizer is treated in frame ``seq``; see ``Treatment``."""
        self._publisher.send("treatment", Treatment(seq=seq, t_s=t_s, kind=kind, values=values))

    def fix(
        self, point: PointId | None, fix: Fix, jump_m: float, *, is_fused: bool, is_set_aside: bool = False
    ) -> None:
        """A fix was measured after the last frame; no point for one that only finds the robot.

        Args:
            point: that was measured.
            fix: as measured.
            jump_m: of the estimate.
            is_fused: the localizer took it.
            is_set_aside: the localizer was not given it.
        """
        message = FixMessage(
            seq=self.seq,
            t_s=fix.t_s,
            point=(point.row, point.col, point.point) if point is not None else None,
            is_fused=is_fused,
            position_m=fix.position_m,
            covariance_m2=list(fix.covariance_m2),
            dop=fix.dop,
            residual_rms_m=fix.residual_rms_m,
            channels=list(fix.channels),
            jump_mm=1e3 * jump_m,
            is_set_aside=is_set_aside,
        )
        self._publisher.send("fix", message)

    def status(self, message: MissionStatus) -> None:
        """Publish the mission's status, and a picture of all that is newest for whoever looks on."""
        super().status(message)
        self._painter.tell_if_wanted(self.seq, self.t_s)


def look_at_localizer(localizer: Localizer) -> Look:
    """The pose on the deck, and the filter's last update."""
    pose, covariance, innovation = localizer.deck_pose, localizer.pose_covariance, localizer.innovation
    return Look(
        x_m=pose.x_m,
        y_m=pose.y_m,
        heading_rad=pose.heading_rad,
        covariance_m2=(float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])),
        heading_sigma_rad=localizer.heading_sigma_rad,
        nis=innovation.nis if innovation is not None else 0.0,
        size=innovation.size if innovation is not None else 0,
    )
