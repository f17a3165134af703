"""The report of a beacon mission: its page, its figures by the names of their files, and its values as data."""

from functools import partial
from typing import Any

import numpy as np
from scipy.special import chdtri

from ccatp.core import FloatArray
from ccatp.report.beacon_record import BeaconRecord, beacon_rows, pose_errors_m, pose_nees, readings_of, waypoint_rows
from ccatp.report.figures import (
    beacon_error_figure,
    beacon_map_figure,
    consistency_figure,
    map_error_figure,
    standing_maps,
    target_curves,
    target_figure,
)
from ccatp.report.html import Draw, events_of, page_figures, render
from ccatp.report.record import COMPLETE, PointOutcome

_SIGMAS = 3.0
_BAND = 0.95
TITLES = {
    "zigbee": "Waypoints among ZigBee beacons",
    "follow": "Following a radio",
    "cricket": "Navigation by ultrasonic motes",
}


def beacon_page(record: BeaconRecord) -> str:
    """The report as one HTML file. A section that a run holds nothing for is left out."""
    figures = page_figures(beacon_drawings(record))
    beacons, waypoints = beacon_rows(record), waypoint_rows(record)
    map_errors = [row.error_m for row in beacons if row.error_m is not None]
    nees = _settled(record, pose_nees(record))
    sections = (
        ("map", "Path and map", "map" in figures),
        ("waypoints", "Waypoints", waypoints),
        ("target", "Target", "target" in figures),
        ("localization", "Errors over time", "localization" in figures),
        ("consistency", "Consistency", "consistency" in figures),
        ("events", "Events", record.log),
        ("configuration", "Configuration", True),
    )
    return render(
        "beacons.html",
        f"{record.name}: {record.cfg.system}",
        sections,
        record=record,
        data=beacon_data(record),
        figures=figures,
        outcome=outcome_of(record),
        heading=TITLES[record.cfg.system],
        errors=_error_figures(record),
        beacons=beacons,
        waypoints=waypoints,
        map_rms_m=float(np.sqrt(np.mean(np.square(map_errors)))) if map_errors else None,
        pose_nees=None if nees is None else float(nees.mean()),
        nis=_mean_nis(record),
        target=(record.summary or {}).get("target") or {},
        events=events_of(record.log),
    )


def beacon_drawings(record: BeaconRecord) -> dict[str, Draw]:
    """What draws each figure of the report, by the names of their files."""
    has_track = bool(len(record.track.seq))
    drawings = {
        "map": (beacon_map_figure, has_track),
        "localization": (beacon_error_figure, has_track),
        "consistency": (consistency_figure, readings_of(record) or record.truth is not None),
        "beacons": (map_error_figure, len(standing_maps(record)) > 1),
        "target": (target_figure, target_curves(record)),
    }
    return {name: partial(draw, record) for name, (draw, is_known) in drawings.items() if is_known}


def beacon_data(record: BeaconRecord) -> dict[str, Any]:
    """What ``ccatp report --json`` prints; lengths in m, null is not known."""
    outcome, errors, nis = outcome_of(record), _error_figures(record), _mean_nis(record)
    rows, waypoints_m = waypoint_rows(record), record.cfg.workspace.waypoints_m
    known = [row.sigmas for row in rows if row.sigmas is not None]
    nees = _settled(record, pose_nees(record))
    return {
        "run": record.name,
        "system": record.cfg.system,
        "simulation": record.is_simulation,
        "seed": record.cfg.run.seed,
        "outcome": outcome.text,
        "cause": outcome.cause,
        "waypoints": {
            "total": 0 if record.cfg.follow.is_active else record.cfg.mission.laps * len(waypoints_m),
            "reached": len(rows),
            "within_3_sigma": sum(sigmas <= _SIGMAS for sigmas in known) if known else None,
        },
        "position_error_m": errors and {"rms": errors["rms_m"], "max": round(errors["max_m"], 6)},
        "pose_nees_mean": None if nees is None else round(float(nees.mean()), 4),
        "nis_mean": nis and round(nis["mean"], 4),
        "beacons": {
            row.name: {
                "x_m": round(row.place_m[0], 4),
                "y_m": round(row.place_m[1], 4),
                "sigma_m": round(row.sigma_m, 6),
            }
            for row in beacon_rows(record)
        },
        "missing": list(record.missing),
        "warnings": list(record.warnings),
    }


def outcome_of(record: BeaconRecord) -> PointOutcome:
    """How it ended, and why."""
    if record.summary is not None:
        outcome, cause = (str(record.summary.get(key) or "") for key in ("outcome", "cause"))
        return PointOutcome(outcome or "ended before its goal", cause, outcome == COMPLETE)
    if not record.statuses:
        return PointOutcome("not known", "", False)
    last = record.statuses[-1]
    return PointOutcome(last.outcome or f"goes on, or was killed: {last.state}", last.cause, last.outcome == COMPLETE)


def _mean_nis(record: BeaconRecord) -> dict[str, float] | None:
    """NIS by its degrees of freedom, and the band noise alone keeps it in."""
    readings = readings_of(record)
    size = sum(reading.size for reading in readings)
    if not size:
        return None
    low, high = (float(chdtri(size, at)) / size for at in (0.5 + _BAND / 2, 0.5 - _BAND / 2))
    return {"mean": sum(reading.nis for reading in readings) / size, "low": low, "high": high, "size": size}


def _error_figures(record: BeaconRecord) -> dict[str, float] | None:
    """Of the distance of the estimated place from the true one."""
    all_errors = pose_errors_m(record)
    errors = _settled(record, all_errors)
    ratios = _settled(record, None if all_errors is None else all_errors / record.track.sigma_m)
    if errors is None or ratios is None:
        return None
    return {
        "rms_m": round(float(np.sqrt(np.mean(errors**2))), 6),
        "p99_m": float(np.percentile(errors, 99)),
        "max_m": float(errors.max()),
        "within_sigma3": float((ratios <= _SIGMAS).mean()),
    }


def _settled(record: BeaconRecord, values: FloatArray | None) -> FloatArray | None:
    """Those of the frames that count and have a truth; None without any."""
    if values is None:
        return None
    found = values[(record.track.t_s >= record.settled_s) & np.isfinite(values)]
    return found if len(found) else None
