"""Pure. A calibration as values of the configuration, as lines for the reader, as JSON."""

from math import floor, log10
from typing import Any, NamedTuple

from ccatp.calibrating.estimate import Calibration, CalibrationError
from ccatp.config.models import Config

# The daemon refuses a robot whose own figures differ from the configuration by more than this.
MOST_DIFFERENCE = 0.05
# Less certain than this, a new value would be worse than a measuring tape's.
MOST_SIGMA = 0.01
SHOWN_SLIP = 1e-4


class Row(NamedTuple):
    """One key of the configuration.

    Attributes:
        key: dotted.
        configured, found, sigma: in the unit of the key.
    """

    key: str
    configured: float
    found: float
    sigma: float

    @property
    def rounded(self) -> float:
        """The value found, to a tenth of its standard deviation."""
        return round(self.found, 1 - floor(log10(self.sigma)))


def rows(cfg: Config, found: Calibration) -> tuple[Row, Row, Row]:
    """What is configured and what the drive shows."""
    radius, base, bias = found.sigmas
    return (
        Row("robot.wheel_radius_m", cfg.robot.wheel_radius_m, found.radius_m, radius),
        Row("robot.wheel_base_m", cfg.robot.wheel_base_m, found.base_m, base),
        Row("localizer.gyroscope_bias_rad_s", cfg.localizer.gyroscope_bias_rad_s, found.bias_rad_s, bias),
    )


def check_usable(table: tuple[Row, ...]) -> None:
    """Refuse what must not get into a configuration.

    Raises:
        CalibrationError: a length is too uncertain, or far from what is configured.
    """
    for row in table[:2]:
        if row.sigma > MOST_SIGMA * row.found:
            raise CalibrationError(
                f"{row.key}: {row.found:.6g} +- {row.sigma:.2g} is no better than a measuring tape; "
                "drive more rounds (--rounds), or find out why the wheels slip"
            )
        if abs(row.found - row.configured) > MOST_DIFFERENCE * row.configured:
            raise CalibrationError(
                f"{row.key}: the drive shows {row.found:.6g}, {row.configured:.6g} is configured, more than "
                f"{MOST_DIFFERENCE:.0%} apart: another robot, or a wheel that is not in order; nothing is written"
            )


def lines(table: tuple[Row, ...], found: Calibration) -> list[str]:
    """For the reader."""
    shown = [("key", "configured", "found", "sigma", "off by")]
    for row in table:
        off = (row.found - row.configured) / row.sigma
        shown.append((row.key, f"{row.configured:.6g}", f"{row.found:.7g}", f"{row.sigma:.2g}", f"{off:+.1f} sigma"))
    widths = [max(len(one[i]) for one in shown) for i in range(5)]
    text = [
        "  ".join([one[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(one[1:], widths[1:], strict=True))])
        for one in shown
    ]
    difference, sigma = 1e3 * found.radius_difference_m, 1e3 * found.radius_difference_sigma_m
    scale, scale_sigma = 100.0 * found.gyro_scale, 100.0 * found.gyro_scale_sigma
    slip = f", slip varies by {100.0 * found.slip_sigma:.2g} % from motion to motion"
    return [
        *text,
        f"right wheel larger than left by {difference:.4f} +- {sigma:.4f} mm; "
        f"gyroscope reads {scale:+.2f} +- {scale_sigma:.2f} % too much; "
        f"downhill drift {100.0 * found.creep:.2f} +- {100.0 * found.creep_sigma:.2f} % of the way",
        f"{found.segments} legs, chi2 {found.chi2:.1f} at {found.degrees} degrees of freedom"
        f"{slip if found.slip_sigma > SHOWN_SLIP else ''}",
    ]


def as_json(table: tuple[Row, ...], found: Calibration) -> dict[str, Any]:
    """For ``--json``."""
    return {
        "parameters": {
            row.key: {"configured": row.configured, "found": row.found, "sigma": row.sigma} for row in table
        },
        "covariance": found.covariance.tolist(),
        "radius_difference_m": [found.radius_difference_m, found.radius_difference_sigma_m],
        "gyroscope_scale": [found.gyro_scale, found.gyro_scale_sigma],
        "creep": [found.creep, found.creep_sigma],
        "slip_sigma": found.slip_sigma,
        "chi2": found.chi2,
        "degrees": found.degrees,
        "segments": found.segments,
    }
