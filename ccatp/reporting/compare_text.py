"""Pure. Two runs beside each other for a terminal, and as data."""

from collections.abc import Iterator
from typing import Any

from ccatp.reporting.data import run_data, wavefront_data
from ccatp.reporting.pair import Pair, compared_figures
from ccatp.reporting.panel_changes import PanelChange

_MICRO = 1e6
_WIDTH = 12


def compare_lines(pair: Pair) -> Iterator[str]:
    """A line for each figure that differs, then the panels that have moved."""
    if pair.warning:
        yield f"warning: {pair.warning}"
    rows = [(_ascii(one.name), one) for one in compared_figures(pair) if one.change != 0.0]
    width = max((len(name) for name, _ in rows), default=0) + 2
    yield f"{'':<{width}}{'A':>{_WIDTH}}{'B':>{_WIDTH}}{'B less A':>{_WIDTH}}"
    for name, one in rows:
        cells = "".join(f"{_cell(value, one.decimals):>{_WIDTH}}" for value in (one.a, one.b, one.change))
        yield f"{name:<{width}}{cells}"
    changes = pair.changes
    if changes is None:
        return
    verdict = "the surveys agree" if changes.agree else "the surveys differ"
    chi2 = f"chi2 of no change {changes.chi2:.1f} for {changes.dof} degrees of freedom"
    yield f"{verdict}: {chi2}, {changes.high:.1f} at most by noise alone"
    for panel in changes.panels:
        if panel.has_moved:
            piston, tip, tilt = (_MICRO * value for value in panel.values)
            where = f"panel {panel.panel.row}/{panel.panel.col} has moved"
            yield f"{where}: piston {piston:+.1f} um, tip {tip:+.1f} urad, tilt {tilt:+.1f} urad"


def _ascii(name: str) -> str:
    return name.replace("\u00b5", "u").replace("\u03c3", "sigma")


def _cell(value: float | None, decimals: int) -> str:
    return "-" if value is None else f"{value:.{decimals}f}"


def compare_data(pair: Pair) -> dict[str, Any]:
    """What ``ccatp compare --json`` tells."""
    changes, (a, b) = pair.changes, pair.wavefronts
    return {
        "a": run_data(pair.a),
        "b": run_data(pair.b),
        "one_mirror": pair.is_one_mirror,
        "half_wavefront_common_um": {"a": wavefront_data(a), "b": wavefront_data(b)},
        "panels": None if changes is None else [_panel(panel) for panel in changes.panels],
        "chi2": None if changes is None else round(changes.chi2, 4),
        "dof": None if changes is None else changes.dof,
        "agree": None if changes is None else changes.agree,
    }


def _panel(panel: PanelChange) -> dict[str, Any]:
    piston, tip, tilt = (round(_MICRO * value, 4) for value in panel.values.tolist())
    return {
        "row": panel.panel.row,
        "col": panel.panel.col,
        "piston_um": piston,
        "tip_urad": tip,
        "tilt_urad": tilt,
        "sigma": [round(_MICRO * value, 4) for value in panel.sigma.tolist()],
        "chi2": round(panel.chi2, 4),
        "has_moved": panel.has_moved,
    }
