"""Pure. What gave the danger loop cause, as one phrase for operators: what, where, how much, and the limit."""

# By the signal; whatever is stale or missing has an age. A signal that stands for several quantities has none.
_UNITS = {
    "estimate": "s",
    "sensors": "s",
    "enc": "s",
    "frames": "s",
    "clock": "s",
    "latency": "s",
    "radio": "s",
    "encoders": "m/s",
    "imu_wz": "rad/s",
    "position": "m",
}


def danger_text(cause: str, signal: str, value: float, limit: float) -> str:
    """``estimate stale: 0.31 s (limit 0.15 s)``.

    Args:
        cause: why, in one short phrase.
        signal: what gave cause; it is named where the cause does not.
        value, limit: in the unit of the signal; a limit of 0 is none.
    """
    named = signal.replace("_", " ")
    where = "" if not named or named in cause or signal.startswith("emergency") else f" ({named})"
    if not limit:
        return cause + where
    is_age = cause.startswith("no ") or "stale" in cause
    unit = "s" if is_age else _UNITS.get(signal, "")
    told, bound = (f"{number:.4g} {unit}".rstrip() for number in (value, limit))
    # Of what was never there the age is put at the limit.
    return f"{cause}{where}: " + (f"limit {bound}" if told == bound else f"{told} (limit {bound})")
