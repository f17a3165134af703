"""The commands ``ccatp radio calibrate``, ``fix`` and ``fuzzy``: path loss, positions from levels, the speed rules."""

import json
from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ccatp.cli.common import JSON_OPTION, SETTINGS_OPTION, complain, example, figure_option
from ccatp.errors import CcatpError, ExitStatus

if TYPE_CHECKING:
    from ccatp.beacons.datasets.levels import PlaceTable
    from ccatp.beacons.slam.level_fix import LevelLocator, Room
    from ccatp.beacons.slam.path_loss import PathLossFit

    Fits = Callable[[int | None], Mapping[str, PathLossFit]]


CONFIDENCE = 0.95
_LEAST_DB = 0.3  # readings come in whole decibels: 1 / sqrt(12)


class CalibrateError(CcatpError):
    """Options or data from which nothing can be had."""

    exit_status = ExitStatus.USAGE


@click.command(
    epilog=example(
        "ccatp radio calibrate pairs.csv --figure path_loss.png",
        "ccatp radio calibrate Pathloss_Scenario1.xlsx --sheet Zigbee --json",
        "ccatp radio calibrate Pathloss/Zigbee --points Pathloss_Scenario1.xlsx",
    )
)
@click.argument("path", type=click.Path(path_type=Path))
@click.option("--sheet", metavar="NAME", help="Sheet of a workbook; the first if not given.")
@click.option("--points", type=click.Path(path_type=Path), help="Table of the distances of a folder of logs.")
@figure_option("Draw it")
@JSON_OPTION
def calibrate(path: Path, sheet: str | None, points: Path | None, figure_file: Path | None, json_output: bool) -> int:
    """Find reference level, exponent and spread of a radio from pairs of distance and level."""
    from ccatp.beacons.datasets.levels import read_levels
    from ccatp.beacons.slam.path_loss import PathLossError, fit_path_loss

    table = read_levels(path, sheet, points)
    try:
        fit = fit_path_loss(table.pairs)
    except PathLossError as error:
        raise CalibrateError(f"{path}: {error}") from error
    warnings = [*table.warnings, *fit.doubts()]
    for warning in warnings:
        complain(f"warning: {warning}", 0)
    if figure_file is not None:
        from ccatp.report.beacon_plots import draw_path_loss

        draw_path_loss(fit, table.pairs, table.name, figure_file)
    if json_output:
        click.echo(json.dumps({"data": table.name, **fit.data(CONFIDENCE), "warnings": warnings}))
        return 0
    _show_fit(table.name, fit)
    return 0


def _show_fit(name: str, fit: "PathLossFit") -> None:
    found = fit.data(CONFIDENCE)
    is_repeated = found["white_sigma_db"] is not None
    low_db, high_db = found["sigma_low_db"], found["sigma_high_db"]
    s = fit.path_loss.log_sigma
    lines = [
        f"{name}: {fit.readings} readings at {fit.places} distances, {CONFIDENCE:.0%} confidence",
        f"  reference level at 1 m {fit.reference_dbm:8.2f} ± {found['reference_half_width_db']:.2f} dBm",
        f"  exponent               {fit.exponent:8.3f} ± {found['exponent_half_width']:.3f}",
        f"  spread about the line  {fit.sigma_db:8.2f} dB ({low_db:.2f} to {high_db:.2f})",
    ]
    if is_repeated:
        lines.append(f"    reading to reading   {fit.white_sigma_db:8.2f} dB")
        lines.append(f"    place to place       {fit.shadowing_sigma_db:8.2f} dB")
    lines += [
        f"  a range from one level is wrong by a factor of e^±{s:.2f}; uncorrected it is {s * s / 2.0:.0%} too long",
        "configuration:",
        "  [path_loss]",
        f"  reference_dbm = {fit.reference_dbm:.2f}",
        f"  exponent = {fit.exponent:.3f}",
        f"  white_sigma_db = {max(fit.white_sigma_db if is_repeated else fit.sigma_db, _LEAST_DB):.2f}",
    ]
    if is_repeated:
        lines.append(f"  shadowing_sigma_db = {fit.shadowing_sigma_db:.2f}")
    click.echo("\n".join(lines))


REGION = 0.9
_CLEARLY = 6.9  # of log-likelihood: a thousand to one
_LARGEST_M = 1e4  # of coordinates: levels reach no further than that
_MOST_POINTS = 250_000  # of the grid: a few megabytes for each beacon


@click.command(
    epilog=example(
        "ccatp radio fix Tests_Scenario1.xlsx --fingerprints Database_Scenario1.xlsx "
        "--beacon A=0,0 --beacon B=0,4 --beacon C=4,0",
        "ccatp radio fix Database_Scenario1.xlsx --fingerprints Database_Scenario1.xlsx "
        "--beacon A=0,0 --beacon B=0,4 --beacon C=4,0   # each point by the others",
    )
)
@click.argument("path", type=click.Path(path_type=Path))
@click.option("--fingerprints", type=click.Path(path_type=Path), help="Places and levels that calibrate each beacon.")
@click.option("--path-loss", type=click.Path(path_type=Path), help="Distances and levels that calibrate all instead.")
@click.option("--beacon", "beacons", multiple=True, metavar="NAME=X,Y", help="Place of a beacon, m. Repeat for each.")
@click.option("--exchange", metavar="NAME,NAME", help="Two beacons that PATH has exchanged.")
@click.option("--room", metavar="X0,Y0,X1,Y1", help="Where the receiver may be, m; round the beacons if not given.")
@click.option("--spacing", "spacing_m", type=float, default=0.1, show_default=True, help="Of the grid, m.")
@click.option("--sheet", metavar="NAME", help="Sheet of the workbooks; the first if not given.")
@figure_option("Draw it")
@JSON_OPTION
def fix(
    path: Path, fingerprints: Path | None, path_loss: Path | None, beacons: Sequence[str], exchange: str | None,
    room: str | None, spacing_m: float, sheet: str | None, figure_file: Path | None, json_output: bool,
) -> int:  # fmt: skip
    """Find each place of PATH from one level of each beacon, and judge the errors and the 90 % regions."""
    from ccatp.beacons.datasets.levels import read_places
    from ccatp.beacons.slam.level_fix import LevelLocator, judged

    places_m = _beacons(beacons)
    if len(places_m) < 2:
        raise CalibrateError("--beacon: give the place of two beacons at least, as --beacon A=0,0 --beacon B=0,4")
    area = _room(room, places_m, spacing_m)
    table = _exchanged(read_places(path, sheet), exchange)
    fits, leave_out = _fits(path, fingerprints, path_loss, places_m, sheet)
    locator = LevelLocator(places_m, fits(None), area)
    warnings = [*table.warnings, *([] if leave_out else _names_doubt(locator, table))]
    for warning in warnings:
        complain(f"warning: {warning}", 0)
    found = []
    for index, heard in enumerate(table.places):
        own = LevelLocator(places_m, fits(index), area) if leave_out else locator
        found.append(own.fix(heard.levels_dbm))
    figures = judged(found, table.places, REGION)
    result = {"data": table.name, "leave_one_out": leave_out, **figures, "warnings": warnings}
    if figure_file is not None:
        from ccatp.report.beacon_plots import draw_fixes

        draw_fixes(found, [heard.place_m for heard in table.places], places_m, table.name, figure_file)
    if json_output:
        click.echo(json.dumps(result))
        return 0
    _show_fixes(result)
    return 0


def _beacons(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
    places_m: dict[str, tuple[float, float]] = {}
    for text in texts:
        name, _, place = text.partition("=")
        try:
            x_m, y_m = (float(part) for part in place.split(","))
        except ValueError as error:
            raise CalibrateError(f"--beacon {text}: is not NAME=X,Y in metres, as in A=0,4") from error
        if not (name := name.strip()):
            raise CalibrateError(f"--beacon {text}: has no name; it is NAME=X,Y in metres, as in A=0,4")
        _check_reach(f"--beacon {text}", (x_m, y_m))
        if name in places_m:
            raise CalibrateError(f"--beacon {text}: {name} was given before; each beacon has one place")
        places_m[name] = (x_m, y_m)
    return places_m


def _check_reach(option: str, values_m: Sequence[float]) -> None:
    if not all(isfinite(value) and abs(value) <= _LARGEST_M for value in values_m):
        raise CalibrateError(f"{option}: coordinates must be numbers within ±{_LARGEST_M:g} m")


def _room(text: str | None, places_m: dict[str, tuple[float, float]], spacing_m: float) -> "Room":
    from ccatp.beacons.slam.level_fix import Room

    x0, y0, x1, y1 = _sides(text, places_m)
    longest_m, most = max(x1 - x0, y1 - y0), _MOST_POINTS
    if not 0.0 < spacing_m <= longest_m:
        raise CalibrateError(
            f"--spacing {spacing_m:g}: must be above 0 and at most the room's longer side {longest_m:g} m"
        )
    if ((x1 - x0) / spacing_m + 1.0) * ((y1 - y0) / spacing_m + 1.0) > most:
        raise CalibrateError(
            f"--spacing {spacing_m:g}: makes more than {most} points in a room of {x1 - x0:g} by {y1 - y0:g} m; "
            f"give {longest_m / (most**0.5 - 1.0):.2g} m or more, or a smaller --room"
        )
    return Room((x0, y0), (x1, y1), spacing_m)


def _sides(text: str | None, places_m: dict[str, tuple[float, float]]) -> tuple[float, float, float, float]:
    if text is None:
        xs, ys = zip(*places_m.values(), strict=True)
        if len(set(places_m.values())) == 1:
            raise CalibrateError("--beacon: all stand at one place, which bounds no room; give --room X0,Y0,X1,Y1")
        margin_m = 0.25 * max(max(xs) - min(xs), max(ys) - min(ys))
        return min(xs) - margin_m, min(ys) - margin_m, max(xs) + margin_m, max(ys) + margin_m
    try:
        x0, y0, x1, y1 = (float(part) for part in text.split(","))
    except ValueError as error:
        raise CalibrateError(f"--room {text}: is not X0,Y0,X1,Y1 in metres") from error
    _check_reach(f"--room {text}", (x0, y0, x1, y1))
    if x1 <= x0 or y1 <= y0:
        raise CalibrateError(f"--room {text}: its second corner must be above and to the right of its first")
    return x0, y0, x1, y1


def _exchanged(table: "PlaceTable", exchange: str | None) -> "PlaceTable":
    if exchange is None:
        return table
    pair = [name.strip() for name in exchange.split(",")]
    if len(pair) != 2 or any(name not in table.places[0].levels_dbm for name in pair):
        known = ", ".join(table.places[0].levels_dbm)
        raise CalibrateError(f"--exchange {exchange}: is not two beacons of the data, which has {known}")
    new = {pair[0]: pair[1], pair[1]: pair[0]}
    return table._replace(places=tuple(heard.renamed(new) for heard in table.places))


def _fits(
    path: Path, fingerprints: Path | None, path_loss: Path | None, places_m: dict[str, tuple[float, float]],
    sheet: str | None,
) -> "tuple[Fits, bool]":  # fmt: skip
    from ccatp.beacons.datasets.levels import read_levels, read_places
    from ccatp.beacons.slam.level_fix import fingerprint_fits
    from ccatp.beacons.slam.path_loss import PathLossError, fit_path_loss

    if (fingerprints is None) == (path_loss is None):
        raise CalibrateError("give either --fingerprints or --path-loss, which calibrate the levels")
    try:
        if path_loss is not None:
            common = fit_path_loss(read_levels(path_loss, sheet).pairs)
            return lambda _index: dict.fromkeys(places_m, common), False
        heard_at = read_places(fingerprints or path, sheet).places
        fingerprint_fits(heard_at, places_m)
    except PathLossError as error:
        raise CalibrateError(f"{fingerprints or path_loss}: {error}") from error
    is_same = fingerprints is not None and fingerprints.resolve() == path.resolve()
    return lambda left_out: fingerprint_fits(heard_at, places_m, left_out), is_same


def _names_doubt(locator: "LevelLocator", table: "PlaceTable") -> list[str]:
    from ccatp.beacons.slam.level_fix import likeliest_names

    names, gain = likeliest_names(locator, table.places)
    moved = [f"{old} is {new}" for old, new in names.items() if old != new]
    if gain < _CLEARLY or not moved:
        return []
    return [f"beacons look exchanged: {', '.join(moved)} is e^{gain:.0f} times as likely; see --exchange"]


def _show_fixes(result: dict[str, Any]) -> None:
    how = ", each by the calibration of the others" if result["leave_one_out"] else ""
    click.echo(f"{result['data']}: {len(result['points'])} places, one level of each beacon{how}")
    for index, point in enumerate(result["points"], 1):
        (x, y), (fx, fy), (sx, sy) = point["true_m"], point["fix_m"], point["sigma_m"]
        inside = "inside" if point["in_region"] else "outside"
        click.echo(
            f"  {index:3d}  true {x:5.2f} {y:5.2f}  fix {fx:5.2f} {fy:5.2f} ± {sx:.2f} {sy:.2f}  "
            f"error {point['error_m']:.2f} m, {inside} its {result['region']:.0%} region"
        )
    click.echo(
        f"mean error {result['mean_error_m']:.2f} m, median {result['median_error_m']:.2f} m, largest "
        f"{result['largest_error_m']:.2f} m; {result['in_region']} of {len(result['points'])} "
        f"({result['coverage']:.0%}) in their {result['region']:.0%} regions"
    )


@click.command(epilog=example("ccatp radio fuzzy --figure speed.png", "ccatp radio fuzzy --at 0.3 0.5"))
@click.option("--config", "config_file", type=click.Path(path_type=Path), help="Configuration (TOML).")
@SETTINGS_OPTION
@click.option(
    "--at", nargs=2, type=float, multiple=True, metavar="M RAD", help="Speed at a distance and a heading error."
)
@figure_option("Draw it")
@JSON_OPTION
def fuzzy(
    config_file: Path | None, settings: dict[str, object], at: Sequence[tuple[float, float]], figure_file: Path | None,
    json_output: bool,
) -> int:  # fmt: skip
    """Show the fuzzy speed controller: its table, its surface, its value at a point."""
    from ccatp.beacons.steering import FuzzyGapError, Sugeno
    from ccatp.config.load import load_radio_config

    for distance_m, error_rad in at:
        if not (isfinite(distance_m) and isfinite(error_rad) and distance_m >= 0.0):
            raise CalibrateError(f"--at {distance_m:g} {error_rad:g}: wants a distance >= 0 m and a finite angle, rad")
    cfg = load_radio_config(config_file, settings).control.fuzzy
    try:
        sugeno = Sugeno(cfg)
    except FuzzyGapError as error:
        raise CalibrateError(f"control.fuzzy: {error}") from error
    distances, errors = (0.05, 0.25, 0.5, 0.8, 1.5), (0.0, 0.3, 0.6, 1.0, 1.6)
    points = list(at) or [(distance_m, error_rad) for error_rad in errors for distance_m in distances]
    values = []
    for distance_m, error_rad in points:
        named = {"distance_m": distance_m, "heading_error_rad": abs(error_rad)}
        values.append({**named, "speed_m_s": round(sugeno.evaluate([named[name] for name in sugeno.inputs]), 5)})
    if figure_file is not None:
        from ccatp.report.beacon_plots import draw_fuzzy

        draw_fuzzy(cfg, figure_file)
    if json_output:
        click.echo(json.dumps({"rules": len(cfg.rules), "points": values}))
        return 0
    click.echo("distance, m   heading error, rad   speed, m/s")
    for value in values:
        click.echo(f"{value['distance_m']:11.2f} {value['heading_error_rad']:20.2f} {value['speed_m_s']:12.3f}")
    return 0
