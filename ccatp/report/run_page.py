"""The reports of surveys and beacon missions: pages, figures by the names of their files, and values as data.

Lengths of the data of a survey in mm, times in s, unless a name says otherwise; null is not known.
"""

from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtri

from ccatp.core import FloatArray
from ccatp.mirror.panel_alignment import MirrorWavefront, PanelResult, mirror_wavefront
from ccatp.report.beacon_record import (
    BeaconRecord,
    beacon_rows,
    pose_errors_m,
    pose_nees,
    read_beacon_record,
    readings_of,
    waypoint_rows,
)
from ccatp.report.figures import (
    beacon_error_figure,
    beacon_map_figure,
    consistency_figure,
    error_figure,
    map_error_figure,
    standing_maps,
    target_curves,
    target_figure,
    time_figure,
)
from ccatp.report.findings import Findings, Grade, PointVerdict, findings_of
from ccatp.report.html import MICRO, Draw, events_of, page_figures, render, write_page, write_pictures
from ccatp.report.mirror_map import path_figure, surface_figure
from ccatp.report.record import COMPLETE, WITHIN_MM, PointOutcome, is_beacon_run, read_record

REPORT = "report.html"
_FEW = 12  # panels of a table; more are folded


class Report(NamedTuple):
    """A report that was written."""

    path: Path
    data: dict[str, Any]
    warnings: tuple[str, ...]


def report_run(run_dir: Path, out: Path | None = None, figures: Path | None = None) -> Report:
    """Write the report of a run, by default into its directory, and its figures if a directory is given.

    Raises:
        RunReadError: no run there.
        ConfigError: its configuration cannot be used.
        ReportError: the page cannot be written.
        PictureError: a figure cannot be written.
    """
    path = out or run_dir / REPORT
    if is_beacon_run(run_dir):
        record = read_beacon_record(run_dir)
        markup, data, pictures = beacon_page(record), beacon_data(record), beacon_drawings(record)
        warnings = record.warnings
    else:
        found = findings_of(read_record(run_dir))
        markup, data, pictures = run_page(found), run_data(found), run_drawings(found)
        warnings = found.record.warnings
    write_page(markup, path)
    if figures is not None:
        write_pictures(pictures, figures)
    return Report(path, data, warnings)


def run_page(found: Findings) -> str:
    """The report as one HTML file. A section that a run holds nothing for is left out."""
    record, alignment = found.record, found.alignment
    figures = page_figures(run_drawings(found))
    fitted = () if alignment is None else alignment.panels
    panels = [(panel, mirror_wavefront([panel.rigid.wavefront]), _remarks(panel)) for panel in fitted]
    by_panel: dict[tuple[int, int], dict[int, PointVerdict]] = {}
    for verdict in found.points:
        by_panel.setdefault(verdict.point.panel, {})[verdict.point.point] = verdict
    sections = (
        ("map", "Path and arrivals", "path" in figures),
        ("points", "Points: pass or fail", found.points),
        ("surface", "Surface", found.points or "surface" in figures),
        ("panels", "Panels and adjusters", alignment is not None and (fitted or alignment.undetermined)),
        ("time", "Time budget", found.budget),
        ("localization", "Localization error", found.errors),
        ("events", "Events", record.log),
        ("configuration", "Configuration", True),
    )
    return render(
        "run.html",
        f"{record.name}: {record.mirror.name}",
        sections,
        found=found,
        record=record,
        data=run_data(found),
        figures=figures,
        within_mm=f"{WITHIN_MM:.0f}",
        counts=found.counts,
        never=Counter(verdict.why for verdict in found.points if verdict.grade is Grade.OPEN),
        by_panel=by_panel,
        panels=panels,
        worst=sorted(panels, key=lambda row: row[1].before_m if row[1] else 0.0, reverse=True)[:_FEW],
        few=_FEW,
        wavefront=None if alignment is None else alignment.wavefront,
        events=events_of(record.log),
    )


def _remarks(panel: PanelResult) -> str:
    found = []
    if panel.outliers:
        found.append("left out: " + ", ".join(str(point.point) for point in panel.outliers))
    if panel.shape is not None and panel.shape.is_significant:
        found.append("bent")
    return "; ".join(found)


def run_drawings(found: Findings) -> dict[str, Draw]:
    """What draws each figure of the report, by the names of their files."""
    record, alignment = found.record, found.alignment
    drawings: dict[str, Draw] = {}
    if found.points or record.sessions:
        drawings["path"] = partial(path_figure, record, found.points)
    if alignment is not None and alignment.panels:
        title = f"{record.mirror.name}: deviation of the surface"
        drawings["surface"] = partial(surface_figure, record.mirror, alignment.panels, title)
    if found.budget is not None:
        drawings["time"] = partial(time_figure, [("this run", found.budget)], record.cfg.run.budget_s)
    if found.errors is not None:
        drawings["localization"] = partial(error_figure, found.errors)
    return drawings


def run_data(found: Findings) -> dict[str, Any]:
    """What ``ccatp report --json`` prints."""
    record, budget = found.record, found.budget
    return {
        "run": record.name,
        "mirror": record.mirror.name,
        "simulation": record.is_simulation,
        "world": record.cfg.world.name if record.is_simulation else None,
        "seed": record.cfg.run.seed,
        "outcome": found.outcome.text,
        "cause": found.outcome.cause,
        "points": {
            "total": len(found.points),
            **{str(grade).replace(" ", "_"): sum(v.grade is grade for v in found.points) for grade in Grade},
        },
        "arrival_error_mm": _spread([v.first_mm for v in found.points if v.first_mm is not None]),
        "localization_error_mm": None if found.figures is None else _rounded(found.figures._asdict()),
        "time_budget_s": None
        if budget is None
        else {
            "spent": _rounded(budget.spent_s),
            "least": None if budget.least_s is None else _rounded(budget.least_s),
            "total": round(budget.total_s, 3),
            "bound": None if budget.bound_s is None else round(budget.bound_s, 3),
            "is_exact": budget.is_exact,
        },
        "half_wavefront_um": None if found.alignment is None else wavefront_data(found.alignment.wavefront),
        "missing": list(record.missing),
        "warnings": list(record.warnings),
    }


def _spread(values: list[float]) -> dict[str, float] | None:
    return _rounded({"mean": sum(values) / len(values), "max": max(values)}) if values else None


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 6) for name, value in values.items()}


def wavefront_data(wavefront: MirrorWavefront | None) -> dict[str, float] | None:
    """Half-wavefront errors, um; None where there are none."""
    if wavefront is None:
        return None
    return {name.removesuffix("_m"): round(v * MICRO, 4) for name, v in wavefront._asdict().items()}


# -- missions among beacons -------------------------------------------------------------------------------------------

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
