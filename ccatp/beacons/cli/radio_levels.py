"""The commands ``ccatp radio calibrate``, ``fix`` and ``fuzzy``: path loss, positions from levels, the speed rules."""

from collections.abc import Iterator, Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ccatp.cli import common

if TYPE_CHECKING:
    from ccatp.beacons.estimation.level_fix import LevelLocator, MeasuredPlace
    from ccatp.beacons.estimation.path_loss import PathLossFit
    from ccatp.core import FloatArray

    Places = dict[str, tuple[float, float]]

CONFIDENCE = 0.95
_LEAST_DB = 0.3  # rounding to whole decibels has the standard deviation 1 / sqrt(12)
SHEET_OPTION = click.option("--sheet", metavar="NAME", help="Sheet of workbooks (.xlsx); the first if not given.")


@common.command(
    "ccatp radio calibrate pairs.csv --figure path_loss.png",
    "ccatp radio calibrate Pathloss_Scenario1.xlsx --sheet Zigbee --json",
    "ccatp radio calibrate Pathloss/Zigbee --points Pathloss_Scenario1.xlsx",
)
@click.argument("path", type=common.PATH)
@SHEET_OPTION
@click.option("--points", type=common.PATH, help="Table of the distances of a folder of logs.")
@common.figure_option("Draw it")
@common.JSON_OPTION
def calibrate(path: Path, sheet: str | None, points: Path | None, figure_file: Path | None, json_output: bool) -> None:
    """Find reference level, exponent and spread of a radio from pairs of distance and level."""
    from ccatp.beacons.datasets.sheets import read_levels
    from ccatp.beacons.datasets.tables import RadioDataError
    from ccatp.beacons.estimation.path_loss import PathLossError, fit_path_loss

    name, pairs, warnings = read_levels(path, sheet, points)
    try:
        fit = fit_path_loss(pairs)
    except PathLossError as error:
        raise RadioDataError(path, str(error)) from error
    warnings += fit.doubts()
    common.warn(warnings)
    if figure_file is not None:
        from ccatp.beacons.report.plots import draw_path_loss

        draw_path_loss(fit, pairs, name, figure_file)
    result = {"data": name, **fit.data(CONFIDENCE), "warnings": warnings}
    common.print_result(result, _fit_lines(name, fit), json_output)


def _fit_lines(name: str, fit: "PathLossFit") -> Iterator[str]:
    found = fit.data(CONFIDENCE)
    is_repeated = found["white_sigma_db"] is not None
    s = fit.path_loss.log_sigma
    yield f"{name}: {fit.readings} readings at {fit.places} distances, {CONFIDENCE:.0%} confidence"
    yield f"  reference level at 1 m {fit.reference_dbm:8.2f} ± {found['reference_half_width_db']:.2f} dBm"
    yield f"  exponent               {fit.exponent:8.3f} ± {found['exponent_half_width']:.3f}"
    low_db, high_db = found["sigma_low_db"], found["sigma_high_db"]
    yield f"  spread about the line  {fit.sigma_db:8.2f} dB ({low_db:.2f} to {high_db:.2f})"
    if is_repeated:
        yield f"    reading to reading   {fit.white_sigma_db:8.2f} dB"
        yield f"    place to place       {fit.shadowing_sigma_db:8.2f} dB"
    yield f"  a range from one level is wrong by a factor of e^±{s:.2f}; uncorrected it is {s * s / 2.0:.0%} too long"
    yield "configuration:\n  [path_loss]"
    yield f"  reference_dbm = {fit.reference_dbm:.2f}"
    yield f"  exponent = {fit.exponent:.3f}"
    yield f"  white_sigma_db = {max(fit.white_sigma_db if is_repeated else fit.sigma_db, _LEAST_DB):.2f}"
    if is_repeated:
        yield f"  shadowing_sigma_db = {fit.shadowing_sigma_db:.2f}"


REGION = 0.9
_CLEARLY = 6.9  # difference of the log-likelihood: ratio of 1000 to 1
_LARGEST = 1e4  # of coordinates, m, or angles, rad: the range of radios is smaller
_MOST_POINTS = 250_000  # of the grid: a few megabytes for each beacon


@common.command(
    "ccatp radio fix Tests_Scenario1.xlsx --fingerprints Database_Scenario1.xlsx "
    "--beacon A=0,0 --beacon B=0,4 --beacon C=4,0",
    "ccatp radio fix Database_Scenario1.xlsx --fingerprints Database_Scenario1.xlsx "
    "--beacon A=0,0 --beacon B=0,4 --beacon C=4,0   # each point by the others",
)
@click.argument("path", type=common.PATH)
@click.option("--fingerprints", type=common.PATH, help="Places and levels that calibrate each beacon.")
@click.option("--path-loss", type=common.PATH, help="In place of --fingerprints: distances and levels of all beacons.")
@click.option("--beacon", "beacons", multiple=True, metavar="NAME=X,Y", help="Place of a beacon, m. Repeat for each.")
@click.option("--exchange", metavar="NAME,NAME", help="Two beacons whose names are exchanged in PATH.")
@click.option("--room", metavar="X0,Y0,X1,Y1", help="Where the receiver may be, m; by default around the beacons.")
@click.option("--spacing", "spacing_m", type=float, default=0.1, show_default=True, help="Spacing of the grid, m.")
@SHEET_OPTION
@common.figure_option("Draw it")
@common.JSON_OPTION
def fix(
    path: Path, fingerprints: Path | None, path_loss: Path | None, beacons: Sequence[str], exchange: str | None,
    room: str | None, spacing_m: float, sheet: str | None, figure_file: Path | None, json_output: bool,
) -> None:  # fmt: skip
    """Find each place of PATH from one level of each beacon, and judge the errors and the 90 % regions."""
    from ccatp.beacons.datasets.sheets import read_level_places, read_levels
    from ccatp.beacons.datasets.tables import RadioDataError
    from ccatp.beacons.estimation.level_fix import LevelLocator, fingerprint_fits, judged
    from ccatp.beacons.estimation.path_loss import PathLossError, fit_path_loss

    places_m = _beacons(beacons)
    area = _room(room, places_m, spacing_m)
    name, places, warnings = read_level_places(path, sheet)
    if exchange is not None:
        places = _exchanged(places, exchange)
    source = fingerprints or path_loss
    if source is None or (fingerprints is not None and path_loss is not None):
        raise click.UsageError("give either --fingerprints or --path-loss, which calibrate the levels")
    leave_out = fingerprints is not None and fingerprints.resolve() == path.resolve()
    try:
        if fingerprints is None:
            fits = dict.fromkeys(places_m, fit_path_loss(read_levels(source, sheet)[1]))
            locators = [LevelLocator(places_m, fits, area)]
        else:
            known = read_level_places(source, sheet)[1]
            numbers = range(len(known)) if leave_out else (None,)
            locators = [LevelLocator(places_m, fingerprint_fits(known, places_m, number), area) for number in numbers]
    except PathLossError as error:
        raise RadioDataError(source, str(error)) from error
    if not leave_out:
        warnings += _doubtful_names(locators[0], places)
        locators *= len(places)
    common.warn(warnings)
    found = [locator.fix(place.levels_dbm) for locator, place in zip(locators, places, strict=True)]
    result = {"data": name, "leave_one_out": leave_out, **judged(found, places, REGION), "warnings": warnings}
    if figure_file is not None:
        from ccatp.beacons.report.plots import draw_fixes

        draw_fixes(found, [place.place_m for place in places], places_m, name, figure_file)
    common.print_result(result, _fix_lines(result), json_output)


def coordinates(option: str, text: str, wanted: str, units: str = "metres") -> list[float]:
    """The numbers of an option, as many as ``wanted`` names. Raises UsageError: they are not."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 1 + wanted.count(","):
        raise click.UsageError(f"{option}: is not {wanted} in {units}")
    if not all(isfinite(value) and abs(value) <= _LARGEST for value in values):
        raise click.UsageError(f"{option}: must be numbers within ±{_LARGEST:g}, in {units}")
    return values


def _beacons(texts: Sequence[str]) -> "Places":
    places_m: Places = {}
    for text in texts:
        option, (name, _, place) = f"--beacon {text}", map(str.strip, text.partition("="))
        if not name:
            raise click.UsageError(f"{option}: has no name; it is NAME=X,Y in metres, as in A=0,4")
        x_m, y_m = coordinates(option, place, "NAME=X,Y")
        if name in places_m:
            raise click.UsageError(f"{option}: {name} was given before; each beacon has one place")
        places_m[name] = (x_m, y_m)
    if len(places_m) < 2:
        raise click.UsageError("--beacon: give the place of two beacons at least, as --beacon A=0,0 --beacon B=0,4")
    return places_m


def _room(text: str | None, places_m: "Places", spacing_m: float) -> "FloatArray":
    """Points of a grid over the room, shape (n, 2)."""
    from ccatp.beacons.estimation.level_fix import grid_points

    if text is not None:
        x0, y0, x1, y1 = coordinates(f"--room {text}", text, "X0,Y0,X1,Y1")
        if x1 <= x0 or y1 <= y0:
            raise click.UsageError(f"--room {text}: its second corner must be above and to the right of its first")
    else:
        xs, ys = zip(*places_m.values(), strict=True)
        margin_m = 0.25 * max(max(xs) - min(xs), max(ys) - min(ys))
        if margin_m == 0.0:
            raise click.UsageError("--beacon: all stand at one place, which bounds no room; give --room X0,Y0,X1,Y1")
        x0, y0, x1, y1 = min(xs) - margin_m, min(ys) - margin_m, max(xs) + margin_m, max(ys) + margin_m
    longest_m, most, option = max(x1 - x0, y1 - y0), _MOST_POINTS, f"--spacing {spacing_m:g}"
    if not 0.0 < spacing_m <= longest_m:
        raise click.UsageError(f"{option}: must be above 0 and at most the room's longer side {longest_m:g} m")
    if ((x1 - x0) / spacing_m + 1.0) * ((y1 - y0) / spacing_m + 1.0) > most:
        raise click.UsageError(
            f"{option}: makes more than {most} points in a room of {x1 - x0:g} by {y1 - y0:g} m; "
            f"give {longest_m / (most**0.5 - 1.0):.2g} m or more, or a smaller --room"
        )
    return grid_points((x0, y0), (x1, y1), spacing_m)


def _exchanged(places: "tuple[MeasuredPlace, ...]", exchange: str) -> "tuple[MeasuredPlace, ...]":
    pair = [name.strip() for name in exchange.split(",")]
    known = places[0].levels_dbm
    if len(pair) != 2 or any(name not in known for name in pair):
        raise click.UsageError(f"--exchange {exchange}: is not two beacons of the data, which has {', '.join(known)}")
    return tuple(place.renamed({pair[0]: pair[1], pair[1]: pair[0]}) for place in places)


def _doubtful_names(locator: "LevelLocator", places: "Sequence[MeasuredPlace]") -> list[str]:
    from ccatp.beacons.estimation.level_fix import likeliest_names

    names, gain = likeliest_names(locator, places)
    moved = [f"{old} is {new}" for old, new in names.items() if old != new]
    if gain < _CLEARLY or not moved:
        return []
    return [f"beacons look exchanged: {', '.join(moved)} is e^{gain:.0f} times as likely; see --exchange"]


def _fix_lines(result: dict[str, Any]) -> Iterator[str]:
    how = ", each by the calibration of the others" if result["leave_one_out"] else ""
    yield f"{result['data']}: {len(result['points'])} places, one level of each beacon{how}"
    for index, point in enumerate(result["points"], 1):
        (x, y), (fx, fy), (sx, sy) = point["true_m"], point["fix_m"], point["sigma_m"]
        inside = "inside" if point["in_region"] else "outside"
        yield (
            f"  {index:3d}  true {x:5.2f} {y:5.2f}  fix {fx:5.2f} {fy:5.2f} ± {sx:.2f} {sy:.2f}  "
            f"error {point['error_m']:.2f} m, {inside} its {result['region']:.0%} region"
        )
    yield (
        f"mean error {result['mean_error_m']:.2f} m, median {result['median_error_m']:.2f} m, largest "
        f"{result['largest_error_m']:.2f} m; {result['in_region']} of {len(result['points'])} "
        f"({result['coverage']:.0%}) in their {result['region']:.0%} regions"
    )


@common.command("ccatp radio fuzzy --figure speed.png", "ccatp radio fuzzy --at 0.3 0.5")
@common.CONFIG_OPTION
@common.settings_option("A key of the configuration, as in control.fuzzy.outputs.fast=0.2.")
@click.option(
    "--at", nargs=2, type=float, multiple=True, metavar="M RAD", help="Speed at a distance and a heading error."
)
@common.figure_option("Draw it")
@common.JSON_OPTION
def fuzzy(
    config_file: Path | None, settings: dict[str, object], at: Sequence[tuple[float, float]], figure_file: Path | None,
    json_output: bool,
) -> None:  # fmt: skip
    """Show the fuzzy speed controller: its table, its surface, its value at a point."""
    from ccatp.beacons.config.load import load_radio_config
    from ccatp.beacons.steering import FuzzyGapError, Sugeno

    for distance_m, error_rad in at:
        if not (isfinite(distance_m) and isfinite(error_rad) and distance_m >= 0.0):
            raise click.UsageError(
                f"--at {distance_m:g} {error_rad:g}: wants a distance >= 0 m and a finite angle, rad"
            )
    cfg = load_radio_config(config_file, settings).control.fuzzy
    try:
        sugeno = Sugeno(cfg)
    except FuzzyGapError as error:
        raise click.UsageError(f"control.fuzzy: {error}") from error
    distances, errors = (0.05, 0.25, 0.5, 0.8, 1.5), (0.0, 0.3, 0.6, 1.0, 1.6)
    points = list(at) or [(distance_m, error_rad) for error_rad in errors for distance_m in distances]
    values = []
    for distance_m, error_rad in points:
        named = {"distance_m": distance_m, "heading_error_rad": abs(error_rad)}
        values.append({**named, "speed_m_s": round(sugeno.evaluate([named[name] for name in sugeno.inputs]), 5)})
    if figure_file is not None:
        from ccatp.beacons.report.plots import draw_fuzzy

        draw_fuzzy(cfg, figure_file)
    lines = [f"{v['distance_m']:11.2f} {v['heading_error_rad']:20.2f} {v['speed_m_s']:12.3f}" for v in values]
    head = "distance, m   heading error, rad   speed, m/s"
    common.print_result({"rules": len(cfg.rules), "points": values}, [head, *lines], json_output)
