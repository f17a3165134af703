"""Alignment of the panels as data and text: um, urad; moves and deviations are positive towards the robot."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ccatp.config.models import Config
from ccatp.core import FloatArray, PanelId
from ccatp.errors import counted
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.mirror_alignment import Comparison, SurveyResult
from ccatp.mirror.panel_alignment import MirrorWavefront, PanelResult, half_size_m, mirror_wavefront
from ccatp.mirror.panel_modes import adjuster_places, rigid
from ccatp.report.html import MICRO, render

_DECIMALS = 4
_WAVEFRONT = ("rms_before_um", "rms_before_level_um", "rms_after_um", "point_noise_um")
_SHOWN = 12  # largest number of panels without a result that are named


def worst_corner(mirror: Mirror, panel: PanelResult) -> tuple[float, float]:
    """Largest displacement of a corner of the fitted plane, and its standard deviation, m."""
    signs = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)])
    modes = rigid(signs * half_size_m(mirror.panel(panel.panel)))
    values = modes @ panel.fit.values
    worst = int(np.argmax(np.abs(values)))
    return float(values[worst]), float(np.sqrt(modes[worst] @ panel.fit.covariance @ modes[worst]))


class AdjusterPlaces(NamedTuple):
    """Names of the adjusters of a panel, their (x, y) in its frame, mm, and a sentence that says what these axes are.

    The places of all panels are the same within 0.1 mm.
    """

    names: tuple[str, ...]
    places_mm: tuple[tuple[float, float], ...]
    axes: str

    @property
    def heads(self) -> list[str]:
        """Names with places, for the heads of columns."""
        return [f"{name} ({x:.0f}, {y:.0f})" for name, (x, y) in zip(self.names, self.places_mm, strict=True)]


def places_of(mirror: Mirror, panels: Iterable[PanelId]) -> AdjusterPlaces | None:
    """Where the adjusters of panels are; None without a panel."""
    for panel in panels:
        names, places = adjuster_places(mirror, panel)
        x_axis = mirror.mirror_from_deck(mirror.panel(panel).axes[0])
        axes = (
            f"x, y of the panel are {'-' if x_axis[0] < 0.0 else ''}x, y of the mirror frame: seen from the robot, "
            "with y up, x is to the right; seen from behind the panel, to the left"
        )
        return AdjusterPlaces(names, tuple((round(1e3 * x, 1), round(1e3 * y, 1)) for x, y in places.tolist()), axes)
    return None


def undetermined_warnings(result: SurveyResult) -> list[str]:
    """One line for the panels with points that do not determine them, by reason."""
    whys = dict[str, list[str]]()
    for one in result.undetermined:
        if one.points:
            whys.setdefault(one.why, []).append(f"{one.panel.row}/{one.panel.col}")
    return [f"{counted('panel', names, _SHOWN)} not determined: {why}" for why, names in whys.items()]


def result_data(result: SurveyResult, comparison: Comparison | None) -> dict[str, Any]:
    """Panels and mirror in the output of ``ccatp align --json``."""
    return {
        "panels": [panel_data(panel) for panel in result.panels],
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


def config_data(cfg: Config) -> dict[str, Any]:
    """Configuration of the alignment in the output of ``ccatp align --json``."""
    return {"mirror": cfg.mirror.model_dump(mode="json"), "align": cfg.align.model_dump(mode="json")}


def panel_data(panel: PanelResult) -> dict[str, Any]:
    """Position and tilt of a panel, its moves and its points."""
    piston, tip, tilt = _list(panel.fit.values)
    bending, shape = panel.bending, panel.shape
    own = _wavefront(mirror_wavefront([panel.rigid.wavefront]))
    found = panel.deviations
    one, y, x = np.array([np.ones(len(found.points)), *found.places_m.T[::-1]])
    left = found.values_m - found.lever * (np.column_stack([one, y, x]) @ panel.fit.values)
    rows = zip(found.points, found.places_m, found.values_m, found.sigmas_m, left, panel.is_kept, strict=True)
    count = len(found.points)
    common = np.zeros((count, 0)) if found.common is None else found.common
    readings = [1] * count if found.readings is None else found.readings.astype(int).tolist()
    more = zip(found.metrology or [""] * count, readings, common, strict=True)
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
        "points": len(found.points),
        "outliers": [point.point for point in panel.outliers],
        "alternatives": [
            {
                "outliers": [p.point for p, kept in zip(found.points, one.is_kept, strict=True) if not kept],
                "is_bent": one.has_shape,
            }
            for one in panel.alternatives
        ],
        "deciding_point": panel.deciding and panel.deciding.point,
        "shape": shape
        and {
            "curvature_um_m2": _list(shape.values_1_m),  # xx, xy, yy
            "sigma": _list(shape.sigma_1_m),
            "chi2_gain": round(shape.gain, _DECIMALS),
            "probability": shape.probability,
            "chi2": round(shape.chi2, _DECIMALS),
            "dof": shape.dof,
            "is_significant": shape.is_significant,
        },
        "bending_adjusters_um": bending and _list(bending.moves.values_m),
        "bending_adjusters_sigma_um": bending and _list(bending.moves.sigma_m),
        "cos_incidence": round(panel.cos_i, 6),
        "rms_before_um": own["rms_before_um"],
        "rms_after_um": own["rms_after_um"],
        "deviations": [
            {
                "point": point.point,
                "x_m": round(float(x_m), 6),
                "y_m": round(float(y_m), 6),
                "deviation_um": _um(value),
                "sigma_um": _um(sigma),
                "residual_um": _um(residual),
                "is_outlier": not is_kept,
                "metrology": metrology,
                "readings": number,
                "common_um": _list(errors),
            }
            for (point, (x_m, y_m), value, sigma, residual, is_kept), (metrology, number, errors) in zip(
                rows, more, strict=True
            )
        ],
    }


def _wavefront(found: MirrorWavefront | None) -> dict[str, float | None]:
    if found is None:
        return dict.fromkeys(_WAVEFRONT)
    return {name: _um(value) for name, value in zip(_WAVEFRONT, found, strict=True)}


def _list(values: FloatArray) -> list[float]:
    return [_um(value) for value in values]


def _um(value: float) -> float:
    # Never a negative zero.
    return round(float(value) * MICRO, _DECIMALS) + 0.0


def table_lines(
    facts: Mapping[str, Any], result: SurveyResult, truth: Comparison | None, puck_height_sigma_m: float
) -> list[str]:
    """What was analysed (``facts`` as in the JSON result), a line a panel, the mirror, the simulated truth."""
    values = {"facts": facts, "result": result, "truth": truth, "puck_height_sigma_m": puck_height_sigma_m}
    text = render("align.txt", **values, shown=_SHOWN)
    return [line.rstrip() for line in text.lstrip("\n").splitlines()]
