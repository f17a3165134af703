"""The reports of surveys and beacon missions: pages, figures by the names of their files, and values as data.

Data of a survey have lengths in mm and times in s, unless a name has another unit; null means not known.
"""

from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.beacons.report import record as beacon_record
from ccatp.beacons.report.record import BeaconRecord
from ccatp.config.files import write_file
from ccatp.filters.metrics import consistency
from ccatp.mirror.panel_alignment import MirrorWavefront, PanelResult, mirror_wavefront
from ccatp.records.run_reader import RunReadError
from ccatp.report import figures
from ccatp.report.alignment import worst_corner
from ccatp.report.findings import Findings, Grade, coverage_of, findings_of, observation_of
from ccatp.report.html import MICRO, Draw, events_of, page_figures, render, write_pictures
from ccatp.report.mirror_map import path_figure, surface_figure
from ccatp.report.plots import check_drawing
from ccatp.report.record import COMPLETE, WITHIN_MM, PointOutcome, is_beacon_run, read_record
from ccatp.report.tables import write_tables

REPORT = "report.html"
PAGE_MODE = 0o644
_FEW = 12  # panels of a table; a longer table is folded


def report_run(
    run_dir: Path, out: Path | None = None, figures_dir: Path | None = None, tables_dir: Path | None = None
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Write the report of a run, by default into its directory, its figures and tables if directories are given.

    Returns the output of ``ccatp report --json``, and warnings. RunReadError: no run, or no survey for the tables;
    ConfigError: its configuration cannot be used, or the page or a table cannot be written; PictureError: a figure.
    """
    path = out or run_dir / REPORT
    for folder in filter(None, (figures_dir, tables_dir)):
        check_drawing(folder)
    if is_beacon_run(run_dir):
        if tables_dir is not None:
            raise RunReadError(f"{run_dir}: a mission among beacons has no tables; leave out --tables")
        record = beacon_record.read_beacon_record(run_dir)
        markup, data, pictures = beacon_page(record), beacon_data(record), beacon_drawings(record)
        warnings = record.warnings
    else:
        found = findings_of(read_record(run_dir))
        markup, data, pictures = run_page(found), run_data(found), run_drawings(found)
        warnings = found.record.warnings
        if tables_dir is not None:
            write_tables(found, tables_dir)
    write_file(path, markup, PAGE_MODE)
    if figures_dir is not None:
        write_pictures(pictures, figures_dir)
    return {"report": str(path), **data}, warnings


def run_page(found: Findings) -> str:
    """The report as one HTML file. A section without data is left out."""
    record, fitted = found.record, () if found.alignment is None else found.alignment.panels
    panels = [
        (panel, mirror_wavefront([panel.rigid.wavefront]), worst_corner(record.mirror, panel), _remarks(panel))
        for panel in fitted
    ]
    return render(
        "run.html",
        found=found,
        record=record,
        alignment=found.alignment,
        data=run_data(found),
        figures=page_figures(run_drawings(found)),
        within_mm=f"{WITHIN_MM:.0f}",
        never=Counter(verdict.why for verdict in found.points if verdict.grade is Grade.OPEN),
        panels=panels,
        worst=sorted(panels, key=lambda row: abs(row[2][0]), reverse=True)[:_FEW],
        few=_FEW,
        events=events_of(record.log),
    )


def _remarks(panel: PanelResult) -> str:
    left_out = ", ".join(str(point.point) for point in panel.outliers)
    is_bent = panel.shape is not None and panel.shape.is_significant
    return "; ".join(filter(None, (left_out and f"not used: {left_out}", "bent" if is_bent else "")))


def run_drawings(found: Findings) -> dict[str, Draw]:
    """Functions that draw the figures of the report, by file name."""
    record, alignment = found.record, found.alignment
    drawings: dict[str, Draw] = {}
    if found.points or record.sessions:
        drawings["path"] = partial(path_figure, record, found.points)
    if alignment is not None and alignment.panels:
        title = f"{record.mirror.name}: deviation of the surface"
        drawings["surface"] = partial(surface_figure, record.mirror, alignment.panels, title)
    if found.budget is not None:
        drawings["time"] = partial(figures.time_figure, [("this run", found.budget)], record.cfg.run.budget_s)
    if found.errors is not None:
        drawings["localization"] = partial(figures.error_figure, found.errors)
    return drawings


def run_data(found: Findings) -> dict[str, Any]:
    """Data of a survey in the output of ``ccatp report --json``."""
    record, budget = found.record, found.budget
    first = [one.first_mm for one in found.points if one.first_mm is not None]
    return {
        "run": record.name,
        "mirror": record.mirror.name,
        "simulation": record.is_simulation,
        "world": record.cfg.world.name if record.is_simulation else None,
        "seed": record.cfg.run.seed,
        "outcome": found.outcome.text,
        "cause": found.outcome.cause,
        "observation": observation_of(record),
        "coverage": coverage_of(found),
        "points": {
            "total": len(found.points),
            **{str(grade).replace(" ", "_"): sum(v.grade is grade for v in found.points) for grade in Grade},
        },
        "arrival_error_mm": _rounded({"mean": sum(first) / len(first), "max": max(first)}) if first else None,
        "localization_error_mm": found.figures and _rounded(found.figures),
        "time_budget_s": budget
        and {
            "spent": _rounded(budget.spent_s),
            "least": budget.least_s and _rounded(budget.least_s),
            "total": round(budget.total_s, 3),
            "bound": None if budget.bound_s is None else round(budget.bound_s, 3),
            "is_exact": budget.is_exact,
        },
        "half_wavefront_um": found.alignment and wavefront_data(found.alignment.wavefront),
        "missing": list(record.missing),
        "warnings": list(record.warnings),
    }


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 6) for name, value in values.items()}


def wavefront_data(wavefront: MirrorWavefront | None) -> dict[str, float] | None:
    """Half-wavefront errors, um; None if there are none."""
    return wavefront and {name.removesuffix("_m"): round(v * MICRO, 4) for name, v in wavefront._asdict().items()}


# -- missions among beacons -------------------------------------------------------------------------------------------

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
        "beacons.html",
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
