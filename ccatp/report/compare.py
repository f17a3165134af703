"""Comparison of two surveys, A and B: what changed on the mirror, the page, lines for a terminal, data."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ccatp.config.files import write_file
from ccatp.config.models import MirrorConfig
from ccatp.core import PanelId
from ccatp.errors import UsageError, counted
from ccatp.mirror.adjuster_work import work_list
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.move_checks import Made, MoveExplanation, PanelCheck, check_moves, is_noise
from ccatp.mirror.network_model import Effect
from ccatp.mirror.network_points import CalibratedSurveys
from ccatp.mirror.panel_alignment import PanelResult, mirror_wavefront
from ccatp.mirror.panel_changes import Changes, PanelChange, panel_changes
from ccatp.report.alignment import places_of
from ccatp.report.figures import distribution_figure, errors_figure, time_figure
from ccatp.report.findings import KINDS, Findings, findings_of
from ccatp.report.html import MICRO, Draw, events_of, inline, page_figures, render, write_pictures
from ccatp.report.mirror_map import change_figure, paths_figure, surface_figure
from ccatp.report.plots import NARROW, check_drawing
from ccatp.report.record import changed_keys, read_record
from ccatp.report.run_page import PAGE_MODE, run_data, wavefront_data
from ccatp.report.saved_alignment import read_alignment

COMPARISON = "compare.html"
_NAMED = 12  # largest number of panels that a line names


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


class Survey(NamedTuple):
    """One of the two surveys: its mirror, the panels that it determined, and the run, if it was one.

    ``has_own_frame``: that of another instrument, not of the collimators at the telescope.
    """

    name: str
    cfg: MirrorConfig
    mirror: Mirror
    panels: Mapping[PanelId, PanelResult]
    findings: Findings | None = None
    has_own_frame: bool = False

    @property
    def network(self) -> CalibratedSurveys | None:
        """The laser network of a run."""
        return None if self.findings is None else self.findings.network


def survey_of(found: Findings) -> Survey:
    """A run."""
    record, fitted = found.record, () if found.alignment is None else found.alignment.panels
    return Survey(record.name, record.cfg.mirror, record.mirror, {panel.panel: panel for panel in fitted}, found)


def read_survey(path: Path) -> Survey:
    """A run directory, or an alignment that was written; raises as ``read_record`` and ``read_alignment``."""
    if path.is_file():
        saved = read_alignment(path)
        panels = {panel.panel: panel for panel in saved.panels}
        return Survey(saved.name, saved.cfg, saved.mirror, panels, has_own_frame=saved.is_of_points)
    return survey_of(findings_of(read_record(path)))


class SurveyPair:
    """Two surveys, called A and B as on the page, and the changes between them.

    ``wavefronts``: half-wavefront errors of the panels that both surveys have, or None. ``checks``: by panel, the moves
    that A plans against the change that B shows, if any panel has moved; ``as_planned``: panels that have changed so.
    ``remarks``: what the comparison cannot determine, or what seems to be wrong with it.

    Points and panels are compared only if the mirror is the same; otherwise ``warning`` is not empty.
    """

    def __init__(self, a: Survey, b: Survey) -> None:
        self.a, self.b = a, b
        self.named = (("A", a), ("B", b))
        self.runs = [(name, one.findings) for name, one in self.named if one.findings is not None]
        self.warning = _why_other_mirror(a, b)
        self.is_one_mirror = not self.warning
        common = [panel for panel in b.panels if panel in a.panels and self.is_one_mirror]
        pairs = [(a.panels[panel], b.panels[panel]) for panel in common]
        self.has_one_frame = not (a.has_own_frame or b.has_own_frame)
        self.work = work_list(a.mirror, a.cfg.adjusters, [*a.panels.values()]).panels
        self.changes = _changes(a, b, common, self.work, has_one_frame=self.has_one_frame)
        moved = [] if self.changes is None else [one.panel for one in self.changes.panels if one.has_moved]
        self.checks: tuple[PanelCheck, ...] = ()
        if self.changes is not None and moved:
            pairs = [(a.panels[panel], b.panels[panel]) for panel in common]
            self.checks = check_moves((a.mirror, b.mirror), pairs, self.changes, self.work)
        self.verdicts = Counter(move.made for one in self.checks for move in one.moves)
        self.as_planned = frozenset(check.panel for check in self.checks if check.is_as_planned)
        self.remarks = [*_remarks(self, common, moved)]
        self.wavefronts = [
            mirror_wavefront([panel.rigid.wavefront for panel in one.panels.values() if panel.panel in common])
            for one in (a, b)
        ]

    @property
    def repeatability_m(self) -> float | None:
        """Of a point, by both surveys."""
        return None if self.changes is None else self.changes.repeat.sigma_m


def _changes(
    a: Survey, b: Survey, common: Sequence[PanelId], work: Collection[PanelId], *, has_one_frame: bool
) -> Changes | None:
    """Changes from A to B, of which A plans those of the panels in ``work``."""
    pairs = [(a.panels[panel], b.panels[panel]) for panel in common]
    planned = np.array([-one.fit.values * (one.panel in work) for one, _ in pairs])
    errors = differing_errors(a.network, b.network)
    return panel_changes(a.mirror, pairs, planned=planned, errors=errors, has_one_frame=has_one_frame)


def _are_exchanged(pair: SurveyPair, common: Sequence[PanelId], moved: Sequence[PanelId]) -> bool:
    """Whether most panels that have moved did so as B plans, from B to A, and not as A plans."""
    if 2 * len(pair.as_planned.intersection(moved)) >= len(moved):
        return False
    work = work_list(pair.b.mirror, pair.b.cfg.adjusters, [*pair.b.panels.values()]).panels
    turned = _changes(pair.b, pair.a, common, work, has_one_frame=pair.has_one_frame)
    made = [
        one
        for one in (() if turned is None else turned.panels)
        if one.has_moved
        and one.panel in work
        and is_noise(one.values + pair.b.panels[one.panel].fit.values, one.covariance)
    ]
    return 2 * len(made) > len(moved)


def _why_other_mirror(a: Survey, b: Survey) -> str:
    """Why the panels of two surveys cannot be compared; empty if they can."""
    if a.cfg.name != b.cfg.name:
        return f"The runs are of different mirrors, {a.cfg.name} and {b.cfg.name}: points and panels are not compared."
    parts = [part for part in ("surface", "frame", "panels") if getattr(a.cfg, part) != getattr(b.cfg, part)]
    if parts:
        return f"The mirrors have other values in {', '.join(parts)}: points and panels are not compared."
    return ""


def _remarks(pair: SurveyPair, common: Sequence[PanelId], moved: Sequence[PanelId]) -> Iterator[str]:
    for (name, one), other in zip(pair.named, (pair.b, pair.a), strict=True):
        if pair.is_one_mirror and (only := sorted(one.panels.keys() - other.panels.keys())):
            missing = pair.work.intersection(only) if one is pair.a else ()
            planned = f"; {len(missing)} of them were to be moved" if missing else ""
            yield f"only in {name}: {_names(only)}{planned}"
    if pair.checks and (idle := sorted(set(common) - pair.work)):
        yield f"not in the work list of A, so without a planned change: {_names(idle)}"
    if pair.changes is None:
        return
    if not moved and (left := pair.work.intersection(common)):
        yield f"no panel has moved; A plans moves of {len(left)} panel{'s' if len(left) > 1 else ''}"
    if _are_exchanged(pair, common, moved):
        yield "B plans what leads to A: if the adjusters were turned, A and B are exchanged"
    repeat, motion = pair.changes.repeat, pair.changes.motion
    if repeat.is_same:
        yield "A and B have the same points: they are one survey"
    if repeat.variance != 1.0:
        yield (
            f"points repeat {repeat.variance**0.5:.2f} times as they are uncertain: the standard deviations of the "
            "changes are multiplied by it"
        )
    if repeat.other_surface:
        yield (
            f"{_names(sorted(repeat.other_surface))}: the points have changed by more than noise, and not as adjusters "
            "move a panel: another panel, or other targets?"
        )
    if motion is not None:
        yield (
            f"all panels have moved together by {1e3 * motion.rms_m:.3f} mm rms ({1e3 * motion.mean_m:+.3f} mm in the "
            f"mean), by {motion.panels} panels: a motion of the whole mirror, of a frame, or the target's offset; it "
            "is not part of the changes"
        )
    elif not pair.has_one_frame:
        yield (
            "the panels do not show how the frames of A and B differ: it takes 11, of which most have changed as "
            "planned or not at all; a motion of the whole mirror is part of the changes"
        )


def _names(panels: Sequence[PanelId]) -> str:
    return counted("panel", [f"{panel.row}/{panel.col}" for panel in panels], _NAMED)


def compare_surveys(before: Path, after: Path, out: Path | None, figures: Path | None = None) -> SurveyPair:
    """Write a page that compares two surveys, and its figures if a directory is given; raises as ``read_survey``.

    ``UsageError``: alignments that cannot be compared.
    """
    if figures is not None:
        check_drawing(figures)
    pair = SurveyPair(read_survey(before), read_survey(after))
    if len(pair.runs) < 2:
        # Without runs there is nothing but the panels.
        if pair.warning:
            raise UsageError(f"{before} and {after}: {pair.warning}")
        if pair.changes is None:
            raise UsageError(f"{before} and {after} have no panel in common")
        if pair.changes.repeat.is_same:
            raise UsageError(f"{before} and {after} have the same points: they are one survey; give the later one")
    if out is not None:
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


def compared_figures(pair: SurveyPair) -> list[ComparedValue]:
    """The values of both runs; values that neither run has are left out.

    Half-wavefront errors are those of the panels that both runs have; the names state this if these are not all panels.
    """
    data = [None if one.findings is None else run_data(one.findings) for _, one in pair.named]
    a, b = pair.a.panels, pair.b.panels
    whole, over = [None if one is None else one["half_wavefront_um"] for one in data], ""
    if pair.is_one_mirror and (a.keys() != b.keys() or len(pair.runs) < 2):
        whole = [wavefront_data(one) for one in pair.wavefronts]
        over = f", common panels ({len(a.keys() & b.keys())})" if a.keys() != b.keys() else ""
    if not pair.has_one_frame:
        # They contain how the frames differ.
        whole = [None, None]
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


def compare_page(pair: SurveyPair) -> str:
    """The comparison as one HTML file. A section without data is left out."""
    mirror, a, b = pair.b.mirror, pair.a.panels, pair.b.panels
    settings = [found.record.cfg.model_dump(mode="json") for _, found in pair.runs]
    points = []
    if len(pair.runs) > 1:
        earlier = {verdict.point: verdict for verdict in pair.runs[0][1].points}
        points = [(earlier[one.point], one) for one in pair.runs[1][1].points if one.point in earlier]
    fitted = [(name, one.panels) for name, one in pair.named if one.panels and pair.is_one_mirror]
    everything = [panel for _, panels in fitted for panel in panels.values()]
    surfaces = []
    for name, panels in fitted:
        title = f"{mirror.name}: surface of {name}"
        surfaces.append((name, inline(surface_figure(mirror, [*panels.values()], title, NARROW, everything))))
    largest_m = {panel: float(abs(found.rigid.moves.values_m).max()) for panel, found in b.items()}
    moved = sorted({*a, *b}, key=lambda panel: (-largest_m.get(panel, 0.0), panel)) if fitted else []
    is_one_order = pair.a.cfg.adjusters.order == pair.b.cfg.adjusters.order
    return render(
        "compare.html",
        pair=pair,
        figures=page_figures(compare_drawings(pair)),
        compared=compared_figures(pair),
        wrong=wrong_moves(pair.checks),
        has_settings=len(settings) > 1,
        changed=changed_keys(settings[0], settings[1]) if len(settings) > 1 else {},
        points=points,
        surfaces=surfaces,
        places=places_of(mirror, moved),
        planned_places=places_of(pair.a.mirror, moved),
        moves=[(panel, a.get(panel) if is_one_order else None, b.get(panel)) for panel in moved],
        events=[(letter, events_of(found.record.log)) for letter, found in pair.runs if found.record.log],
    )


def compare_drawings(pair: SurveyPair) -> dict[str, Draw]:
    """Functions that draw the figures, by file name; figures without data are left out."""
    found: dict[str, Draw] = {}
    budgets = [(name, one.budget) for name, one in pair.runs if one.budget is not None]
    if budgets:
        found["time"] = partial(time_figure, budgets, max(one.record.cfg.run.budget_s for _, one in pair.runs))
    series = {name: one.errors for name, one in pair.runs if one.errors is not None}
    if series:
        found["localization"] = partial(errors_figure, series)
    first = {name: np.array([v.first_mm for v in one.points if v.first_mm is not None]) for name, one in pair.runs}
    arrivals = {name: some for name, some in first.items() if len(some)}
    if arrivals:
        found["arrivals"] = partial(distribution_figure, arrivals, "distance at first arrival, mm")
    mirror = pair.b.mirror
    if pair.changes is not None:
        common = {change.panel: change.common for change in pair.changes.panels}
        panels = ([*pair.a.panels.values()], [*pair.b.panels.values()])
        found["change"] = partial(change_figure, mirror, *panels, common)
    records = {letter: one.record for letter, one in pair.runs if one.record.sessions}
    if pair.is_one_mirror and records:
        found["paths"] = partial(paths_figure, mirror, records)
    return found


def compare_lines(pair: SurveyPair) -> list[str]:
    """A line for each value that differs, the panels that have moved, and planned against measured moves."""
    rows = [one for one in compared_figures(pair) if one.change != 0.0]
    names = [one.name.replace("\u00b5", "u").replace("\u03c3", "sigma") for one in rows]
    width = max(map(len, names), default=0) + 2
    text = render(
        "compare.txt", pair=pair, wrong=wrong_moves(pair.checks), rows=[*zip(names, rows, strict=True)], width=width
    )
    return [line.rstrip() for line in text.splitlines()]


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


def compare_data(pair: SurveyPair) -> dict[str, Any]:
    """Output of ``ccatp compare --json``."""
    changes, (a, b) = pair.changes, map(wavefront_data, pair.wavefronts)
    return {
        **{
            name: run_data(one.findings) if one.findings else {"alignment": one.name, "mirror": one.mirror.name}
            for name, one in (("a", pair.a), ("b", pair.b))
        },
        "one_mirror": pair.is_one_mirror,
        "half_wavefront_common_um": {"a": a, "b": b},
        "panels": changes and [_panel(panel) for panel in changes.panels],
        "chi2": changes and round(changes.chi2, 4),
        "dof": changes and changes.dof,
        "agree": changes and changes.agree,
        "common_motion_um": changes
        and changes.motion
        and {
            "mean": round(MICRO * changes.motion.mean_m, 4),
            "rms": round(MICRO * changes.motion.rms_m, 4),
            "panels": changes.motion.panels,
        },
        "other_surface": [panel._asdict() for panel in changes.repeat.other_surface] if changes else [],
        "remarks": pair.remarks,
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
