"""Pure. A long leg in parts: the stops between them are where the robot points itself at the next one anew."""

from math import ceil, hypot

from ccatp.samples import Stop, StopKind


def in_parts(x_m: float, y_m: float, stop: Stop, longest_m: float) -> list[Stop]:
    """The straight leg to a stop as equal parts, the stop itself the last.

    Args:
        x_m, y_m: where the leg begins, deck frame.
        stop: where it ends.
        longest_m: no part is longer.
    """
    dx, dy = stop.x_m - x_m, stop.y_m - y_m
    parts = max(1, ceil(hypot(dx, dy) / longest_m))
    between = (
        Stop(x_m + dx * k / parts, y_m + dy * k / parts, StopKind.VIA, reverse=stop.reverse) for k in range(1, parts)
    )
    return [*between, stop]
