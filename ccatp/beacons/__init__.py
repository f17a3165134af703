"""Indoor robots among beacons: radio SLAM, ultrasonic self-mapping, missions and driving.

``mission`` runs a mission, ``estimation`` and ``cricket`` estimate, ``datasets`` reads recordings. For analysis in
Python: ``slam`` estimates a recording.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ccatp.beacons.analysis import slam as slam

__all__ = ["slam"]


def __getattr__(name: str) -> Any:
    if name != "slam":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from ccatp.beacons.analysis import slam  # noqa: PLC0415 - estimators and readers are imported when they are used

    return slam
