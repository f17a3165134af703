"""Glue. The study `mote-navigation`: motes map themselves, then carry a robot along its route; error against map."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtri

from ccatp.radio.metrics import nees
from ccatp.samples import FloatArray
from ccatp.studies.beacon_rehearsal import rehearse_beacons
from ccatp.studies.campaign import Cell, CellResult, Column, Factors, Job, Outcome, Study
from ccatp.studies.figures import INK, LIMIT, QUIET, colour, dress, new_figure, save
from ccatp.wire.beacon_rows import PoseTrack, PoseTruth, pose_errors

SECOND = 10  # frames; errors are compared once in so many
_STATES = 3  # x, y, heading
_BAND = 0.95


def run_job(job: Job) -> Outcome:
    """One mission: its figures, and errors each second from the end of mapping on."""
    found = rehearse_beacons(job.radio)
    summary = found.summary
    values = {
        "outcome": summary["outcome"],
        "reached": summary["waypoints"]["reached"],
        "within": summary["waypoints"]["within_3_sigma"],
        "position_m": summary["position_error_m"]["rmse"],
        "map_m": summary["beacons"]["rmse_m"],
        "map_expected_m": summary["map"]["map_expected_m"],
        "nis_mean": summary["consistency"]["nis_mean"],
        "readings": summary["consistency"]["readings"],
        "updates": summary["map"]["map_updates"],
    }
    begin_s = summary["map"]["map_time_s"]
    return Outcome(values, seconds_of(*found.poses, begin_s))


def seconds_of(track: PoseTrack, truth: PoseTruth, begin_s: float) -> dict[str, FloatArray]:
    """Errors of the pose, once a second.

    Args:
        track: estimates.
        truth: what was true.
        begin_s: robot time of the first that counts.

    Returns:
        ``nees`` of the pose, ``error_m`` of the position, ``sigma_m``, root of the trace of its covariance.
    """
    known = np.intersect1d(track.seq[track.t_s >= begin_s], truth.seq, return_indices=True)[0][::SECOND]
    track, truth = track.at(np.isin(track.seq, known)), truth.at(np.isin(truth.seq, known))
    errors, P = pose_errors(track, truth), track.covariance
    return {
        "nees": nees(errors, P),
        "error_m": np.hypot(errors[:, 0], errors[:, 1]),
        "sigma_m": np.sqrt(P[:, 0, 0] + P[:, 1, 1]),
    }


def combine(factors: Factors, outcomes: Sequence[Outcome]) -> Outcome:
    """The missions together: NEES at each second over all of them, against the band of its chi-squared sum."""
    del factors
    runs = [outcome.values for outcome in outcomes]
    length = min(len(outcome.arrays["nees"]) for outcome in outcomes)
    squares, errors, sigmas = (
        np.array([outcome.arrays[key][:length] for outcome in outcomes]) for key in ("nees", "error_m", "sigma_m")
    )
    low, high = band(len(outcomes))
    each = squares.mean(axis=0) / _STATES
    readings = sum(run["readings"] for run in runs)
    values: dict[str, Any] = {
        "complete": sum(run["outcome"] == "complete" for run in runs),
        "waypoints": sum(run["reached"] for run in runs),
        "within_3_sigma": sum(run["within"] for run in runs),
        "nees": float(each.mean()),
        "band": [low, high],
        "in_band": float(np.mean((each >= low) & (each <= high))),
        "nis": sum(run["nis_mean"] * run["readings"] for run in runs) / readings,
        "position_m": _root([run["position_m"] for run in runs]),
        "position_expected_m": float(np.sqrt(np.mean(sigmas**2))),
        "map_m": _root([run["map_m"] for run in runs]),
        "map_expected_m": _root([run["map_expected_m"] for run in runs]),
    }
    arrays = {"nees": each, "error_m": np.sqrt((errors**2).mean(axis=0)), "sigma_m": np.sqrt((sigmas**2).mean(axis=0))}
    return Outcome(values, arrays)


def band(runs: int) -> tuple[float, float]:
    """Where the mean NEES of so many poses lies in 95 of 100 cases, for each degree of freedom."""
    dof = _STATES * runs
    low, high = (float(chdtri(dof, at)) / dof for at in (0.5 + _BAND / 2, 0.5 - _BAND / 2))
    return low, high


def draw(cells: Sequence[CellResult], out: Path) -> None:
    """Figure ``mote_navigation``: errors beside what is expected, and NEES in its band, over time."""
    cell = cells[0]
    figure = new_figure(7.5, 5.6)
    above, below = figure.subplots(2, 1, sharex=True)
    seconds = np.arange(len(cell.arrays["nees"]))
    above.plot(seconds, 1e3 * cell.arrays["error_m"], color=colour(0), label="true error of the position")
    above.plot(seconds, 1e3 * cell.arrays["sigma_m"], color=colour(1), linestyle="--", label="expected by the filter")
    above.axhline(
        1e3 * cell.values["map_m"], color=QUIET, linewidth=1.0, linestyle=":", label="true error of the map at the end"
    )
    above.set(ylabel="mm, root mean square", yscale="log")
    above.set_title("A robot that navigates by motes which mapped themselves", color=INK)
    above.legend(frameon=False, fontsize=8)
    low, high = cell.values["band"]
    below.axhspan(low, high, color=colour(2), alpha=0.15, linewidth=0, label="95 % band")
    below.axhline(1.0, color=LIMIT, linewidth=0.9, linestyle=":")
    below.plot(seconds, cell.arrays["nees"], color=colour(0), linewidth=1.2, label="mean NEES of the pose")
    below.set(xlabel="seconds since the map", ylabel="for each degree of freedom", ylim=(0.0, 2.5))
    below.legend(frameon=False, fontsize=8, ncols=2)
    dress(above, below)
    save(figure, out / "mote_navigation")


def _root(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


STUDY = Study(
    name="mote-navigation",
    title="A robot that navigates by motes which mapped themselves",
    cells=lambda: [Cell({"case": "route"})],
    run_job=run_job,
    combine=combine,
    columns=(
        Column("complete", "complete"),
        Column("waypoints", "waypoints"),
        Column("within 3 sigma", "within_3_sigma"),
        Column("NEES / states", "nees", ".3f"),
        Column("95 % band", "band"),
        Column("seconds in the band", "in_band", ".2f"),
        Column("NIS / readings", "nis", ".3f"),
        Column("position, m", "position_m", ".4f"),
        Column("expected, m", "position_expected_m", ".4f"),
        Column("map, m", "map_m", ".4f"),
        Column("expected, m", "map_expected_m", ".4f"),
    ),
    draw=draw,
    defaults={"system": "cricket"},
    mirrors=(),
    runs=50,
    is_radio=True,
)
