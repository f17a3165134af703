"""THE limits of a robot at the robot link (interface control document 1), for every client, server and configuration.

With a value beyond them no mission can work, or the robot could not be stopped in time. Clients refuse such a robot
before anything moves, servers and configurations cannot have it, and ``ccatp conformance`` reports it.
"""

from typing import Annotated, NamedTuple

from pydantic import Field


class Limits(NamedTuple):
    """Lowest and highest value, both allowed."""

    low: float
    high: float

    def problem(self, name: str, value: float, unit: str = "") -> str | None:
        """What is wrong with a value, ``None`` if it is within the limits."""
        if self.low <= value <= self.high:
            return None
        return f"{name} is {value:.4g}{unit}, the robot link allows {self.low:g} to {self.high:g}{unit}"


WHEEL_RADIUS_M = Limits(0.005, 0.2)
WHEEL_BASE_M = Limits(0.03, 1.0)
TOP_SPEED_M_S = Limits(0.02, 1.0)
TTL_S = Limits(0.05, 1.0)
FRAME_HZ = Limits(20.0, 200.0)
# A robot with a vehicle drives on a floor, and may map while it drives: an iteration for each frame.
VEHICLE_FRAME_HZ = Limits(10.0, 200.0)

# Of a hello; ``top speed`` is max_wheel_rad_s * wheel_radius_m.
LIMITS = {
    "ttl_s": (TTL_S, "s"),
    "frame_hz": (FRAME_HZ, "Hz"),
    "frame_hz, with a vehicle": (VEHICLE_FRAME_HZ, "Hz"),
    "wheel_radius_m": (WHEEL_RADIUS_M, "m"),
    "wheel_base_m": (WHEEL_BASE_M, "m"),
    "top speed": (TOP_SPEED_M_S, "m/s"),
}

WheelRadius = Annotated[float, Field(ge=WHEEL_RADIUS_M.low, le=WHEEL_RADIUS_M.high)]
WheelBase = Annotated[float, Field(ge=WHEEL_BASE_M.low, le=WHEEL_BASE_M.high)]
TimeToLive = Annotated[float, Field(ge=TTL_S.low, le=TTL_S.high)]
FrameRate = Annotated[float, Field(ge=FRAME_HZ.low, le=FRAME_HZ.high)]
VehicleFramePeriod = Annotated[float, Field(ge=1.0 / VEHICLE_FRAME_HZ.high, le=1.0 / VEHICLE_FRAME_HZ.low)]


def top_speed_problem(wheel_radius_m: float, max_wheel_rad_s: float) -> str | None:
    """What is wrong with the top speed, ``None`` if it is within its limits."""
    return TOP_SPEED_M_S.problem(
        "the top speed (max_wheel_rad_s * wheel_radius_m)", wheel_radius_m * max_wheel_rad_s, " m/s"
    )


def hello_problems(
    *,
    frame_hz: float,
    ttl_s: float,
    wheel_radius_m: float,
    wheel_base_m: float,
    max_wheel_rad_s: float,
    has_vehicle: bool,
) -> list[str]:
    """Every value of a hello that is beyond its limits."""
    rates_hz = VEHICLE_FRAME_HZ if has_vehicle else FRAME_HZ
    found = (
        rates_hz.problem("frame_hz", frame_hz, " Hz"),
        TTL_S.problem("ttl_s", ttl_s, " s"),
        WHEEL_RADIUS_M.problem("wheel_radius_m", wheel_radius_m, " m"),
        WHEEL_BASE_M.problem("wheel_base_m", wheel_base_m, " m"),
        top_speed_problem(wheel_radius_m, max_wheel_rad_s),
    )
    return [text for text in found if text is not None]
