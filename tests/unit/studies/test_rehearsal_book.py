"""Rows of a rehearsal on their way to the summary."""

import numpy as np
import pytest

from ccatp.config.models import Config
from ccatp.sim.world import TruthRow
from ccatp.studies.sil_models import SilTrace
from ccatp.survey.composition import SurveyParts, assemble

FRAMES, DELAY = 2500, 3  # more than two batches; frames by which the estimates lag behind the truth


@pytest.fixture(scope="module")
def parts(config: Config) -> SurveyParts:
    run = config.run.model_copy(update={"panels": 1})
    return assemble(config.model_copy(update={"run": run}))


def true_row(parts: SurveyParts, seq: int) -> TruthRow:
    x_m, y_m = parts.mirror.base_pose.x_m + 1e-5 * seq, parts.mirror.base_pose.y_m
    return seq, 0.01 * seq, x_m, y_m, 0.0, *parts.mirror.surface_point(x_m, y_m), 1.0, 0, 0


def book_of(parts: SurveyParts, *, with_track: bool) -> SilTrace:
    book = SilTrace(parts, with_track=with_track)
    for seq in range(FRAMES):
        book.note_truth(true_row(parts, seq))
        if seq >= DELAY:
            book.note_estimate(seq - DELAY, 0.01 * (seq - DELAY), parts.mirror.base_panel_pose)
    return book


def test_late_estimates_meet_their_truth_across_batches(parts: SurveyParts) -> None:
    book = book_of(parts, with_track=True)
    summary = book.summary(parts.mission, 25.0, {}, {})
    track = book.track()
    assert track is not None
    assert track[:, 0] == pytest.approx(0.01 * np.arange(FRAMES - DELAY))
    base = parts.mirror.base_pose
    assert track[:, 1] - track[:, 4] == pytest.approx(1e-5 * np.arange(FRAMES - DELAY), abs=1e-12)  # rounding
    assert track[:, 5] == pytest.approx(base.y_m, abs=1e-12)
    assert summary["localization_error_mm"]["max"] == pytest.approx(1e-2 * (FRAMES - DELAY - 1), rel=0.02)  # slope


def test_the_truth_of_a_late_frame_is_at_hand(parts: SurveyParts) -> None:
    assert book_of(parts, with_track=False).truth_at(FRAMES - 1 - DELAY) == true_row(parts, FRAMES - 1 - DELAY)


def test_no_track_where_none_was_asked_for(parts: SurveyParts) -> None:
    book = book_of(parts, with_track=False)
    book.summary(parts.mission, 25.0, {}, {})
    assert book.track() is None
