"""Glue. The command ``ccatp radio calibrate``, and the options that it shares."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ccatp.commands.frame import JSON_OPTION, complain, example, figure_option
from ccatp.errors import CcatpError, ExitStatus

if TYPE_CHECKING:
    from ccatp.radio.path_loss_fit import PathLossFit

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
    from ccatp.radio.path_loss_fit import CalibrationError, fit_path_loss
    from ccatp.radio_data.levels import read_levels

    table = read_levels(path, sheet, points)
    try:
        fit = fit_path_loss(table.pairs)
    except CalibrationError as error:
        raise CalibrateError(f"{path}: {error}") from error
    warnings = [*table.warnings, *fit.doubts()]
    for warning in warnings:
        complain(f"warning: {warning}", 0)
    if figure_file is not None:
        from ccatp.pictures.level_figures import draw_path_loss

        draw_path_loss(fit, table.pairs, table.name, figure_file)
    if json_output:
        click.echo(json.dumps({"data": table.name, **fit_data(fit), "warnings": warnings}))
        return 0
    _tell_fit(table.name, fit)
    return 0


def fit_data(fit: "PathLossFit") -> dict[str, Any]:
    """A calibration as JSON says it."""
    reference, exponent = fit.half_widths(CONFIDENCE)
    low, high = fit.sigma_interval_db(CONFIDENCE)
    is_repeated = fit.white_sigma_db == fit.white_sigma_db  # not NaN
    return {
        "reference_dbm": round(fit.reference_dbm, 4),
        "reference_half_width_db": round(reference, 4),
        "exponent": round(fit.exponent, 5),
        "exponent_half_width": round(exponent, 5),
        "sigma_db": round(fit.sigma_db, 4),
        "sigma_low_db": round(low, 4),
        "sigma_high_db": round(high, 4),
        "white_sigma_db": round(fit.white_sigma_db, 4) if is_repeated else None,
        "shadowing_sigma_db": round(fit.shadowing_sigma_db, 4) if is_repeated else None,
        "range_log_sigma": round(fit.path_loss.log_sigma, 5),
        "confidence": CONFIDENCE,
        "places": fit.places,
        "readings": fit.readings,
    }


def _tell_fit(name: str, fit: "PathLossFit") -> None:
    found = fit_data(fit)
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
