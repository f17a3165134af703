"""The topics of robots among beacons."""

from ccatp.links.topics import Message, Reached, Topic, TrackBatch, TruthBatch


class BeaconTrack(TrackBatch):
    """A batch of estimates of a robot among beacons, in the frame of its start.

    Rows: seq, t_s, x_m, y_m, heading_rad; covariance of these: xx, xy, yy, xh, yh, hh; dead reckoning: x_m, y_m.
    """

    rows: list[tuple[int, float, float, float, float, float, float, float, float, float, float, float, float]]


BeaconEllipse = tuple[float, float, float, float, float]


class BeaconMapMessage(Message):
    """The map of a robot among beacons, for displays and reports; m. An ellipse is x, y, and covariance xx, xy, yy."""

    system: str
    pose: tuple[float, float, float]
    pose_ellipse: BeaconEllipse
    beacons: dict[str, BeaconEllipse]  # each radio or mote on the map
    target: BeaconEllipse | None  # the radio that is followed; None before it was received
    obstacles: list[tuple[float, float]]  # points of the room that the distance sensors measured recently
    waypoints: list[tuple[float, float]]
    next_waypoint: int  # number of the current waypoint from 0, -1 for none
    distances: list[float]
    nis_sum: float  # of all readings so far
    nis_size: int  # their degrees of freedom
    refused: int  # readings that the gate refused
    notes: dict[str, float]  # of the mission about the map: phases, expected errors
    used: int = 0  # readings that the gate accepted; older recordings lack it


class BeaconArrival(Reached):
    """A waypoint was reached by the estimate: its number and the lap, both from 0, its position, the estimate."""

    waypoint: int
    lap: int
    place: tuple[float, float]
    estimate: BeaconEllipse


class BeaconTruth(TruthBatch):
    """A batch of simulated truth of a robot among beacons (simulation only).

    Rows: seq, t_s, x_m, y_m, heading_rad; the moving radio: x_m, y_m; clearance of the body to the nearest obstacle, m.
    """

    rows: list[tuple[int, float, float, float, float, float | None, float | None, float | None]]


class BeaconPlaces(Message):
    """True positions of radios and motes (simulation only), m."""

    places: dict[str, tuple[float, float]]


TOPICS = (
    Topic("beacon_track", BeaconTrack, "main", 1.0, 0.0, True),
    Topic("beacon_map", BeaconMapMessage, "main", 2.0, 2.0, True),
    Topic("beacon_arrival", BeaconArrival, "main", 0.0, 0.0, True),
    Topic("beacon_places", BeaconPlaces, "dataloop", 0.0, 0.0, True),
    Topic("beacon_truth", BeaconTruth, "dataloop", 1.0, 0.0, True),
)
