"""The report of a mission among beacons: page, figures by the names of their files, and values as data.

Lengths are in m and times in s, unless a name has another unit; null means not known.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.beacons.report import figures
from ccatp.beacons.report import record as beacon_record
from ccatp.beacons.report.record import BeaconRecord
from ccatp.filters.metrics import consistency
from ccatp.report.html import Draw, RunReport, events_of, page_figures, render
from ccatp.report.record import COMPLETE, PointOutcome

_SIGMAS = 3.0
TITLES = {
    "zigbee": "Waypoints among ZigBee beacons",
    "follow": "Following a radio",
    "cricket": "Navigation by ultrasonic motes",
}


def beacon_page(record: BeaconRecord) -> str:
    """The report as one HTML file. A section without data is left out."""
    found = _beacon_findings(record)
    map_errors = [row.error_m for row in found["beacons"] if row.error_m is not None]
    return render(
        "ccatp.beacons.report:beacons.html",
        record=record,
        data=beacon_data(record),
        figures=page_figures(beacon_drawings(record)),
        heading=TITLES[record.cfg.system],
        map_rms_m=float(np.sqrt(np.mean(np.square(map_errors)))) if map_errors else None,
        target=(record.summary or {}).get("target") or {},
        events=events_of(record.log),
        **found,
    )


def beacon_drawings(record: BeaconRecord) -> dict[str, Draw]:
    """Functions that draw the figures of the report, by file name."""
    has_track = bool(len(record.track.seq))
    drawings = {
        "map": (figures.beacon_map_figure, has_track),
        "localization": (figures.beacon_error_figure, has_track),
        "consistency": (figures.consistency_figure, beacon_record.readings_of(record) or record.truth is not None),
        "beacons": (figures.map_error_figure, len(figures.standing_maps(record)) > 1),
        "target": (figures.target_figure, figures.target_curves(record)),
    }
    return {name: partial(draw, record) for name, (draw, is_known) in drawings.items() if is_known}


def beacon_data(record: BeaconRecord) -> dict[str, Any]:
    """Output of ``ccatp report --json``; lengths in m, null means not known."""
    cfg, found = record.cfg, _beacon_findings(record)
    outcome, errors, nis, pose_nees = (found[name] for name in ("outcome", "errors", "nis", "pose_nees"))
    known = [row.sigmas for row in found["waypoints"] if row.sigmas is not None]
    return {
        "run": record.name,
        "system": record.cfg.system,
        "simulation": record.is_simulation,
        "seed": record.cfg.run.seed,
        "outcome": outcome.text,
        "cause": outcome.cause,
        "waypoints": {
            "total": 0 if cfg.follow.is_active else cfg.mission.laps * len(cfg.workspace.waypoints_m),
            "reached": len(found["waypoints"]),
            "within_3_sigma": sum(sigmas <= _SIGMAS for sigmas in known) if known else None,
        },
        "position_error_m": errors and {"rms": errors["rms_m"], "max": round(errors["max_m"], 6)},
        "pose_nees_mean": None if pose_nees is None else round(pose_nees, 4),
        "nis_mean": nis and round(nis.mean, 4),
        "beacons": {
            name: {"x_m": round(x_m, 4), "y_m": round(y_m, 4), "sigma_m": round(sigma_m, 6)}
            for name, (x_m, y_m), sigma_m, *_ in found["beacons"]
        },
        "missing": list(record.missing),
        "warnings": list(record.warnings),
    }


def _beacon_findings(record: BeaconRecord) -> dict[str, Any]:
    """Outcome, beacons, waypoints, mean NIS; errors and NEES of the evaluated frames that have a truth."""
    errors, nees = beacon_record.pose_errors_m(record), beacon_record.pose_nees(record)
    readings = beacon_record.readings_of(record)
    found: dict[str, Any] = {
        "outcome": outcome_of(record),
        "beacons": beacon_record.beacon_rows(record),
        "waypoints": beacon_record.waypoint_rows(record),
        "errors": None,
        "pose_nees": None,
    }
    if errors is not None and nees is not None:
        does_count = record.track.t_s >= record.settled_s
        settled, ratios, nees = (
            values[does_count & np.isfinite(values)] for values in (errors, errors / record.track.sigma_m, nees)
        )
        found["pose_nees"] = float(nees.mean()) if len(nees) else None
        if len(settled) and len(ratios):
            found["errors"] = {
                "rms_m": round(float(np.sqrt(np.mean(settled**2))), 6),
                "p99_m": float(np.percentile(settled, 99)),
                "max_m": float(settled.max()),
                "within_sigma3": float((ratios <= _SIGMAS).mean()),
            }
    found["nis"] = consistency(np.array([one.nis for one in readings]), np.array([one.size for one in readings]))
    found["nis_size"] = sum(one.size for one in readings)
    return found


def outcome_of(record: BeaconRecord) -> PointOutcome:
    """Outcome and its cause."""
    if record.summary is not None:
        outcome, cause = (str(record.summary.get(key) or "") for key in ("outcome", "cause"))
        return PointOutcome(outcome or "ended before its goal", cause, outcome == COMPLETE)
    if not record.statuses:
        return PointOutcome("not known", "", False)
    last = record.statuses[-1]
    return PointOutcome(last.outcome or f"in progress, or killed: {last.state}", last.cause, last.outcome == COMPLETE)


def beacon_report(run_dir: Path) -> RunReport:
    """The report of a run. RunReadError: there is no run; ConfigError: its configuration cannot be used."""
    record = beacon_record.read_beacon_record(run_dir)
    return RunReport(beacon_page(record), beacon_data(record), beacon_drawings(record), record.warnings)
