"""Pure. Calibration against what was assumed of it: what no reading told, and what lies beyond its prior."""

from collections.abc import Iterator, Mapping

from ccatp.radio.track import Calibrated

FAR = 3.0
"""Standard deviations of the prior beyond which a value is told."""
UNCHANGED = 0.999
"""Of the prior's standard deviation: what is left of it where no reading told anything."""
KEYS = {"odometry_delay_s": "delay_s"}
"""Keys under ``priors`` that are called otherwise than the quantity."""


def learned(calibration: Mapping[str, Calibrated], priors: Mapping[str, float]) -> dict[str, Calibrated]:
    """Those that the readings told something of; a prior is no result.

    Args:
        calibration: by name.
        priors: standard deviations before any reading, by name.
    """
    return {name: found for name, found in calibration.items() if found.sigma < UNCHANGED * priors[name]}


def beyond_priors(calibration: Mapping[str, Calibrated], priors: Mapping[str, float], kind: str) -> Iterator[str]:
    """Values that their prior all but excludes, a line each: they would be further off still if it let them.

    Args:
        calibration: by name.
        priors: standard deviations before any reading, about zero, by name.
        kind: of the recording, as the configuration calls it.
    """
    for name, (value, _) in calibration.items():
        sigma = priors[name]
        if abs(value) > FAR * sigma:
            yield (
                f"{name} comes out as {value:+.3g}, {abs(value) / sigma:.1f} standard deviations of its prior: "
                f"if that can be, widen {kind}.priors.{KEYS.get(name, name)} (now {sigma:g})"
            )
