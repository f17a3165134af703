"""The report of a mission among beacons: head, sections, figures by name, and the figures of it as data."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.special import chdtri

from ccatp.core import FloatArray
from ccatp.report.beacon_figures import (
    beacon_error_figure,
    beacon_map_figure,
    consistency_figure,
    map_error_figure,
    target_figure,
)
from ccatp.report.drawing import Drawing
from ccatp.report.html import WIDE, Section, chips, clock, facts, figure, foot, head, page, shown, table, text
from ccatp.report.record import (
    COMPLETE,
    BeaconRecord,
    PointOutcome,
    beacon_rows,
    pose_errors_m,
    pose_nees,
    readings_of,
    waypoint_rows,
)
from ccatp.report.sections import changes_body, events_body

_MILLI = 1e3
_SIGMAS = 3.0
_BAND = 0.95
TITLES = {
    "zigbee": "Waypoints among ZigBee beacons",
    "follow": "Following a radio",
    "cricket": "Navigation by ultrasonic motes",
}


def beacon_page(record: BeaconRecord) -> str:
    """The report as one HTML file."""
    sections = [section for make in SECTIONS if (section := make(record)) is not None]
    return page(f"{record.name}: {record.cfg.system}", _head(record), sections, foot(record))


def beacon_figures(record: BeaconRecord) -> dict[str, Drawing]:
    """The figures of the report, by the names of their files."""
    if not len(record.track.seq):
        return {}
    found = {"map": beacon_map_figure(record, WIDE), "localization": beacon_error_figure(record, WIDE)}
    drawn = {
        "consistency": consistency_figure(record, WIDE),
        "beacons": map_error_figure(record, WIDE),
        "target": target_figure(record, WIDE),
    }
    return found | {name: picture for name, picture in drawn.items() if picture is not None}


def beacon_data(record: BeaconRecord) -> dict[str, Any]:
    """What ``ccatp report --json`` tells of it; lengths in m, null is not known."""
    outcome = outcome_of(record)
    errors = _settled(record, pose_errors_m(record))
    rows = waypoint_rows(record)
    known = [row for row in rows if row.sigmas is not None]
    nees = _settled(record, pose_nees(record))
    readings = readings_of(record)
    size = sum(reading.size for reading in readings)
    return {
        "run": record.name,
        "system": record.cfg.system,
        "simulation": record.is_simulation,
        "seed": record.cfg.run.seed,
        "outcome": outcome.text,
        "cause": outcome.cause,
        "waypoints": {
            "total": 0
            if record.cfg.follow.is_active
            else record.cfg.mission.laps * len(record.cfg.workspace.waypoints_m),
            "reached": len(rows),
            "within_3_sigma": sum((row.sigmas or 0.0) <= _SIGMAS for row in known) if known else None,
        },
        "position_error_m": None if errors is None else {"rms": _rms(errors), "max": round(float(errors.max()), 6)},
        "pose_nees_mean": None if nees is None else round(float(nees.mean()), 4),
        "nis_mean": round(sum(reading.nis for reading in readings) / size, 4) if size else None,
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
        outcome = str(record.summary.get("outcome") or "")
        cause = str(record.summary.get("cause") or "")
        return PointOutcome(outcome or "ended before its goal", cause, outcome == COMPLETE)
    last = record.statuses[-1] if record.statuses else None
    if last is None:
        return PointOutcome("not known", "", False)
    return PointOutcome(last.outcome or f"goes on, or was killed: {last.state}", last.cause, last.outcome == COMPLETE)


def _head(record: BeaconRecord) -> str:
    chip = chips(record.is_simulation, f"seed {record.cfg.run.seed}")
    return head(record, chip, TITLES[record.cfg.system], outcome_of(record), record.warnings, _headline(record))


def _headline(record: BeaconRecord) -> dict[str, str]:
    values: dict[str, str] = {}
    rows = waypoint_rows(record)
    if not record.cfg.follow.is_active:
        total = record.cfg.mission.laps * len(record.cfg.workspace.waypoints_m)
        values["waypoints reached"] = f"{len(rows)} <small>of {total}</small>"
        known = [row for row in rows if row.sigmas is not None]
        if known:
            within = sum((row.sigmas or 0.0) <= _SIGMAS for row in known)
            values["position there within 3 \u03c3"] = f"{within} <small>of {len(known)}</small>"
    errors = _settled(record, pose_errors_m(record))
    if errors is not None:
        values["position error"] = (
            f"{_MILLI * _rms(errors):.0f} <small>mm rms, {_MILLI * errors.max():.0f} largest</small>"
        )
    beacons = [row.error_m for row in beacon_rows(record) if row.error_m is not None]
    if beacons:
        rms_m = float(np.sqrt(np.mean(np.square(beacons))))
        values["error of the map"] = f"{_MILLI * rms_m:.1f} <small>mm rms of {len(beacons)} beacons</small>"
    target = (record.summary or {}).get("target") or {}
    if target.get("distance_mean_m") is not None:
        kept = f"<small>m mean, {record.cfg.follow.safe_distance_m:g} to be kept</small>"
        values["distance to the target"] = f"{target['distance_mean_m']:.2f} {kept}"
    if record.statuses:
        values["time"] = clock(record.statuses[-1].elapsed_s)
    return values


# -- sections ---------------------------------------------------------------------------------------------------------


def _map_section(record: BeaconRecord) -> Section | None:
    if not len(record.track.seq):
        return None
    caption = "Ellipses are of three standard deviations. The path carries some, at equal distances of time."
    rows = []
    for row in beacon_rows(record):
        place = f"{shown(row.place_m[0], 3)}, {shown(row.place_m[1], 3)}"
        error = None if row.error_m is None else _MILLI * row.error_m
        rows.append([text(row.name), place, shown(_MILLI * row.sigma_m, 1), shown(error, 1), shown(row.nees, 2)])
    head = ["beacon", "x, y, m", "\u03c3 in its worst direction, mm", "true error, mm", "NEES (2 is expected)"]
    body = figure(partial(beacon_map_figure, record), caption)
    return Section("map", "Path and map", body + (table(head, rows) if rows else "<p>No beacon came on the map.</p>"))


def _waypoint_section(record: BeaconRecord) -> Section | None:
    rows = waypoint_rows(record)
    if not rows:
        return None
    head = [
        "", "lap, waypoint", "at, s", "x, y, m", "\u03c3, mm", "estimate off it, mm", "truth off it, mm",
        "error of the estimate, mm", "in \u03c3",
    ]  # fmt: skip
    cells = [
        [
            str(row.number),
            f"{row.lap}, {row.waypoint}",
            shown(row.t_s, 1),
            f"{shown(row.place_m[0], 2)}, {shown(row.place_m[1], 2)}",
            shown(_MILLI * row.sigma_m, 1),
            shown(_MILLI * row.estimate_off_m, 0),
            shown(_millis(row.true_off_m), 0),
            shown(_millis(row.error_m), 1),
            shown(row.sigmas, 2),
        ]
        for row in rows
    ]
    radius = f"{_MILLI * record.cfg.control.arrival_radius_m:.0f} mm"
    lead = (
        f"<p>A waypoint is reached when the estimate is within {radius} of it. The last two columns need the truth.</p>"
    )
    return Section("waypoints", "Waypoints", lead + table(head, cells))


def _target_section(record: BeaconRecord) -> Section | None:
    if target_figure(record, WIDE) is None:
        return None
    found = (record.summary or {}).get("target") or {}
    values = {
        name: f"{found[key]:.3f} <small>m</small>"
        for name, key in (
            ("mean distance", "distance_mean_m"),
            ("least distance", "distance_min_m"),
            ("off the one to be kept, rms", "distance_rms_off_m"),
            ("error of its place at the end", "final_error_m"),
        )
        if found.get(key) is not None
    }
    draw = partial(_certain, target_figure, record)
    return Section("target", "Target", (facts(values) if values else "") + figure(draw, "Between the two origins."))


def _error_section(record: BeaconRecord) -> Section | None:
    if not len(record.track.seq):
        return None
    values: dict[str, str] = {}
    all_errors = pose_errors_m(record)
    errors = _settled(record, all_errors)
    ratios = _settled(record, None if all_errors is None else all_errors / record.track.sigma_m)
    if errors is not None and ratios is not None:
        values = {
            "rms": f"{_MILLI * _rms(errors):.1f} <small>mm</small>",
            "99th percentile": f"{_MILLI * float(np.percentile(errors, 99)):.1f} <small>mm</small>",
            "largest": f"{_MILLI * float(errors.max()):.1f} <small>mm</small>",
            "within 3 \u03c3": f"{100.0 * float((ratios <= _SIGMAS).mean()):.1f} <small>% of the frames</small>",
        }
    note = "" if values else "<p>The true pose is not known: three sigma alone.</p>"
    body = facts(values) + note + figure(partial(beacon_error_figure, record), "Distance of the places.")
    if map_error_figure(record, WIDE) is not None:
        caption = "Of the beacons on the map, which become more; the dashed line is what the filter expects."
        body += "<h3>The map</h3>" + figure(partial(_certain, map_error_figure, record), caption)
    return Section("localization", "Errors over time", body)


def _consistency_section(record: BeaconRecord) -> Section | None:
    if consistency_figure(record, WIDE) is None:
        return None
    values: dict[str, str] = {}
    readings = readings_of(record)
    if readings:
        size = sum(reading.size for reading in readings)
        mean = sum(reading.nis for reading in readings) / size
        low, high = (float(bound) / size for bound in (chdtri(size, at) for at in (0.5 + _BAND / 2, 0.5 - _BAND / 2)))
        band = f"<small>95 % band {low:.3f} to {high:.3f} of {size} readings</small>"
        values["mean NIS"] = f"{mean:.3f} {band}"
        values["readings refused"] = text(record.maps[-1].refused)
    nees = _settled(record, pose_nees(record))
    if nees is not None:
        values["mean NEES of the pose"] = f"{nees.mean():.2f} <small>3 is expected of many runs</small>"
    beacons = [row.nees for row in beacon_rows(record) if row.nees is not None]
    if beacons:
        values["mean NEES of the beacons"] = f"{np.mean(beacons):.2f} <small>2 is expected of many runs</small>"
    caption = "Each dot: the readings between two maps. What lies above the edge is drawn on it."
    return Section(
        "consistency", "Consistency", facts(values) + figure(partial(_certain, consistency_figure, record), caption)
    )


def _events_section(record: BeaconRecord) -> Section | None:
    counts = ((record.summary or {}).get("danger") or {}).items()
    told = ", ".join(f"{name} {times}\u00d7" for name, times in counts)
    lead = f"<p>The danger loop denied motion for: {text(told)}.</p>" if told else ""
    return Section("events", "Events", lead + events_body(record.log)) if record.log else None


def _configuration_section(record: BeaconRecord) -> Section:
    cfg = record.cfg
    values = {
        "system": text(cfg.system),
        "seed": text(cfg.run.seed) if record.is_simulation else shown(None),
        "vehicle": text(cfg.vehicle.kind),
        "speed": text(cfg.control.speed_mode),
        "ccatp": text(record.version),
    }
    body = facts(values) + changes_body(record.changed, record.config_text, record.files)
    return Section("configuration", "Configuration", body)


SECTIONS: tuple[Callable[[BeaconRecord], Section | None], ...] = (
    _map_section,
    _waypoint_section,
    _target_section,
    _error_section,
    _consistency_section,
    _events_section,
    _configuration_section,
)
"""In the order of the page. A section that a run has nothing for is left out."""


def _certain(draw: Callable[[BeaconRecord, float], Drawing | None], record: BeaconRecord, width: float) -> Drawing:
    picture = draw(record, width)
    return Drawing(width, 0.0, (), "") if picture is None else picture


def _settled(record: BeaconRecord, values: FloatArray | None) -> FloatArray | None:
    """Those of the frames that count and have a truth; None without any."""
    if values is None:
        return None
    found = values[(record.track.t_s >= record.settled_s) & np.isfinite(values)]
    return found if len(found) else None


def _rms(errors: FloatArray) -> float:
    return round(float(np.sqrt(np.mean(errors**2))), 6)


def _millis(value_m: float | None) -> float | None:
    return None if value_m is None else _MILLI * value_m
