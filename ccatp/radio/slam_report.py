"""Pure. The result of ``ccatp radio slam``: as data for machines, as a table for people."""

import math
from typing import Any

import numpy as np

from ccatp.filters.base import FloatArray
from ccatp.radio.judged import Judgement, aligned_beacons
from ccatp.radio.recording import RecordedRun
from ccatp.radio.track import Track

SCALES = ("range_scale", "distance_scale", "turn_scale")
"""Told as factors: 1.07 for ranges that read 7 % too long."""


def result_data(run: RecordedRun, filter_name: str, track: Track, judged: Judgement) -> dict[str, Any]:
    """The result as JSON has it; None where nothing is known."""
    beacons = aligned_beacons(track, judged.alignment)
    calibration = {name: (value + (name in SCALES), sigma) for name, (value, sigma) in track.calibration.items()}
    nis, nees = judged.nis, judged.nees
    return {
        "dataset": run.name,
        "format": run.kind,
        "filter": filter_name,
        "trajectory_rmse_m": _finite(judged.trajectory_rmse_m),
        "heading_rmse_rad": _finite(judged.heading_rmse_rad),
        "beacon_rmse_m": _finite(judged.beacon_rmse_m),
        "beacons": {name: [fix.x_m, fix.y_m] for name, fix in beacons.items()},
        "beacon_sigmas_m": {name: np.sqrt(np.diag(fix.covariance)).tolist() for name, fix in beacons.items()},
        "beacon_errors_m": dict(judged.beacon_errors_m),
        "range_scale": calibration["range_scale"][0] if "range_scale" in calibration else None,
        "range_offset_m": calibration["range_offset_m"][0] if "range_offset_m" in calibration else None,
        "calibration": {name: {"value": value, "sigma": sigma} for name, (value, sigma) in calibration.items()},
        "nis_mean": None if nis is None else nis.mean,
        "nis_band": None if nis is None else [nis.low, nis.high],
        "nees_mean": None if nees is None else nees.mean,
        "updates": track.updates,
        "refused": track.refused,
        "update_us_p50": _median_us(track.update_s),
        "predict_us_p50": _median_us(track.predict_s),
        "scalar_us_p50": _median_us(track.scalar_s),
        "warnings": [*run.warnings, *track.warnings],
    }


def table_lines(run: RecordedRun, data: dict[str, Any]) -> list[str]:
    """The result for people."""
    span_s = run.steps.times_s[-1] - run.steps.times_s[0]
    way_m = float(np.abs(run.steps.distance_m).sum())
    heard = f"{len(run.readings.times_s)} readings of {len(run.beacon_ids)} beacons"
    rows = [
        ("data", f"{data['dataset']} ({data['format']}): {span_s:.0f} s, {way_m:.0f} m by odometry, {heard}"),
        ("filter", f"{data['filter']}: {data['updates']} updates, {data['refused']} refused"),
        ("path", _errors(data)),
        ("beacons", _number(data["beacon_rmse_m"], "{:.3f} m rms")),
    ]
    rows += [("calibration", f"{name} {c['value']:.5g} +- {c['sigma']:.2g}") for name, c in data["calibration"].items()]
    if data["nis_mean"] is not None:
        low, high = data["nis_band"]
        rows.append(("NIS", f"{data['nis_mean']:.3f} per degree of freedom (95 % band {low:.3f} to {high:.3f})"))
    if data["nees_mean"] is not None:
        rows.append(("NEES", f"{data['nees_mean']:.3f} per degree of freedom"))
    rows.append(("update", _number(data["update_us_p50"], "{:.0f} us a reading") + _parts(data)))
    lines = [f"{name:<12} {text}" for name, text in rows]
    lines += ["", f"{'beacon':<8} {'x_m':>9} {'y_m':>9} {'sigma_x':>8} {'sigma_y':>8} {'error_m':>8}"]
    for name, (x, y) in data["beacons"].items():
        sx, sy = data["beacon_sigmas_m"][name]
        error = _number(data["beacon_errors_m"].get(name), "{:.3f}")
        lines.append(f"{name:<8} {x:9.3f} {y:9.3f} {sx:8.3f} {sy:8.3f} {error:>8}")
    return lines


def _errors(data: dict[str, Any]) -> str:
    if data["trajectory_rmse_m"] is None:
        return "no truth"
    heading = _number(data["heading_rmse_rad"], ", heading {:.4f} rad rms")
    return f"{data['trajectory_rmse_m']:.3f} m rms" + ("" if heading == "-" else heading)


def _median_us(times_s: FloatArray) -> float | None:
    return float(np.median(times_s)) * 1e6 if times_s.size else None


def _parts(data: dict[str, Any]) -> str:
    predict_us, scalar_us = data["predict_us_p50"], data["scalar_us_p50"]
    if predict_us is None or scalar_us is None:
        return ""
    return f": prediction {predict_us:.0f} us, each scalar {scalar_us:.0f} us"


def _number(value: float | None, shape: str) -> str:
    return "-" if value is None else shape.format(value)


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
