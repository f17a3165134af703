"""The report of a beacon mission: sections of the page, figures by the names of their files, and its values as data."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

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
from ccatp.report.html import (
    MILLI,
    Fact,
    PageFigure,
    Section,
    Table,
    clock_text,
    events_of,
    inline,
    number_text,
    page_figure,
    render,
)
from ccatp.report.plots import NARROW, WIDE
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

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    return render(
        "beacons.html", f"{record.name}: {record.cfg.system}", sections, record=record, outcome=outcome_of(record),
        heading=TITLES[record.cfg.system], headline=_headline(record),
    )  # fmt: skip


def beacon_figures(record: BeaconRecord) -> "dict[str, Figure]":
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
    """What ``ccatp report --json`` prints; lengths in m, null is not known."""
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


# -- sections ---------------------------------------------------------------------------------------------------------


def _headline(record: BeaconRecord) -> list[Fact]:
    values = []
    rows = waypoint_rows(record)
    if not record.cfg.follow.is_active:
        total = record.cfg.mission.laps * len(record.cfg.workspace.waypoints_m)
        values.append(Fact("waypoints reached", f"{len(rows)}", f"of {total}"))
        known = [row for row in rows if row.sigmas is not None]
        if known:
            within = sum((row.sigmas or 0.0) <= _SIGMAS for row in known)
            values.append(Fact("position there within 3 \u03c3", f"{within}", f"of {len(known)}"))
    errors = _settled(record, pose_errors_m(record))
    if errors is not None:
        largest = f"mm rms, {MILLI * errors.max():.0f} largest"
        values.append(Fact("position error", f"{MILLI * _rms(errors):.0f}", largest))
    beacons = [row.error_m for row in beacon_rows(record) if row.error_m is not None]
    if beacons:
        rms_m = float(np.sqrt(np.mean(np.square(beacons))))
        values.append(Fact("error of the map", f"{MILLI * rms_m:.1f}", f"mm rms of {len(beacons)} beacons"))
    target = (record.summary or {}).get("target") or {}
    if target.get("distance_mean_m") is not None:
        kept = f"m mean, {record.cfg.follow.safe_distance_m:g} to be kept"
        values.append(Fact("distance to the target", f"{target['distance_mean_m']:.2f}", kept))
    if record.statuses:
        values.append(Fact("time", clock_text(record.statuses[-1].elapsed_s)))
    return values


def _map_section(record: BeaconRecord) -> Section | None:
    if not len(record.track.seq):
        return None
    rows = []
    for row in beacon_rows(record):
        place = f"{number_text(row.place_m[0], 3)}, {number_text(row.place_m[1], 3)}"
        rows.append([row.name, place, _mm(row.sigma_m), _mm(row.error_m), number_text(row.nees, 2)])
    head = ["beacon", "x, y, m", "\u03c3 in its worst direction, mm", "true error, mm", "NEES (2 is expected)"]
    values = {"figure": page_figure(partial(beacon_map_figure, record)), "beacons": Table(head, rows)}
    return Section("map", "Path and map", values)


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
            number_text(row.t_s, 1),
            f"{number_text(row.place_m[0], 2)}, {number_text(row.place_m[1], 2)}",
            _mm(row.sigma_m),
            _mm(row.estimate_off_m, 0),
            _mm(row.true_off_m, 0),
            _mm(row.error_m),
            number_text(row.sigmas, 2),
        ]
        for row in rows
    ]
    return Section("waypoints", "Waypoints", {"waypoints": Table(head, cells)})


def _target_section(record: BeaconRecord) -> Section | None:
    picture = _drawn(target_figure, record)
    if picture is None:
        return None
    found = (record.summary or {}).get("target") or {}
    facts = [
        Fact(name, f"{found[key]:.3f}", "m")
        for name, key in (
            ("mean distance", "distance_mean_m"),
            ("least distance", "distance_min_m"),
            ("off the one to be kept, rms", "distance_rms_off_m"),
            ("error of its place at the end", "final_error_m"),
        )
        if found.get(key) is not None
    ]
    return Section("target", "Target", {"figure": picture, "facts": facts})


def _error_section(record: BeaconRecord) -> Section | None:
    if not len(record.track.seq):
        return None
    facts = []
    all_errors = pose_errors_m(record)
    errors = _settled(record, all_errors)
    ratios = _settled(record, None if all_errors is None else all_errors / record.track.sigma_m)
    if errors is not None and ratios is not None:
        facts = [
            Fact("rms", f"{MILLI * _rms(errors):.1f}", "mm"),
            Fact("99th percentile", f"{MILLI * float(np.percentile(errors, 99)):.1f}", "mm"),
            Fact("largest", f"{MILLI * float(errors.max()):.1f}", "mm"),
            Fact("within 3 \u03c3", f"{100.0 * float((ratios <= _SIGMAS).mean()):.1f}", "% of the frames"),
        ]
    values = {
        "facts": facts,
        "figure": page_figure(partial(beacon_error_figure, record)),
        "map_figure": _drawn(map_error_figure, record),
    }
    return Section("localization", "Errors over time", values)


def _consistency_section(record: BeaconRecord) -> Section | None:
    picture = _drawn(consistency_figure, record)
    if picture is None:
        return None
    facts = []
    readings = readings_of(record)
    if readings:
        size = sum(reading.size for reading in readings)
        mean = sum(reading.nis for reading in readings) / size
        low, high = (float(bound) / size for bound in (chdtri(size, at) for at in (0.5 + _BAND / 2, 0.5 - _BAND / 2)))
        facts.append(Fact("mean NIS", f"{mean:.3f}", f"95 % band {low:.3f} to {high:.3f} of {size} readings"))
        facts.append(Fact("readings refused", str(record.maps[-1].refused)))
    nees = _settled(record, pose_nees(record))
    if nees is not None:
        facts.append(Fact("mean NEES of the pose", f"{nees.mean():.2f}", "3 is expected of many runs"))
    beacons = [row.nees for row in beacon_rows(record) if row.nees is not None]
    if beacons:
        facts.append(Fact("mean NEES of the beacons", f"{np.mean(beacons):.2f}", "2 is expected of many runs"))
    return Section("consistency", "Consistency", {"figure": picture, "facts": facts})


def _events_section(record: BeaconRecord) -> Section | None:
    counts = ((record.summary or {}).get("danger") or {}).items()
    denials = ", ".join(f"{name} {times}\u00d7" for name, times in counts)
    return Section("events", "Events", {"events": events_of(record.log), "denials": denials}) if record.log else None


def _configuration_section(record: BeaconRecord) -> Section:
    cfg = record.cfg
    facts = [
        Fact("system", cfg.system),
        Fact("seed", str(cfg.run.seed) if record.is_simulation else number_text(None)),
        Fact("vehicle", str(cfg.vehicle.kind)),
        Fact("speed", str(cfg.control.speed_mode)),
        Fact("ccatp", record.version),
    ]
    return Section("configuration", "Configuration", {"facts": facts})


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


def _drawn(draw: "Callable[[BeaconRecord, float], Figure | None]", record: BeaconRecord) -> PageFigure | None:
    wide, narrow = draw(record, WIDE), draw(record, NARROW)
    return None if wide is None or narrow is None else PageFigure(inline(wide), inline(narrow))


def _settled(record: BeaconRecord, values: FloatArray | None) -> FloatArray | None:
    """Those of the frames that count and have a truth; None without any."""
    if values is None:
        return None
    found = values[(record.track.t_s >= record.settled_s) & np.isfinite(values)]
    return found if len(found) else None


def _rms(errors: FloatArray) -> float:
    return round(float(np.sqrt(np.mean(errors**2))), 6)


def _mm(value_m: float | None, decimals: int = 1) -> str:
    return number_text(None if value_m is None else MILLI * value_m, decimals)
