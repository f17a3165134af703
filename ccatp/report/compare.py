"""Two runs, called A and B, and their figures beside each other: what each is called, and how it is written.

How the panels lie in one survey against another: which have moved by more than both are uncertain.

Figures of two runs beside each other.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri

from ccatp.core import FloatArray, PanelId
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.panel_alignment import MirrorWavefront, PanelResult, mirror_wavefront, on_grid_m
from ccatp.report.analysis import KINDS, ErrorSeries
from ccatp.report.drawing import INK, SERIES, Dots, Drawing, Plot, PlotAxis, PolyLine, Shape, envelope, legend, thinned
from ccatp.report.findings import Findings
from ccatp.report.record import RunRecord
from ccatp.report.run_figures import MapFrame, PanelCells, cells_figure, driven_path_m
from ccatp.report.run_page import run_data, wavefront_data

_MODES = 3
BAND = 0.99
FALSE_ALARM = 0.01  # probability that noise alone makes any panel of the mirror look moved


class PanelChange(NamedTuple):
    """One panel, the later survey less the earlier one.

    Attributes:
        values: piston (m), tip, tilt (rad), shape (3,).
        sigma: standard deviations of these, shape (3,).
        chi2: of no change at all, three degrees of freedom.
        has_moved: noise alone would hardly make it so.
    """

    panel: PanelId
    values: FloatArray
    sigma: FloatArray
    chi2: float
    has_moved: bool


class Changes(NamedTuple):
    """All panels that both surveys tell of, the chi-square of no change, and the band noise alone keeps it in."""

    panels: tuple[PanelChange, ...]
    chi2: float
    dof: int
    low: float
    high: float

    @property
    def agree(self) -> bool:
        """Nothing but noise is between the surveys."""
        return self.chi2 <= self.high and not any(panel.has_moved for panel in self.panels)


def panel_changes(before: Sequence[PanelResult], after: Sequence[PanelResult]) -> Changes | None:
    """Compare two surveys of one mirror; None without a panel of both.

    The error of the puck's height shifts all pistons of a survey alike and is in no covariance here: with another puck,
    or another height, all pistons seem to have moved.
    """
    earlier = {panel.panel: panel for panel in before}
    pairs = [(earlier[panel.panel], panel) for panel in after if panel.panel in earlier]
    if not pairs:
        return None
    changes = [_change(one, other, FALSE_ALARM / len(pairs)) for one, other in pairs]
    dof = _MODES * len(changes)
    return Changes(
        tuple(changes),
        sum(change.chi2 for change in changes),
        dof,
        float(chdtri(dof, 0.5 + 0.5 * BAND)),
        float(chdtri(dof, 0.5 - 0.5 * BAND)),
    )


def _change(before: PanelResult, after: PanelResult, rare: float) -> PanelChange:
    values = after.fit.values - before.fit.values
    covariance = after.fit.covariance + before.fit.covariance
    chi2 = float(values @ np.linalg.solve(covariance, values))
    return PanelChange(after.panel, values, np.sqrt(np.diag(covariance)), chi2, float(chdtrc(_MODES, chi2)) < rare)


_WAVEFRONT = "half_wavefront_um"
_PERCENT = 100.0


class RunPair(NamedTuple):
    """Two runs, called A and B as on the page, and what changed between them on one mirror."""

    a: Findings
    b: Findings
    changes: Changes | None

    @property
    def is_one_mirror(self) -> bool:
        """Points and panels can be compared one by one."""
        return self.a.record.mirror.name == self.b.record.mirror.name

    @property
    def named(self) -> tuple[tuple[str, Findings], tuple[str, Findings]]:
        """Both, with their letters."""
        return ("A", self.a), ("B", self.b)

    @property
    def warning(self) -> str:
        """What keeps them from being compared, or nothing."""
        if self.is_one_mirror:
            return ""
        mirrors = " and ".join(found.record.mirror.name for _, found in self.named)
        return f"The runs are of different mirrors, {mirrors}: points and panels are not compared."

    @property
    def panels(self) -> tuple[set[PanelId], set[PanelId]]:
        """Those of each that could be fitted."""
        return _panels(self.a), _panels(self.b)

    @property
    def wavefronts(self) -> tuple[MirrorWavefront | None, MirrorWavefront | None]:
        """Half-wavefront errors over the panels that both have; None where there are none, or of different mirrors."""
        a, b = self.panels
        common = a & b if self.is_one_mirror else set()
        return _over(self.a, common), _over(self.b, common)


def pair_of(a: Findings, b: Findings) -> RunPair:
    """Put two runs beside each other."""
    found = RunPair(a, b, None)
    if not found.is_one_mirror or a.alignment is None or b.alignment is None:
        return found
    return found._replace(changes=panel_changes(a.alignment.panels, b.alignment.panels))


def _panels(found: Findings) -> set[PanelId]:
    return set() if found.alignment is None else {panel.panel for panel in found.alignment.panels}


def _over(found: Findings, panels: set[PanelId]) -> MirrorWavefront | None:
    fitted = () if found.alignment is None else found.alignment.panels
    return mirror_wavefront([panel.rigid.wavefront for panel in fitted if panel.panel in panels])


class Figure(NamedTuple):
    """One figure of both runs: its name with its unit, the decimals it is written with, and the values."""

    name: str
    decimals: int
    a: float | None
    b: float | None
    is_of_one: bool = True  # of the same mirror

    @property
    def change(self) -> float | None:
        """B less A, as far as the decimals go."""
        if self.a is None or self.b is None or not self.is_of_one:
            return None
        return round(self.b - self.a, self.decimals)


class _Row(NamedTuple):
    """Where a figure stands in ``run_data``, its name, its decimals, and what it is multiplied by."""

    path: tuple[str, ...]
    name: str
    decimals: int
    scale: float = 1.0


_ROWS: tuple[_Row, ...] = (
    _Row(("points", "total"), "points", 0),
    *(
        _Row(("points", key), f"points, {name}", 0)
        for key, name in (
            ("pass", "pass"),
            ("corrected", "corrected"),
            ("fail", "fail"),
            ("skipped", "skipped"),
            ("not_measured", "not measured"),
        )
    ),
    _Row(("arrival_error_mm", "mean"), "first arrival, mean, mm", 3),
    _Row(("arrival_error_mm", "max"), "first arrival, largest, mm", 3),
    _Row(("localization_error_mm", "mean_mm"), "localization error, mean, mm", 3),
    _Row(("localization_error_mm", "p50_mm"), "localization error, median, mm", 3),
    _Row(("localization_error_mm", "p99_mm"), "localization error, 99 %, mm", 3),
    _Row(("localization_error_mm", "max_mm"), "localization error, largest, mm", 3),
    _Row(("localization_error_mm", "within_sigma3"), "frames within 3 \u03c3, %", 2, _PERCENT),
    _Row(("localization_error_mm", "within_limit"), "frames within 10 mm, %", 2, _PERCENT),
    *(_Row(("time_budget_s", "spent", kind), f"time, {kind}, s", 1) for kind in KINDS),
    _Row(("time_budget_s", "total"), "time, all, s", 1),
    *(_Row(("time_budget_s", "least", kind), f"least time, {kind}, s", 1) for kind in KINDS),
    _Row(("time_budget_s", "bound"), "least time, all, s", 1),
)
_WAVEFRONT_ROWS = (
    _Row(("before",), "half-wavefront error, \u00b5m", 2),
    _Row(("before_level",), "half-wavefront error without its mean, \u00b5m", 2),
    _Row(("after",), "half-wavefront error after the moves, \u00b5m", 2),
    _Row(("noise",), "noise of one point, \u00b5m", 2),
)


def compared_figures(pair: RunPair) -> list[Figure]:
    """The figures of both runs; those that neither knows are left out.

    Half-wavefront errors are of the panels that both have, and their names say so where these are not all.
    """
    data = [run_data(found) for found in (pair.a, pair.b)]
    found = list(_figures(_ROWS, data, ""))
    a, b = pair.panels
    if pair.is_one_mirror and a != b:
        over = f", common panels ({len(a & b)})"
        return [*found, *_figures(_WAVEFRONT_ROWS, [wavefront_data(one) for one in pair.wavefronts], over)]
    whole = _figures(_WAVEFRONT_ROWS, [one[_WAVEFRONT] for one in data], "")
    return [*found, *(one._replace(is_of_one=pair.is_one_mirror) for one in whole)]


def _figures(rows: Sequence[_Row], data: Sequence[Mapping[str, Any] | None], suffix: str) -> Iterator[Figure]:
    for row in rows:
        a, b = (_at(one, row) for one in data)
        if a is not None or b is not None:
            yield Figure(row.name + suffix, row.decimals, a, b)


def _at(data: Any, row: _Row) -> float | None:
    for name in row.path:
        data = None if data is None else data.get(name)
    return None if data is None else row.scale * float(data)


_COLOURS = (SERIES[0], SERIES[1])
_LEAST_MM = 1e-3
_DASH = (4.0, 3.0)
_TOLERANCE_PX = 0.6
_KEY_LINE = np.array([(-9.0, 0.0), (9.0, 0.0)])
Draw = Callable[[float], Drawing]
_CELLS = 8


def distribution_figure(values: Mapping[str, FloatArray], label: str, width: float) -> Drawing:
    """Share of the values below each number, for each run, on a logarithmic axis.

    Args:
        label: what they are, with their unit.
    """
    is_wide = width > 500.0
    left, top, right, bottom = 62.0, 12.0, width - 12.0, 240.0
    everything = np.maximum(np.concatenate(list(values.values())), _LEAST_MM)
    low, high = 10.0 ** np.floor(np.log10(everything.min())), 10.0 ** np.ceil(np.log10(everything.max() * 1.001))
    x = PlotAxis(float(low), float(high), left, right, is_logarithmic=True)
    plot = Plot(left, top, right, bottom, x, PlotAxis(0.0, 100.0, bottom, top), 11.5 if is_wide else 10.5)
    plot.frame(label, "% of them below")
    for (_, some), colour in zip(values.items(), _COLOURS, strict=False):
        ordered = np.sort(np.maximum(some, _LEAST_MM))
        share = 100.0 * np.arange(1, len(ordered) + 1) / len(ordered)
        # A step at each value.
        plot.line(np.repeat(ordered, 2)[1:], np.repeat(share, 2)[:-1], colour, 1.8)
    return _with_legend(plot, list(values), width, f"distribution of {label}")


def errors_figure(series: Mapping[str, ErrorSeries], width: float) -> Drawing:
    """The largest localization error of each time, for each run, and three sigma of the estimate, dashed."""
    is_wide = width > 500.0
    left, top, right, bottom = 62.0, 10.0, width - 12.0, 280.0
    shown = {name: _known(found) for name, found in series.items()}
    everything = np.concatenate([*(values for _, values in shown.values()), *(f.sigma3_mm for f in series.values())])
    largest = max(float(everything.max()), 0.01)
    end = max(float(found.t_s[-1]) for found in series.values()) / 60.0
    y = PlotAxis(_LEAST_MM, 1.5 * largest, bottom, top, is_logarithmic=True)
    plot = Plot(left, top, right, bottom, PlotAxis(0.0, max(end, 0.1), left, right), y, 11.5 if is_wide else 10.5)
    plot.frame("robot time, min", "mm")
    intervals = max(1, int((right - left) / 2.0))
    for found, (t_s, values), colour in zip(series.values(), shown.values(), _COLOURS, strict=False):
        sigma, errors = envelope(found.t_s, found.sigma3_mm, intervals), envelope(t_s, values, intervals)
        places = np.column_stack([plot.x.pixels(sigma.x / 60.0), plot.y.pixels(sigma.high)])
        plot.shapes.append(PolyLine(places, colour, 0.9, _DASH, 0.7))
        plot.line(errors.x / 60.0, errors.high, colour, 1.4)
    names = [name if np.isfinite(found.error_mm).any() else f"{name} (3 \u03c3)" for name, found in series.items()]
    return _with_legend(plot, names, width, "largest localization error over time")


def _known(series: ErrorSeries) -> tuple[FloatArray, FloatArray]:
    is_known = np.isfinite(series.error_mm)
    if is_known.any():
        return series.t_s[is_known], series.error_mm[is_known]
    return series.t_s, series.sigma3_mm


def _with_legend(plot: Plot, names: Sequence[str], width: float, title: str) -> Drawing:
    entries = list(zip(names, _COLOURS, strict=False))
    shapes, height = legend(12.0, plot.bottom + 56.0, entries, plot.size, width - 24.0)
    return Drawing(width, plot.bottom + 48.0 + height, (*plot.shapes, *shapes), title)


def paths_figure(mirror: Mirror, records: Mapping[str, RunRecord], width: float) -> Drawing:
    """The mirror with the paths of both runs, the later one above the earlier one."""
    frame = MapFrame(mirror, width)
    frame.draw_panels()
    frame.draw_rim()
    keys: list[tuple[str, Shape]] = []
    for (name, record), colour, thick in zip(records.items(), _COLOURS, (2.6, 0.9), strict=False):
        path = driven_path_m(record)
        if len(path):
            frame.shapes.append(PolyLine(thinned(frame.pixels(path), _TOLERANCE_PX), colour, thick))
            keys.append((name, PolyLine(_KEY_LINE, colour, thick)))
    frame.draw_base()
    keys.append(("base", Dots(np.zeros((1, 2)), 4.0, INK)))
    return frame.finish(None, "", keys, f"{mirror.name}: both paths")


def change_figure(mirror: Mirror, before: Sequence[PanelResult], after: Sequence[PanelResult], width: float) -> Drawing:
    """The mirror with what the later survey shows less the earlier one."""
    earlier = {panel.panel: panel for panel in before}
    cells = []
    for panel in after:
        if panel.panel in earlier:
            x, y, later = on_grid_m(mirror, panel, _CELLS)
            cells.append(PanelCells(x, y, later - on_grid_m(mirror, earlier[panel.panel], _CELLS)[2]))
    label = "change along the normal, \u00b5m (> 0 towards the robot)"
    return cells_figure(mirror, cells, label, f"{mirror.name}: change of the surface", width)
