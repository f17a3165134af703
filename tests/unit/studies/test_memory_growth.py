"""Nothing in memory grows with the time a survey takes: a day may cost each process 5 MiB at most."""

import gc
import tracemalloc

import pytest

from ccatp.config.load import load_config
from ccatp.records import summary
from ccatp.studies.sil_run import SilRun
from ccatp.survey.state import Pause

DAY_FRAMES = 24 * 3600 * 100
MOST_IN_A_DAY_BYTES = 5 << 20
# Caches fill; then the frames that are compared. Half way between two hand-overs of a thousand frames to the summary.
WARM_UP_FRAMES, FRAMES = 12_500, 40_000
# A point that was measured is kept with its fix.
POINT_BYTES = 4096


class Enough(Exception):
    """The frames that are compared have been served."""


class MeasuredRun(SilRun):
    """Traced memory after the warm-up and at the end, and how many points were done then."""

    def __init__(self, *, is_paused: bool) -> None:
        super().__init__(load_config(), with_track=False)
        self._is_paused, self._frames = is_paused, 0
        self.bytes: list[int] = []
        self.points: list[int] = []

    def _note_truth(self) -> None:
        super()._note_truth()
        self._frames += 1
        if self._frames == 1000 and self._is_paused:
            self.mission.handle(Pause("operator"))
        if self._frames in (WARM_UP_FRAMES, WARM_UP_FRAMES + FRAMES):
            gc.collect()
            self.bytes.append(tracemalloc.get_traced_memory()[0])
            self.points.append(len(self.mission.state.done))
            if len(self.bytes) == 2:
                raise Enough


@pytest.mark.slow
@pytest.mark.parametrize("is_paused", [True, False], ids=["held", "driving"])
def test_frames_leave_nothing_behind(is_paused: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(summary, "HISTORY_ROWS", 5000)  # bounded, but as it is full only after the warm-up
    run = MeasuredRun(is_paused=is_paused)
    tracemalloc.start()
    try:
        with pytest.raises(Enough):
            run.run()
    finally:
        tracemalloc.stop()
    grown, points = run.bytes[1] - run.bytes[0], run.points[1] - run.points[0]
    assert (points == 0) is is_paused
    assert grown - points * POINT_BYTES <= MOST_IN_A_DAY_BYTES * FRAMES / DAY_FRAMES
