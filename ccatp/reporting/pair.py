"""Pure. Two runs, called A and B, and their figures beside each other: what each is called, and how it is written."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from ccatp.aligning.wavefront import MirrorWavefront, mirror_wavefront
from ccatp.reporting.data import run_data, wavefront_data
from ccatp.reporting.findings import Findings
from ccatp.reporting.panel_changes import Changes, panel_changes
from ccatp.reporting.time_budget import KINDS
from ccatp.samples import PanelId

_WAVEFRONT = "half_wavefront_um"
_PERCENT = 100.0


class Pair(NamedTuple):
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


def pair_of(a: Findings, b: Findings) -> Pair:
    """Put two runs beside each other."""
    found = Pair(a, b, None)
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


def compared_figures(pair: Pair) -> list[Figure]:
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
