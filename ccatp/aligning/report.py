"""Pure. The alignment as data and as CSV. Micrometres and microradians; moves and deviations > 0 towards the robot."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from ccatp.aligning.comparison import Comparison
from ccatp.aligning.modes import FloatArray
from ccatp.aligning.panel_result import PanelResult, Plan
from ccatp.aligning.survey_result import SurveyResult
from ccatp.aligning.wavefront import MirrorWavefront, mirror_wavefront

MICRO = 1e6
_DECIMALS = 4
_WAVEFRONT = ("rms_before_um", "rms_before_level_um", "rms_after_um", "point_noise_um")


def result_data(result: SurveyResult, comparison: Comparison | None) -> dict[str, Any]:
    """What ``ccatp align --json`` tells of the panels and the mirror."""
    return {
        "panels": [_panel(panel) for panel in result.panels],
        "undetermined": [
            {"row": one.panel.row, "col": one.panel.col, "points": one.points, "why": one.why}
            for one in result.undetermined
        ],
        **_wavefront(result.wavefront),
        "rms_after_bending_um": None if result.wavefront_bent is None else _um(result.wavefront_bent.after_m),
        "truth": None if comparison is None else _comparison(comparison),
    }


def _panel(panel: PanelResult) -> dict[str, Any]:
    piston, tip, tilt = _list(panel.fit.values)
    bending = panel.bending
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
        **_own_wavefront(panel.rigid),
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


def _own_wavefront(plan: Plan) -> dict[str, float | None]:
    found = _wavefront(mirror_wavefront([plan.wavefront]))
    return {name: found[name] for name in ("rms_before_um", "rms_after_um")}


def _wavefront(found: MirrorWavefront | None) -> dict[str, float | None]:
    if found is None:
        return dict.fromkeys(_WAVEFRONT)
    return {name: _um(value) for name, value in zip(_WAVEFRONT, found, strict=True)}


def _comparison(found: Comparison) -> dict[str, Any]:
    return {
        "panels": found.panels,
        "piston_rms_um": _um(found.piston_rms_m),
        "tilt_rms_urad": _um(found.tilt_rms_rad),
        "chi2": round(found.chi2, _DECIMALS),
        "dof": found.dof,
        "band_99": [round(found.low, _DECIMALS), round(found.high, _DECIMALS)],
        "agrees": found.agrees,
    }


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
