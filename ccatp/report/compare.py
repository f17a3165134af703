"""Two surveys beside each other, called A and B: what changed on the mirror, the page, lines for a terminal, data."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from markupsafe import Markup
from scipy.special import chdtrc, chdtri

from ccatp.core import FloatArray, PanelId
from ccatp.mirror.panel_alignment import MirrorWavefront, PanelResult, mirror_wavefront
from ccatp.report.analysis import KINDS
from ccatp.report.findings import Findings
from ccatp.report.html import (
    MICRO,
    Draw,
    Section,
    Table,
    events_of,
    inline,
    micro_text,
    number_text,
    page_figure,
    render,
)
from ccatp.report.mirror_map import change_figure, paths_figure, surface_figure
from ccatp.report.plots import NARROW, WIDE
from ccatp.report.record import changed_keys
from ccatp.report.run_figures import distribution_figure, errors_figure, time_figure
from ccatp.report.run_page import point_text, run_data, wavefront_data

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


class ComparedValue(NamedTuple):
    """One value of both runs: its name with its unit, the decimals it is written with, and the values."""

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


def compared_figures(pair: RunPair) -> list[ComparedValue]:
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


def _figures(rows: Sequence[_Row], data: Sequence[Mapping[str, Any] | None], suffix: str) -> Iterator[ComparedValue]:
    for row in rows:
        a, b = (_at(one, row) for one in data)
        if a is not None or b is not None:
            yield ComparedValue(row.name + suffix, row.decimals, a, b)


def _at(data: Any, row: _Row) -> float | None:
    for name in row.path:
        data = None if data is None else data.get(name)
    return None if data is None else row.scale * float(data)


# -- the page ---------------------------------------------------------------------------------------------------------


def compare_page(pair: RunPair) -> str:
    """The comparison as one HTML file."""
    names = f"{pair.a.record.name} and {pair.b.record.name}"
    sections = [section for make in _SECTIONS if (section := make(pair)) is not None]
    return render("compare.html", names, sections, pair=pair)


def _figures_section(pair: RunPair) -> Section:
    rows = [
        [one.name, *(number_text(value, one.decimals) for value in (one.a, one.b, one.change))]
        for one in compared_figures(pair)
    ]
    return Section("figures", "Figures", {"figures": Table(["", "A", "B", "B less A"], rows)})


def _configuration_section(pair: RunPair) -> Section:
    a, b = (found.record.cfg.model_dump(mode="json") for found in (pair.a, pair.b))
    rows = [[key, str(one), str(other)] for key, (one, other) in changed_keys(a, b).items()]
    return Section("configuration", "Configuration", {"changes": Table(["key", "A", "B"], rows)})


def _paths_section(pair: RunPair) -> Section | None:
    draw = _drawings(pair).get("paths")
    return None if draw is None else Section("map", "Paths", {"figure": page_figure(draw)})


def _time_section(pair: RunPair) -> Section | None:
    draw = _drawings(pair).get("time")
    return None if draw is None else Section("time", "Time budget", {"figure": page_figure(draw)})


def _errors_section(pair: RunPair) -> Section | None:
    drawings = _drawings(pair)
    names = ("localization", "arrivals")
    found = {name: page_figure(drawings[name]) if name in drawings else None for name in names}
    return Section("errors", "Errors", dict(found)) if any(found.values()) else None


def _points_section(pair: RunPair) -> Section | None:
    if not pair.is_one_mirror or not (pair.a.points and pair.b.points):
        return None
    a = {verdict.point: verdict for verdict in pair.a.points}
    both = [(a[verdict.point], verdict) for verdict in pair.b.points if verdict.point in a]
    rows = [
        [
            point_text(one.point),
            str(one.grade),
            str(other.grade),
            number_text(one.first_mm),
            number_text(other.first_mm),
        ]
        for one, other in both
        if one.grade is not other.grade
    ]
    head = ["point", "A", "B", "first in A, mm", "first in B, mm"]
    return Section("points", "Points", {"common": len(both), "changes": Table(head, rows)})


def _surfaces_section(pair: RunPair) -> Section | None:
    known = [(n, f.alignment.panels) for n, f in pair.named if f.alignment is not None and f.alignment.panels]
    if not pair.is_one_mirror or not known:
        return None
    mirror = pair.b.record.mirror
    everything = [panel for _, panels in known for panel in panels]
    surfaces = [
        (name, inline(surface_figure(mirror, panels, f"{mirror.name}: surface of {name}", NARROW, everything)))
        for name, panels in known
    ]
    return Section("surface", "Surfaces", {"surfaces": surfaces})


def _panels_section(pair: RunPair) -> Section | None:
    draw = _drawings(pair).get("change")
    if pair.changes is None or draw is None:
        return None
    rows = []
    for panel in sorted(pair.changes.panels, key=lambda panel: -panel.chi2):
        values = zip(panel.values.tolist(), panel.sigma.tolist(), strict=True)
        cells = [f"{micro_text(value)} ± {micro_text(sigma)}" for value, sigma in values]
        moved = "moved" if panel.has_moved else ""
        rows.append([f"{panel.panel.row}/{panel.panel.col}", *cells, number_text(panel.chi2, 1), moved])
    head = ["panel", "piston, µm", "tip, µrad", "tilt, µrad", "χ² (3)", ""]
    moved_count = sum(panel.has_moved for panel in pair.changes.panels)
    values_shown = {"figure": page_figure(draw), "changes": Table(head, rows), "moved": moved_count}
    return Section("panels", "Panels, B less A", values_shown)


def _adjusters_section(pair: RunPair) -> Section | None:
    """The moves that each survey asks for; those of B are still to be made."""
    if not pair.is_one_mirror:
        return None
    a, b = ({p.panel: p for p in (f.alignment.panels if f.alignment else ())} for _, f in pair.named)
    panels = sorted({*a, *b}, key=lambda panel: (-_largest_move_m(b.get(panel)), panel))
    if not panels:
        return None
    names = next(iter((b or a).values())).adjusters
    rows = []
    for panel in panels:
        moves = zip(_moves(a.get(panel), len(names)), _moves(b.get(panel), len(names)), strict=True)
        cells = [Markup("{} → <strong>{}</strong>").format(first, then) for first, then in moves]
        rows.append([f"{panel.row}/{panel.col}", *cells])
    return Section("adjusters", "Adjuster moves", {"moves": Table(["panel", *names], rows)})


def _largest_move_m(panel: PanelResult | None) -> float:
    return 0.0 if panel is None else float(abs(panel.rigid.moves.values_m).max())


def _moves(panel: PanelResult | None, count: int) -> list[str]:
    return [number_text(None)] * count if panel is None else [micro_text(move) for move in panel.rigid.moves.values_m]


def _events_section(pair: RunPair) -> Section | None:
    found = [(letter, events_of(one.record.log)) for letter, one in pair.named if one.record.log]
    return Section("events", "Events", {"events": found}) if found else None


_SECTIONS = (
    _figures_section,
    _configuration_section,
    _paths_section,
    _time_section,
    _errors_section,
    _points_section,
    _surfaces_section,
    _panels_section,
    _adjusters_section,
    _events_section,
)


def compare_figures(pair: RunPair) -> "dict[str, Figure]":
    """The figures of the comparison, by the names of their files."""
    return {name: draw(WIDE) for name, draw in _drawings(pair).items()}


def _drawings(pair: RunPair) -> dict[str, Draw]:
    """What draws each figure; those that neither run holds anything for are left out."""
    found: dict[str, Draw] = {}
    budgets = [(name, one.budget) for name, one in pair.named if one.budget is not None]
    if budgets:
        found["time"] = partial(time_figure, budgets, max(one.record.cfg.run.budget_s for one in (pair.a, pair.b)))
    series = {name: one.errors for name, one in pair.named if one.errors is not None}
    if series:
        found["localization"] = partial(errors_figure, series)
    first = {name: np.array([v.first_mm for v in one.points if v.first_mm is not None]) for name, one in pair.named}
    arrivals = {name: some for name, some in first.items() if len(some)}
    if arrivals:
        found["arrivals"] = partial(distribution_figure, arrivals, "distance at first arrival, mm")
    mirror = pair.b.record.mirror
    if pair.changes is not None and pair.a.alignment is not None and pair.b.alignment is not None:
        found["change"] = partial(change_figure, mirror, pair.a.alignment.panels, pair.b.alignment.panels)
    records = {letter: one.record for letter, one in pair.named if one.record.sessions}
    if pair.is_one_mirror and records:
        found["paths"] = partial(paths_figure, mirror, records)
    return found


# -- terminal and data ------------------------------------------------------------------------------------------------

_WIDTH = 12


def compare_lines(pair: RunPair) -> Iterator[str]:
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
            piston, tip, tilt = (MICRO * value for value in panel.values)
            where = f"panel {panel.panel.row}/{panel.panel.col} has moved"
            yield f"{where}: piston {piston:+.1f} um, tip {tip:+.1f} urad, tilt {tilt:+.1f} urad"


def _ascii(name: str) -> str:
    return name.replace("\u00b5", "u").replace("\u03c3", "sigma")


def _cell(value: float | None, decimals: int) -> str:
    return "-" if value is None else f"{value:.{decimals}f}"


def compare_data(pair: RunPair) -> dict[str, Any]:
    """What ``ccatp compare --json`` prints."""
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
    piston, tip, tilt = (round(MICRO * value, 4) for value in panel.values.tolist())
    return {
        "row": panel.panel.row,
        "col": panel.panel.col,
        "piston_um": piston,
        "tip_urad": tip,
        "tilt_urad": tilt,
        "sigma": [round(MICRO * value, 4) for value in panel.sigma.tolist()],
        "chi2": round(panel.chi2, 4),
        "has_moved": panel.has_moved,
    }
