"""Comparison of two surveys, A and B: what changed on the mirror, the page, lines for a terminal, data."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri

from ccatp.config.files import write_file
from ccatp.core import FloatArray, PanelId
from ccatp.mirror.adjuster_work import repeatability_m
from ccatp.mirror.mirror_alignment import joint_covariance
from ccatp.mirror.move_checks import Made, MoveExplanation, PanelCheck, check_moves
from ccatp.mirror.network_model import Effect
from ccatp.mirror.network_points import CalibratedSurveys
from ccatp.mirror.panel_alignment import PanelResult, mirror_wavefront
from ccatp.report.alignment import places_of
from ccatp.report.figures import distribution_figure, errors_figure, time_figure
from ccatp.report.findings import KINDS, Findings, findings_of
from ccatp.report.html import MICRO, Draw, events_of, inline, page_figures, render, write_pictures
from ccatp.report.mirror_map import change_figure, paths_figure, surface_figure
from ccatp.report.plots import NARROW, check_drawing
from ccatp.report.record import changed_keys, read_record
from ccatp.report.run_page import PAGE_MODE, run_data, wavefront_data

COMPARISON = "compare.html"
_MODES = 3
BAND = 0.99
FALSE_ALARM = 0.01  # probability that noise alone makes any panel of the mirror look moved


class PanelChange(NamedTuple):
    """Change of one panel: values of the later survey minus those of the earlier one."""

    panel: PanelId
    values: FloatArray  # piston (m), tip, tilt (rad), shape (3,)
    sigma: FloatArray  # standard deviations of these
    chi2: float  # of the hypothesis of no change, three degrees of freedom
    has_moved: bool  # the change is not explained by noise, see ``FALSE_ALARM``


class Changes(NamedTuple):
    """All panels that both surveys determined, chi^2 of the hypothesis of no change, and its interval under noise."""

    panels: tuple[PanelChange, ...]
    chi2: float
    dof: int
    low: float
    high: float

    @property
    def agree(self) -> bool:
        """Whether the surveys differ by no more than noise."""
        return self.chi2 <= self.high and not any(panel.has_moved for panel in self.panels)


def panel_changes(
    pairs: Sequence[tuple[PanelResult, PanelResult]], errors: tuple[slice, slice] = (slice(None), slice(None))
) -> Changes | None:
    """Compare the panels of two surveys of one mirror; None without panels. Another puck looks like a move of all.

    ``errors``: those of the errors common to the panels of a survey that differ between the surveys.
    """
    if not pairs:
        return None
    one, other = ([pair[k] for pair in pairs] for k in (0, 1))
    covariance = joint_covariance(one, errors[0]) + joint_covariance(other, errors[1])
    changes = []
    for number, (before, after) in enumerate(pairs):
        part = slice(_MODES * number, _MODES * (number + 1))
        values, own = after.fit.values - before.fit.values, covariance[part, part]
        chi2 = float(values @ np.linalg.solve(own, values))
        has_moved = float(chdtrc(_MODES, chi2)) < FALSE_ALARM / len(pairs)
        changes.append(PanelChange(after.panel, values, np.sqrt(np.diag(own)), chi2, has_moved))
    dof = _MODES * len(changes)
    low, high = (float(chdtri(dof, at)) for at in (0.5 + 0.5 * BAND, 0.5 - 0.5 * BAND))
    every = np.concatenate([change.values for change in changes])
    return Changes(tuple(changes), float(every @ np.linalg.solve(covariance, every)), dof, low, high)


def differing_errors(a: CalibratedSurveys | None, b: CalibratedSurveys | None) -> tuple[slice, slice]:
    """The errors by the networks of two surveys that differ: those of one survey, if the network is the same.

    Errors by the priors of collimators and offsets are then equal, and cancel. If the network has changed between the
    surveys, none cancel.
    """
    if a is None or b is None or _channel_priors(a) != _channel_priors(b):
        return slice(None), slice(None)
    return slice(a.surveys[0].common.by_survey), slice(b.surveys[0].common.by_survey)


def _channel_priors(found: CalibratedSurveys) -> dict[Effect, list[float]]:
    adjusted = found.network.adjustment
    return {effect: adjusted.prior[part].tolist() for effect, part in adjusted.slices.items() if effect.is_of_channel}


class RunPair:
    """Two runs, called A and B as on the page, and the changes between them.

    ``panels``: the fitted panels of each run; ``wavefronts``: half-wavefront errors of the panels that both runs have,
    or None. ``checks``: by panel, the moves that A plans against the change that B shows, if any panel has moved;
    ``repeatability_m``: of a point, by both surveys.

    Points and panels are compared only if the mirror is the same; otherwise ``warning`` is not empty.
    """

    def __init__(self, a: Findings, b: Findings) -> None:
        self.a, self.b = a, b
        self.named = (("A", a), ("B", b))
        names = [found.record.mirror.name for found in (a, b)]
        self.is_one_mirror = names[0] == names[1]
        differ = f"The runs are of different mirrors, {' and '.join(names)}: points and panels are not compared."
        self.warning = "" if self.is_one_mirror else differ
        fitted = [() if found.alignment is None else found.alignment.panels for found in (a, b)]
        self.panels = [{panel.panel: panel for panel in panels} for panels in fitted]
        common = [panel for panel in self.panels[1] if panel in self.panels[0] and self.is_one_mirror]
        self.changes = panel_changes(
            [(self.panels[0][panel], self.panels[1][panel]) for panel in common], differing_errors(a.network, b.network)
        )
        both = [[self.panels[k][panel] for panel in common] for k in (0, 1)]
        has_moved = self.changes is not None and any(panel.has_moved for panel in self.changes.panels)
        mirror, errors = b.record.mirror, differing_errors(a.network, b.network)
        self.checks = check_moves(mirror, both[0], both[1], errors) if has_moved else ()
        self.verdicts = Counter(move.made for one in self.checks for move in one.moves)
        self.repeatability_m = repeatability_m(both[0], both[1])
        self.wavefronts = [
            mirror_wavefront([panel.rigid.wavefront for panel in panels.values() if panel.panel in common])
            for panels in self.panels
        ]


def compare_runs(run_a: Path, run_b: Path, out: Path, figures: Path | None = None) -> RunPair:
    """Write a page that compares two runs, and its figures if a directory is given; raises as ``report_run``."""
    if figures is not None:
        check_drawing(figures)
    pair = RunPair(findings_of(read_record(run_a)), findings_of(read_record(run_b)))
    write_file(out, compare_page(pair), PAGE_MODE)
    if figures is not None:
        write_pictures(compare_drawings(pair), figures)
    return pair


class ComparedValue(NamedTuple):
    """One value of both runs: name with unit, number of decimals, values."""

    name: str
    decimals: int
    a: float | None
    b: float | None
    change: float | None  # B minus A, rounded to the decimals


# Path of a value in ``run_data``, its name, its decimals.
_Row = tuple[str, str, int]
_ROWS: tuple[_Row, ...] = (
    ("points.total", "points", 0),
    ("points.pass", "points, pass", 0),
    ("points.corrected", "points, corrected", 0),
    ("points.fail", "points, fail", 0),
    ("points.skipped", "points, skipped", 0),
    ("points.not_measured", "points, not measured", 0),
    ("arrival_error_mm.mean", "first arrival, mean, mm", 3),
    ("arrival_error_mm.max", "first arrival, largest, mm", 3),
    ("localization_error_mm.mean_mm", "localization error, mean, mm", 3),
    ("localization_error_mm.p50_mm", "localization error, median, mm", 3),
    ("localization_error_mm.p99_mm", "localization error, 99 %, mm", 3),
    ("localization_error_mm.max_mm", "localization error, largest, mm", 3),
    ("localization_error_mm.within_sigma3", "frames within 3 \u03c3, %", 2),
    ("localization_error_mm.within_limit", "frames within 10 mm, %", 2),
    *((f"time_budget_s.spent.{kind}", f"time, {kind}, s", 1) for kind in KINDS),
    ("time_budget_s.total", "time, all, s", 1),
    *((f"time_budget_s.least.{kind}", f"least time, {kind}, s", 1) for kind in KINDS),
    ("time_budget_s.bound", "least time, all, s", 1),
)
_WAVEFRONT_ROWS: tuple[_Row, ...] = (
    ("before", "half-wavefront error, \u00b5m", 2),
    ("before_level", "half-wavefront error without its mean, \u00b5m", 2),
    ("after", "half-wavefront error after the moves, \u00b5m", 2),
    ("noise", "noise of one point, \u00b5m", 2),
)


def compared_figures(pair: RunPair) -> list[ComparedValue]:
    """The values of both runs; values that neither run has are left out.

    Half-wavefront errors are those of the panels that both runs have; the names state this if these are not all panels.
    """
    data = [run_data(found) for _, found in pair.named]
    a, b = pair.panels
    whole, over = [one["half_wavefront_um"] for one in data], ""
    if pair.is_one_mirror and a.keys() != b.keys():
        whole = [wavefront_data(one) for one in pair.wavefronts]
        over = f", common panels ({len(a.keys() & b.keys())})"
    return [*_compared(_ROWS, data), *_compared(_WAVEFRONT_ROWS, whole, over, is_of_one=pair.is_one_mirror)]


def _compared(
    rows: Sequence[_Row], data: Sequence[Mapping[str, Any] | None], suffix: str = "", *, is_of_one: bool = True
) -> Iterator[ComparedValue]:
    for path, name, decimals in rows:
        values: list[float | None] = []
        for found in data:
            value: Any = found
            for key in path.split("."):
                value = None if value is None else value.get(key)
            values.append(None if value is None else (100.0 if name.endswith("%") else 1.0) * float(value))
        a, b = values
        if values != [None, None]:
            change = None if a is None or b is None or not is_of_one else round(b - a, decimals)
            yield ComparedValue(name + suffix, decimals, a, b, change)


def compare_page(pair: RunPair) -> str:
    """The comparison as one HTML file. A section without data is left out."""
    mirror, (a, b) = pair.b.record.mirror, pair.panels
    ours, others = (found.record.cfg.model_dump(mode="json") for _, found in pair.named)
    earlier = {verdict.point: verdict for verdict in pair.a.points}
    fitted = [(name, panels) for name, panels in (("A", a), ("B", b)) if panels and pair.is_one_mirror]
    everything = [panel for _, panels in fitted for panel in panels.values()]
    surfaces = []
    for name, panels in fitted:
        title = f"{mirror.name}: surface of {name}"
        surfaces.append((name, inline(surface_figure(mirror, [*panels.values()], title, NARROW, everything))))
    largest_m = {panel: float(abs(found.rigid.moves.values_m).max()) for panel, found in b.items()}
    moved = sorted({*a, *b}, key=lambda panel: (-largest_m.get(panel, 0.0), panel)) if fitted else []
    return render(
        "compare.html",
        pair=pair,
        figures=page_figures(compare_drawings(pair)),
        compared=compared_figures(pair),
        wrong=wrong_moves(pair.checks),
        changed=changed_keys(ours, others),
        points=[(earlier[verdict.point], verdict) for verdict in pair.b.points if verdict.point in earlier],
        surfaces=surfaces,
        places=places_of(mirror, moved),
        moves=[(panel, a.get(panel), b.get(panel)) for panel in moved],
        events=[(letter, events_of(found.record.log)) for letter, found in pair.named if found.record.log],
    )


def compare_drawings(pair: RunPair) -> dict[str, Draw]:
    """Functions that draw the figures, by file name; figures without data are left out."""
    found: dict[str, Draw] = {}
    budgets = [(name, one.budget) for name, one in pair.named if one.budget is not None]
    if budgets:
        found["time"] = partial(time_figure, budgets, max(one.record.cfg.run.budget_s for _, one in pair.named))
    series = {name: one.errors for name, one in pair.named if one.errors is not None}
    if series:
        found["localization"] = partial(errors_figure, series)
    first = {name: np.array([v.first_mm for v in one.points if v.first_mm is not None]) for name, one in pair.named}
    arrivals = {name: some for name, some in first.items() if len(some)}
    if arrivals:
        found["arrivals"] = partial(distribution_figure, arrivals, "distance at first arrival, mm")
    mirror, (a, b) = pair.b.record.mirror, pair.panels
    if pair.changes is not None:
        found["change"] = partial(change_figure, mirror, [*a.values()], [*b.values()])
    records = {letter: one.record for letter, one in pair.named if one.record.sessions}
    if pair.is_one_mirror and records:
        found["paths"] = partial(paths_figure, mirror, records)
    return found


def compare_lines(pair: RunPair) -> list[str]:
    """A line for each value that differs, then the panels that have moved."""
    rows = [one for one in compared_figures(pair) if one.change != 0.0]
    names = [one.name.replace("\u00b5", "u").replace("\u03c3", "sigma") for one in rows]
    width = max(map(len, names), default=0) + 2
    return render(
        "compare.txt", pair=pair, wrong=wrong_moves(pair.checks), rows=[*zip(names, rows, strict=True)], width=width
    ).splitlines()


class WrongMove(NamedTuple):
    """A line of what is not as planned: an adjuster with its moves, or a panel whose plane has several explanations."""

    panel: PanelId
    what: str
    text: str


def wrong_moves(checks: Sequence[PanelCheck]) -> list[WrongMove]:
    """What is not as planned, panel by panel."""
    found = []
    for check in checks:
        if check.is_as_planned:
            continue
        if check.is_plane:
            found.append(WrongMove(check.panel, "not as planned", _plane_text(check)))
            continue
        found += [
            WrongMove(
                check.panel,
                f"{one.adjuster} {one.made.value}",
                f"planned {MICRO * one.planned_m:+.1f} um, measured {MICRO * one.measured_m:+.1f} "
                f"+- {MICRO * one.sigma_m:.1f} um",
            )
            for one in check.moves
            if one.made is not Made.AS_PLANNED
        ]
    return found


def _plane_text(check: PanelCheck) -> str:
    if not check.explanations:
        return "two or more adjusters; the panel has not bent, and its plane alone does not tell which"
    planned = {one.adjuster: one.planned_m for one in check.moves}
    text = ", or ".join(_explanation_text(one, planned) for one in check.explanations)
    return f"{text}; its plane alone does not tell which" if len(check.explanations) > 1 else text


def _explanation_text(one: MoveExplanation, planned_m: Mapping[str, float]) -> str:
    if one.made is Made.EXCHANGED:
        return f"{' and '.join(one.adjusters)} were exchanged"
    if one.factor is not None:
        whole = {Made.NOT: "no adjuster moved", Made.WRONG_WAY: "all adjusters moved the wrong way"}
        return whole.get(one.made, f"all adjusters moved by {one.factor:.2f} times the plan")
    return " and ".join(
        f"{name} moved by {MICRO * moved:+.1f} +- {MICRO * sigma:.1f} um in place of {MICRO * planned_m[name]:+.1f} um"
        for name, moved, sigma in zip(one.adjusters, one.moved_m, one.sigmas_m, strict=True)
    )


def compare_data(pair: RunPair) -> dict[str, Any]:
    """Output of ``ccatp compare --json``."""
    changes, (a, b) = pair.changes, map(wavefront_data, pair.wavefronts)
    return {
        "a": run_data(pair.a),
        "b": run_data(pair.b),
        "one_mirror": pair.is_one_mirror,
        "half_wavefront_common_um": {"a": a, "b": b},
        "panels": changes and [_panel(panel) for panel in changes.panels],
        "chi2": changes and round(changes.chi2, 4),
        "dof": changes and changes.dof,
        "agree": changes and changes.agree,
        "moves": [
            {
                **one.panel._asdict(),
                "adjuster": one.adjuster,
                "planned_um": round(MICRO * one.planned_m, 4),
                "measured_um": round(MICRO * one.measured_m, 4),
                "sigma_um": round(MICRO * one.sigma_m, 4),
                "made": one.made.value,
            }
            for check in pair.checks
            for one in check.moves
        ],
        "explanations": [
            {**one.panel._asdict(), "what": one.what, "text": one.text} for one in wrong_moves(pair.checks)
        ],
        "repeatability_um": pair.repeatability_m and round(MICRO * pair.repeatability_m, 4),
    }


def _panel(panel: PanelChange) -> dict[str, Any]:
    names = ("piston_um", "tip_urad", "tilt_urad")
    return {
        **panel.panel._asdict(),
        **{name: round(MICRO * value, 4) for name, value in zip(names, panel.values.tolist(), strict=True)},
        "sigma": [round(MICRO * value, 4) for value in panel.sigma.tolist()],
        "chi2": round(panel.chi2, 4),
        "has_moved": panel.has_moved,
    }
