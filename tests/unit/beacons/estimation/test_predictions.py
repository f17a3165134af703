"""Prediction errors of a causal estimate beside dead reckoning, without a truth."""

from dataclasses import replace

import numpy as np
import pytest

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.estimation.causal import beyond_priors
from ccatp.beacons.estimation.predictions import predicted, prediction_doubts, prediction_lines
from ccatp.beacons.estimation.recording import Calibrated, EstimatedPath, RecordedRun
from ccatp.beacons.studies.recordings import estimate
from ccatp.beacons.studies.trait_runs import trait_run

CONFIG = load_recordings_config(None)


@pytest.fixture(scope="module")
def sound() -> tuple[RecordedRun, EstimatedPath]:
    """A run without a trait, and its estimate; not to be written to."""
    run = trait_run([], 2)
    return run, estimate(run, CONFIG, "fixed-lag")


def test_a_good_estimate_predicts_ranges_to_their_noise_and_better_than_dead_reckoning(
    sound: tuple[RecordedRun, EstimatedPath],
) -> None:
    run, track = sound
    found = predicted(run, track, 0.0)
    assert found is not None
    assert found.estimate_m == pytest.approx(0.05, abs=0.04)  # the noise of a range is 5 to 12 cm
    assert found.reckoned_m > 2.0 * found.estimate_m
    assert found.correlation is not None
    assert abs(found.correlation) < 0.15
    assert not list(prediction_doubts(found))
    assert not any("dead reckoning" in line for line in track.warnings)


def test_errors_of_ranges_that_last_are_shown_as_a_correlation() -> None:
    run = trait_run(["correlated"], 2)
    found = predicted(run, estimate(run, CONFIG, "fixed-lag"), 0.0)
    assert found is not None
    assert found.correlation is not None
    assert found.correlation > 0.4
    assert any("whiteness" in line for line in prediction_lines(found._asdict()))


def test_an_estimate_that_dead_reckoning_beats_gives_a_warning(sound: tuple[RecordedRun, EstimatedPath]) -> None:
    run, track = sound
    wander = 1.0 * np.sin(np.arange(len(track.times_s)) / 20.0)[:, None]
    lost = track._replace(poses=track.poses + wander * (1.0, 1.0, 0.0))
    (warning,) = prediction_doubts(predicted(run, lost, 0.0))
    assert "dead reckoning on its own map" in warning


def test_a_difference_by_chance_gives_no_warning(sound: tuple[RecordedRun, EstimatedPath]) -> None:
    found = predicted(*sound, 0.0)
    assert found is not None
    near = found._replace(reckoned_later_m=0.070, difference_sigma_m=0.002)
    assert not list(prediction_doubts(near._replace(estimate_later_m=0.075)))
    assert not list(prediction_doubts(near._replace(estimate_later_m=0.0711, difference_sigma_m=0.0)))
    (warning,) = prediction_doubts(near._replace(estimate_later_m=0.0771))
    assert "to 0.0771 m, dead reckoning on its own map to 0.07 m" in warning


def test_scales_that_grow_together_are_not_to_be_given_a_wider_prior() -> None:
    priors = {"distance_scale": 0.02, "range_scale": 0.05}

    def said(distance_scale: float, range_scale: float) -> list[str]:
        values = {"distance_scale": distance_scale, "range_scale": range_scale}
        return list(beyond_priors({name: Calibrated(value, 0.01) for name, value in values.items()}, priors, "csv"))

    (line,) = said(0.165, 0.167)
    assert "grow together, to +0.165 and +0.167" in line
    assert "Do not widen" in line
    (line,) = said(0.165, 0.01)
    assert "widen csv.priors.distance_scale" in line
    (line,) = said(0.01, -0.2)
    assert "widen csv.priors.range_scale" in line
    assert said(0.01, 0.01) == []
    for line in said(1.01, 2.12):  # turns in degrees
        assert "which no calibration is: look for a wrong unit" in line
        assert "do not widen csv.priors." in line


def test_too_few_ranges_say_nothing(sound: tuple[RecordedRun, EstimatedPath]) -> None:
    run, track = sound
    few = replace(run, readings=run.readings.where(run.readings.times_s < 1.0))
    assert predicted(few, track, 0.0) is None
    assert not list(prediction_doubts(None))
    assert not list(prediction_lines(None))
