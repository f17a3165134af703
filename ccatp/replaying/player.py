"""Pure. The events of a run through a localizer."""

from array import array
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from ccatp.config.models import Config
from ccatp.filters.base import Filter, FilterError
from ccatp.health.look import as_standing
from ccatp.localization.fixes import FixRefused
from ccatp.localizer import FOUR_STATE, Localizer, build_doubting, build_localizer
from ccatp.mirror.batches import FloatArray
from ccatp.mirror.errors import MirrorError
from ccatp.mirror.mirror import Mirror
from ccatp.replaying.events import Event, Fixed, Marked
from ccatp.replaying.recording_filter import RecordingFilter
from ccatp.replaying.trace import IntArray, Trace, TraceBuilder
from ccatp.samples import DeckPose

# Wheels that turn faster than this move the robot: ten times the noise of an encoder that gives rates.
TURNING_RAD_S = 0.01


@dataclass(slots=True)
class Replayed:
    """What a localizer made of a run.

    Attributes:
        trace: its estimates, each before the fix that was taken there.
        moving: frames in which the wheels turned.
        smoothed: what the whole record says of the same poses, where it was asked for.
        feet: of the fixes taken then: frame before them, deck x, y of the robot's origin as they show it, shape (f, 3).
        fixes: measured; of them ``set_aside`` were kept from the localizer in the run, and are here, and ``refused``
            were not taken by this localizer.
        first_difference: the first fix of another fate than in the run: its time, and what the localizer said to it.
        counts: the localizer's.
    """

    trace: Trace
    moving: IntArray
    smoothed: Trace | None = None
    feet: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    fixes: int = 0
    refused: int = 0
    set_aside: int = 0
    first_difference: tuple[float, str] | None = None
    counts: dict[str, int] = field(default_factory=dict)


def has_smoother(cfg: Config) -> bool:
    """Whether the whole pose is in the filter, so that a smoother can go back over it."""
    return cfg.run.filter not in FOUR_STATE


def replay(
    cfg: Config,
    mirror: Mirror,
    events: Iterable[Event],
    *,
    smooth: bool = False,
    on_frame: Callable[[float], None] | None = None,
) -> Replayed:
    """Run the localizer of a configuration over the events of a run, from its start at base.

    Args:
        cfg: which filter, and its settings.
        mirror: the mirror of the run.
        events: see ``in_order``.
        smooth: go back over the run with the smoother afterwards.
        on_frame: told the robot time of each frame, s.

    Raises:
        ValueError: the filter has no smoother.
        FilterError: the smoothed state is not finite, or the smoother would have to go across a restart.
    """
    if smooth and not has_smoother(cfg):
        raise ValueError(f"no smoother for filter {cfg.run.filter}: the pose is not in it")
    return _Player(cfg, mirror, smooth).play(events, on_frame)


class _Player:
    def __init__(self, cfg: Config, mirror: Mirror, smooth: bool) -> None:
        self._cfg, self._mirror, self._puck_height_m = cfg, mirror, cfg.robot.puck_height_m
        self._recording: RecordingFilter | None = None
        self._wrap: Callable[[Filter], Filter] = self._record if smooth else lambda filter_: filter_
        self._localizer: Localizer = build_localizer(cfg, mirror, self._wrap)
        self._builder = TraceBuilder()
        self._steps = array("q")  # transitions of the filter up to each frame
        self._states = array("d")  # and x, y, heading after them
        self._moving = array("q")
        self._feet = array("d")
        self._seq = -1
        self._fixes = self._refused = self._set_aside = 0
        self._first: tuple[float, str] | None = None

    def _record(self, filter_: Filter) -> Filter:
        self._recording = RecordingFilter(filter_)
        return self._recording

    def play(self, events: Iterable[Event], on_frame: Callable[[float], None] | None) -> Replayed:
        for event in events:
            if isinstance(event, Fixed):
                self._take_fix(event)
            else:
                self._take_frame(event)
                if on_frame is not None:
                    on_frame(event.sensors.t)
        trace = self._builder.build(self._mirror)
        return Replayed(
            trace=trace,
            moving=np.array(self._moving, dtype=np.int64),
            smoothed=self._smooth(trace, self._recording) if self._recording is not None else None,
            feet=np.array(self._feet).reshape(-1, 3),
            fixes=self._fixes,
            refused=self._refused,
            set_aside=self._set_aside,
            first_difference=self._first,
            counts=dict(self._localizer.counts),
        )

    def _begin(self, values: tuple[float, ...]) -> None:
        """A main loop that took over from another one began where the robot was seen last."""
        if self._recording is not None and self._seq >= 0:
            raise FilterError("the main loop was started anew within this recording, and no smoother goes across that")
        x_m, y_m, heading_rad, *sigmas = values
        pose = DeckPose(x_m, y_m, heading_rad)
        self._localizer = build_doubting(self._cfg, self._mirror, pose, (sigmas[0], sigmas[1]), self._wrap)

    def _take_frame(self, event: Marked) -> None:
        """As the main loop does."""
        if event.begun is not None:
            self._begin(event.begun)
        localizer, sensors = self._localizer, event.sensors
        imu, enc = ((), as_standing(sensors.enc)) if event.is_deaf else (sensors.imu, sensors.enc)
        localizer.step(sensors.t, imu, enc, sensors.edge, sensors.gravity)
        if localizer.hold_requested:
            localizer.clear_hold()
        if event.doubted is not None:
            localizer.doubt(*event.doubted)
        if event.at_rest:
            localizer.rest()
        self._seq = sensors.seq
        if any(abs(right or 0.0) > TURNING_RAD_S or abs(left or 0.0) > TURNING_RAD_S for _, right, left in sensors.enc):
            self._moving.append(sensors.seq)
        pose = localizer.pose
        row, col = pose.panel
        self._builder.add(sensors.seq, sensors.t, row, col, (pose.x_m, pose.y_m, pose.heading_rad))
        self._builder.add_covariance(localizer.pose_covariance)
        if self._recording is not None:
            self._steps.append(self._recording.count)
            self._states.extend(self._recording.mean[:3].tolist())

    def _take_fix(self, event: Fixed) -> None:
        self._fixes += 1
        if event.was_set_aside:
            # The mission measured again for it: that has happened, whatever this localizer would have said.
            self._set_aside += 1
            return
        said = ""
        try:
            self._localizer.fuse_fix(event.fix)
        except (FixRefused, FilterError) as refusal:
            said = str(refusal)
            self._refused += 1
        if bool(said) is event.was_fused and self._first is None:
            self._first = event.fix.t_s, said
        if event.was_fused:
            try:
                x, y, _ = self._mirror.foot_of_puck(event.fix.position_m, self._puck_height_m)
            except MirrorError:
                return
            self._feet.extend((self._seq, x, y))

    def _smooth(self, trace: Trace, recording: RecordingFilter) -> Trace:
        """Each pose corrected as the state of the filter that it was carried on from."""
        means, covariances = recording.smooth()
        steps = np.array(self._steps, dtype=np.int64)
        corrections = means[steps] - np.array(self._states).reshape(-1, 3)
        return trace.moved_to(self._mirror, trace.pose + corrections, covariances[steps])
