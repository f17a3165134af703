"""Glue. The command ``ccatp radio fix``."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from math import hypot, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ccatp.commands.frame import JSON_OPTION, complain, example, figure_option
from ccatp.commands.radio_calibrate import CalibrateError

if TYPE_CHECKING:
    from ccatp.radio.level_fix import LevelFix, LevelLocator, Room
    from ccatp.radio.path_loss_fit import LevelPair, PathLossFit
    from ccatp.radio_data.levels import HeardPlace, PlaceTable

    Fits = Callable[[int | None], Mapping[str, PathLossFit]]

REGION = 0.9
_CLEARLY = 6.9  # of log-likelihood: a thousand to one
_LARGEST_M = 1e4  # of coordinates: levels reach no further than that
_MOST_POINTS = 250_000  # of the grid: a few megabytes for each beacon
_NEAREST_M = 0.1  # nearer than this the log-distance model is not believed


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
    from ccatp.radio.level_fix import LevelLocator
    from ccatp.radio_data.levels import read_places

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
    result = {"data": table.name, "leave_one_out": leave_out, **_judged(found, table.places), "warnings": warnings}
    if figure_file is not None:
        from ccatp.pictures.level_figures import draw_fixes

        draw_fixes(found, [heard.place_m for heard in table.places], places_m, table.name, figure_file)
    if json_output:
        click.echo(json.dumps(result))
        return 0
    _tell_fixes(result)
    return 0


def _beacons(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
    places_m: dict[str, tuple[float, float]] = {}
    for text in texts:
        name, place_m = _beacon(text)
        if name in places_m:
            raise CalibrateError(f"--beacon {text}: {name} was given before; each beacon has one place")
        places_m[name] = place_m
    return places_m


def _beacon(text: str) -> tuple[str, tuple[float, float]]:
    name, _, place = text.partition("=")
    try:
        x_m, y_m = (float(part) for part in place.split(","))
    except ValueError as error:
        raise CalibrateError(f"--beacon {text}: is not NAME=X,Y in metres, as in A=0,4") from error
    if not (name := name.strip()):
        raise CalibrateError(f"--beacon {text}: has no name; it is NAME=X,Y in metres, as in A=0,4")
    _check_reach(f"--beacon {text}", (x_m, y_m))
    return name, (x_m, y_m)


def _check_reach(option: str, values_m: Sequence[float]) -> None:
    if not all(isfinite(value) and abs(value) <= _LARGEST_M for value in values_m):
        raise CalibrateError(f"{option}: coordinates must be numbers within ±{_LARGEST_M:g} m")


def _room(text: str | None, places_m: dict[str, tuple[float, float]], spacing_m: float) -> "Room":
    """The given room, or the rectangle round the beacons and a quarter of its longer side more."""
    from ccatp.radio.level_fix import Room

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
    places = tuple(
        replace(heard, levels_dbm={new.get(n, n): level for n, level in heard.levels_dbm.items()})
        for heard in table.places
    )
    return replace(table, places=places)


def _fits(
    path: Path, fingerprints: Path | None, path_loss: Path | None, places_m: dict[str, tuple[float, float]],
    sheet: str | None,
) -> "tuple[Fits, bool]":  # fmt: skip
    """A function of the fingerprint to leave out (or None) to the path losses by beacon; whether to leave out."""
    from ccatp.radio.path_loss_fit import CalibrationError, fit_path_loss
    from ccatp.radio_data.levels import read_levels, read_places

    if (fingerprints is None) == (path_loss is None):
        raise CalibrateError("give either --fingerprints or --path-loss, which calibrate the levels")
    try:
        if path_loss is not None:
            common = fit_path_loss(read_levels(path_loss, sheet).pairs)
            return lambda _index: dict.fromkeys(places_m, common), False
        heard_at = read_places(fingerprints or path, sheet).places

        def fits(left_out: int | None) -> "dict[str, PathLossFit]":
            used = [heard for index, heard in enumerate(heard_at) if index != left_out]
            return {name: fit_path_loss(_pairs(used, name, at)) for name, at in places_m.items()}

        fits(None)
    except CalibrationError as error:
        raise CalibrateError(f"{fingerprints or path_loss}: {error}") from error
    return fits, fingerprints is not None and fingerprints.resolve() == path.resolve()


def _pairs(places: "Sequence[HeardPlace]", name: str, beacon_m: tuple[float, float]) -> "Iterator[LevelPair]":
    """Distances and levels of a beacon; each fingerprint is a place of its own."""
    from ccatp.radio.path_loss_fit import LevelPair

    for heard in places:
        if name in heard.levels_dbm:
            distance_m = hypot(heard.place_m[0] - beacon_m[0], heard.place_m[1] - beacon_m[1])
            yield LevelPair(max(distance_m, _NEAREST_M), heard.levels_dbm[name], heard.place_m)


def _names_doubt(locator: "LevelLocator", table: "PlaceTable") -> list[str]:
    from ccatp.radio.level_fix import likeliest_names

    names, gain = likeliest_names(locator, [(heard.place_m, heard.levels_dbm) for heard in table.places])
    moved = [f"{old} is {new}" for old, new in names.items() if old != new]
    if gain < _CLEARLY or not moved:
        return []
    return [f"beacons look exchanged: {', '.join(moved)} is e^{gain:.0f} times as likely; see --exchange"]


def _judged(found: Sequence["LevelFix"], places: Sequence["HeardPlace"]) -> dict[str, Any]:
    import numpy as np

    points: list[dict[str, Any]] = []
    for fix_found, heard in zip(found, places, strict=True):
        error_m = float(np.hypot(*(fix_found.position_m - heard.place_m)))
        sigmas = np.sqrt(np.diag(fix_found.covariance_m2))
        points.append(
            {
                "true_m": list(heard.place_m),
                "fix_m": [round(float(v), 4) for v in fix_found.position_m],
                "sigma_m": [round(float(v), 4) for v in sigmas],
                "error_m": round(error_m, 4),
                "in_region": fix_found.holds(heard.place_m, REGION),
            }
        )
    errors = [point["error_m"] for point in points]
    return {
        "points": points,
        "mean_error_m": round(float(np.mean(errors)), 4),
        "median_error_m": round(float(np.median(errors)), 4),
        "largest_error_m": max(errors),
        "region": REGION,
        "in_region": sum(bool(point["in_region"]) for point in points),
        "coverage": round(float(np.mean([point["in_region"] for point in points])), 4),
    }


def _tell_fixes(result: dict[str, Any]) -> None:
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
