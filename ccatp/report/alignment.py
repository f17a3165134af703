"""Alignment of the panels as data, CSV and text: um, urad; moves and deviations > 0 towards the robot."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ccatp.core import FloatArray
from ccatp.mirror.mirror_alignment import Comparison, SurveyResult, Undetermined, point_text
from ccatp.mirror.panel_alignment import MirrorWavefront, PanelResult, mirror_wavefront

MICRO = 1e6
_DECIMALS = 4
_WAVEFRONT = ("rms_before_um", "rms_before_level_um", "rms_after_um", "point_noise_um")


def result_data(result: SurveyResult, comparison: Comparison | None) -> dict[str, Any]:
    """What ``ccatp align --json`` prints of the panels and the mirror."""
    return {
        "panels": [_panel(panel) for panel in result.panels],
        "undetermined": [
            {"row": one.panel.row, "col": one.panel.col, "points": one.points, "why": one.why}
            for one in result.undetermined
        ],
        **_wavefront(result.wavefront),
        "rms_after_bending_um": None if result.wavefront_bent is None else _um(result.wavefront_bent.after_m),
        "truth": comparison
        and {
            "panels": comparison.panels,
            "piston_rms_um": _um(comparison.piston_rms_m),
            "tilt_rms_urad": _um(comparison.tilt_rms_rad),
            "chi2": round(comparison.chi2, _DECIMALS),
            "dof": comparison.dof,
            "band_99": [round(comparison.low, _DECIMALS), round(comparison.high, _DECIMALS)],
            "agrees": comparison.agrees,
        },
    }


def _panel(panel: PanelResult) -> dict[str, Any]:
    piston, tip, tilt = _list(panel.fit.values)
    bending, own = panel.bending, _wavefront(mirror_wavefront([panel.rigid.wavefront]))
    return {
        "row": panel.panel.row,
        "col": panel.panel.col,
        "piston_um": piston,
        "tip_urad": tip,
        "tilt_urad": tilt,
        "sigma": _list(panel.fit.sigma),
        "adjusters_um": _list(panel.rigid.moves.values_m),
        "adjusters_sigma_um": _list(panel.rigid.moves.sigma_m),
        "chi2": round(panel.fit.chi2, _DECIMALS),
        "dof": panel.fit.dof,
        "probability": panel.probability,
        "covariance": (panel.fit.covariance * MICRO**2).round(2 * _DECIMALS).tolist(),
        "points": len(panel.deviations.points),
        "outliers": [point.point for point in panel.outliers],
        "shape": _shape(panel),
        "bending_adjusters_um": None if bending is None else _list(bending.moves.values_m),
        "bending_adjusters_sigma_um": None if bending is None else _list(bending.moves.sigma_m),
        "cos_incidence": round(panel.cos_i, 6),
        "rms_before_um": own["rms_before_um"],
        "rms_after_um": own["rms_after_um"],
        "deviations": list(_deviations(panel)),
    }


def _shape(panel: PanelResult) -> dict[str, Any] | None:
    shape = panel.shape
    if shape is None:
        return None
    return {
        "curvature_um_m2": _list(shape.values_1_m),  # xx, xy, yy
        "sigma": _list(shape.sigma_1_m),
        "chi2_gain": round(shape.gain, _DECIMALS),
        "probability": shape.probability,
        "chi2": round(shape.chi2, _DECIMALS),
        "dof": shape.dof,
        "is_significant": shape.is_significant,
    }


def _deviations(panel: PanelResult) -> Iterator[dict[str, Any]]:
    found = panel.deviations
    one, y, x = np.array([np.ones(len(found.points)), *found.places_m.T[::-1]])
    left = found.values_m - found.lever * (np.column_stack([one, y, x]) @ panel.fit.values)
    rows = zip(found.points, found.places_m, found.values_m, found.sigmas_m, left, panel.is_kept, strict=True)
    for point, (x_m, y_m), value, sigma, residual, is_kept in rows:
        yield {
            "point": point.point,
            "x_m": round(float(x_m), 6),
            "y_m": round(float(y_m), 6),
            "deviation_um": _um(value),
            "sigma_um": _um(sigma),
            "residual_um": _um(residual),
            "is_outlier": not is_kept,
        }


def _wavefront(found: MirrorWavefront | None) -> dict[str, float | None]:
    if found is None:
        return dict.fromkeys(_WAVEFRONT)
    return {name: _um(value) for name, value in zip(_WAVEFRONT, found, strict=True)}


def csv_lines(result: SurveyResult) -> Iterator[str]:
    """One line a panel: how it lies, and how to turn its adjusters; a header before them."""
    names = result.panels[0].adjusters if result.panels else ()
    fit = ("piston_um", "tip_urad", "tilt_urad")
    yield ",".join(
        (
            "row", "col", "points", *fit, *(f"sigma_{name}" for name in fit), "chi2", "dof", "outliers",
            *(f"{name}_um" for name in names), *(f"sigma_{name}_um" for name in names), "is_bent",
            "rms_before_um", "rms_after_um",
        )
    )  # fmt: skip
    for panel in result.panels:
        data = _panel(panel)
        cells = [data["row"], data["col"], data["points"], *(data[name] for name in fit), *data["sigma"]]
        cells += [data["chi2"], data["dof"], " ".join(map(str, data["outliers"]))]
        cells += [*data["adjusters_um"], *data["adjusters_sigma_um"]]
        cells += [int(panel.shape is not None and panel.shape.is_significant)]
        yield ",".join(map(str, [*cells, data["rms_before_um"], data["rms_after_um"]]))


def _list(values: FloatArray) -> list[float]:
    return [_um(value) for value in values]


def _um(value: float) -> float:
    # Never a negative zero.
    return round(float(value) * MICRO, _DECIMALS) + 0.0


_SHOWN = 12  # panels without a result that are named


def table_lines(result: SurveyResult, comparison: Comparison | None, puck_height_sigma_m: float) -> Iterator[str]:
    """One line a panel, then the mirror, and the comparison with the simulated truth, if there is one."""
    if result.panels:
        yield from _panels(result.panels)
        yield ""
    yield from _undetermined(result.undetermined)
    if result.wavefront is not None:
        found = result.wavefront
        without_mean = _microns(found.before_level_m)
        yield f"half-wavefront error  {_microns(found.before_m)} um rms, {without_mean} without its mean"
        bent = result.wavefront_bent
        extra = "" if bent is None else f", {_microns(bent.after_m)} with moves that bend, too"
        yield f"  after the moves     {_microns(found.after_m)} um rms predicted{extra}"
        yield f"  one point           {_microns(found.noise_m)} um of measurement noise"
        yield f"pistons share         {_microns(puck_height_sigma_m)} um, the uncertainty of the puck's height"
    if comparison is not None:
        tilt = f"tip and tilt {_microns(comparison.tilt_rms_rad)} urad rms"
        yield f"against the truth     piston {_microns(comparison.piston_rms_m)} um rms, {tilt}"
        verdict = "inside" if comparison.agrees else "OUTSIDE"
        band = f"{verdict} its 99 % band of {comparison.low:.1f} to {comparison.high:.1f}"
        chi2 = f"{comparison.chi2:.1f} for {comparison.dof} degrees of freedom"
        yield f"  chi2 of {comparison.panels} panels{'':<2}{chi2}, {band}"


def _panels(panels: Sequence[PanelResult]) -> Iterator[str]:
    names = panels[0].adjusters
    head = f"{'panel':<6}{'points':>7}{'piston um':>16}{'tip urad':>16}{'tilt urad':>16}{'chi2/dof':>12}  "
    yield head + "".join(f"{name:>8}" for name in names) + "   moves, um (> 0 towards the robot)"
    for panel in panels:
        pairs = zip(panel.fit.values, panel.fit.sigma, strict=True)
        fit = "".join(f"{f'{MICRO * value:.1f} +- {MICRO * sigma:.1f}':>16}" for value, sigma in pairs)
        kept = int(panel.is_kept.sum())
        where = f"{panel.panel.row}/{panel.panel.col}"
        moves = "".join(f"{MICRO * move:>8.1f}" for move in panel.rigid.moves.values_m)
        line = f"{where:<6}{kept:>7}{fit}{panel.fit.chi2:>8.1f}/{panel.fit.dof:<3}  {moves}   {_notes(panel)}"
        yield line.rstrip()


def _notes(panel: PanelResult) -> str:
    notes = []
    if panel.outliers:
        notes.append("left out: " + " ".join(point_text(point) for point in panel.outliers))
    if panel.shape is not None and panel.shape.is_significant:
        xx, xy, yy = (f"{MICRO * value:.0f}" for value in panel.shape.values_1_m)
        notes.append(f"bent: xx {xx}, xy {xy}, yy {yy} um/m^2")
    return "; ".join(notes)


def _undetermined(others: Sequence[Undetermined]) -> Iterator[str]:
    begun = [one for one in others if one.points]
    for one in begun[:_SHOWN]:
        yield f"panel {one.panel.row}/{one.panel.col} not determined: {one.why}"
    if len(begun) > _SHOWN:
        yield f"and {len(begun) - _SHOWN} more panels not determined"
    if count := len(others) - len(begun):
        yield f"{count} panel{'' if count == 1 else 's'} not measured"
    if others:
        yield ""


def _microns(value: float) -> str:
    return f"{MICRO * value:.2f}"


def head_lines(facts: dict[str, Any]) -> Iterator[str]:
    """What was analysed; ``facts`` as in the JSON result."""
    where = "real robot" if facts["world"] is None else f"simulation, world {facts['world']}, seed {facts['seed']}"
    points = facts["points"]
    yield f"{facts['run_dir']}: {facts['mirror']}, {where}"
    yield f"{points['measured']} of {points['total']} points measured, {points['outliers']} of them left out"
    yield ""
