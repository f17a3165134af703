"""Export of a recording and its replay as a ROS 2 bag: one message for each sample, stamps in UTC, SI units.

Frames are named as in REP 105, axes as in REP 103: ``map`` is the deck frame, ``base_link`` the robot (x ahead, y left,
z along the normal, origin on the surface). The parent of ``map`` is ``world``, the frame of the laser system.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from math import nan
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.stores import ros2_jazzy as ros

from ccatp.config.models import Config
from ccatp.core import Corner, DeckPose, FloatArray, PanelId, PanelPose, Severity
from ccatp.kinematics import twist_of
from ccatp.links.bus_codec import BadMessage
from ccatp.links.robot_codec import BadLine, decode_from_robot
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import DangerEvent, FixMessage, MissionStatus, SensorLines, TrackMessage, TruthMessage
from ccatp.mirror.mirror import Mirror
from ccatp.records.recorder import decode_recorded
from ccatp.records.run_reader import Event, Fixed, Recording, in_order
from ccatp.records.timeline import Timeline, iter_places
from ccatp.report.foxglove import deck_in_world, quaternion
from ccatp.studies.replay import replay

WORLD, MAP, BASE_LINK, IMU_LINK, PUCK_LINK = "world", "map", "base_link", "imu_link", "puck_link"
WHEELS = ["wheel_right", "wheel_left"]
# Variance for axes that are not measured; drivers of wheeled robots use the same convention.
NOT_MEASURED = 1e6
_NO_TIME = QosTime(0, 0)
_LATCHED = Qos(
    QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, _NO_TIME, _NO_TIME,
    QosLiveliness.AUTOMATIC, _NO_TIME, False,
)  # fmt: skip
_UPRIGHT = ros.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.0, 1.0)
_PLANE = np.ix_((0, 1, 5), (0, 1, 5))  # x, y and heading among the six rows of a pose's covariance
_NS = 1_000_000_000
_Vector = ros.geometry_msgs__msg__Vector3


# From the wheels: speed and turn rate (m/s, rad/s), and their variances including slip.
_Motion = tuple[float, float, float, float]
_UNKNOWN: _Motion = nan, nan, NOT_MEASURED, NOT_MEASURED


def write_bag(folder: Path, recording: Recording, cfg: Config, mirror: Mirror) -> dict[str, int]:
    """Write a new bag in MCAP, and return the number of messages of each topic.

    Poses are the recorded ones; a replay recomputes their covariances. Defects are added to the warnings of the
    recording. Raises OSError: the folder cannot be written.
    """
    motions: dict[int, _Motion] = {}
    trace = replay(cfg, mirror, _with_motions(in_order(recording.messages()), cfg, motions)).trace
    covariances = {} if trace.covariance is None else dict(zip(trace.seq.tolist(), trace.covariance, strict=True))
    timeline, types = recording.timeline, get_typestore(Stores.ROS2_JAZZY)
    export = _Export(cfg, mirror, timeline, covariances, motions)
    connections: dict[str, Connection] = {}
    writer = Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP)  # which ROS 2 Humble and later read
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        for topic, stamp_ns, message in export.messages(recording):
            kind = message.__msgtype__
            if topic not in connections:
                qos = [_LATCHED] if topic == "/tf_static" else []
                connections[topic] = writer.add_connection(topic, kind, typestore=types, offered_qos_profiles=qos)
            writer.write(connections[topic], stamp_ns, types.serialize_cdr(message, kind))
    return {topic: writer.counts[one.id] for topic, one in sorted(connections.items())}


def _with_motions(events: Iterable[Event], cfg: Config, motions: dict[int, _Motion]) -> Iterator[Event]:
    """Pass the events through, and store the motion by the wheels for each frame."""
    robot, noise = cfg.robot, cfg.localizer
    slip, unequal = noise.full_state.slip_sigma, noise.full_state.slip_difference_sigma
    for event in events:
        enc = [] if isinstance(event, Fixed) else event.sensors.enc
        rates = [(right, left) for _, right, left in enc if right is not None and left is not None]
        if rates and not isinstance(event, Fixed):
            right_rad_s, left_rad_s = np.mean(rates, axis=0).tolist()
            twist = twist_of(right_rad_s, left_rad_s, robot.wheel_radius_m, robot.wheel_base_m)
            of_wheel = (robot.wheel_radius_m * noise.encoder_sigma_rad_s) ** 2 / len(rates)
            along, across = (slip * twist.v_m_s) ** 2, (unequal * twist.v_m_s) ** 2
            of_rate = (across + 2.0 * of_wheel) / robot.wheel_base_m**2
            motions[event.number] = twist.v_m_s, twist.omega_rad_s, along + 0.5 * of_wheel, of_rate
        yield event


Stamped = tuple[str, float, Any]  # topic, mission time (s), message


class _Export:
    """Converts the messages of one recording."""

    def __init__(
        self,
        cfg: Config,
        mirror: Mirror,
        timeline: Timeline,
        covariances: Mapping[int, FloatArray],
        motions: Mapping[int, _Motion],
    ) -> None:
        self._cfg, self._mirror, self._covariances, self._motions = cfg, mirror, covariances, motions
        self._timeline, self._left_out = timeline, 0
        self._newest = -1  # number of the newest frame that is written
        self._stamped_s, self._stamp_ns = nan, 0  # the last time that was asked for, and its stamp

    def messages(self, recording: Recording) -> Iterator[tuple[str, int, Any]]:
        """Topic, stamp (ns) and message, in the order of recording."""
        converted: dict[str, Callable[[Any], Iterator[Stamped]]] = {
            "track": self._of_track,
            "truth": self._of_truth,
            "fix": self._of_fix,
            "mission": self._of_mission,
            "danger_event": self._of_danger,
        }
        has_begun, timeline = False, self._timeline
        for place, name, _, payload in iter_places(recording.path):
            if name not in converted and name != "sensors":
                continue
            with suppress(BadMessage, BadLine):  # already reported by the replay
                message = timeline.on_axis(place, decode_recorded(name, payload))
                if not has_begun:
                    has_begun = True
                    fixed = ros.tf2_msgs__msg__TFMessage([*self._fixed_frames(message.t_s)])
                    yield "/tf_static", self._ns(message.t_s), fixed
                found = self._of_lines(place, message) if name == "sensors" else converted[name](message)
                for topic, t_s, sample in found:
                    yield topic, self._ns(t_s), sample
        if timeline.utc_ns(0.0) is None:
            recording.warnings.append(f"{recording.path}: an older format without UTC; stamps are of the robot's clock")
        if self._left_out:
            what = f"{self._left_out} samples have times that cannot be, and are not used"
            recording.warnings.append(f"{recording.path}: {what}")

    def _ns(self, t_s: float) -> int:
        if t_s != self._stamped_s:  # a message and its header have one time
            utc_ns = self._timeline.utc_ns(t_s)
            self._stamped_s, self._stamp_ns = t_s, round(t_s * _NS) if utc_ns is None else utc_ns
        return self._stamp_ns

    def _header(self, t_s: float, frame: str) -> Any:
        return ros.std_msgs__msg__Header(ros.builtin_interfaces__msg__Time(*divmod(self._ns(t_s), _NS)), frame)

    def _transform(self, t_s: float, parent: str, child: str, place: Sequence[float], turn: Any = _UPRIGHT) -> Any:
        moved = ros.geometry_msgs__msg__Transform(_Vector(*place), turn)
        return ros.geometry_msgs__msg__TransformStamped(self._header(t_s, parent), child, moved)

    def _fixed_frames(self, t_s: float) -> Iterator[Any]:
        origin, turn = deck_in_world(self._mirror)
        yield self._transform(t_s, WORLD, MAP, origin, turn)
        robot = self._cfg.robot
        edges = {f"edge_{c}_link": (*place, 0.0) for c, place in zip(Corner, robot.edge_sensors_m, strict=True)}
        links = {IMU_LINK: (0.0, 0.0, 0.0), PUCK_LINK: (0.0, 0.0, robot.puck_height_m), **edges}
        for name, place in links.items():
            yield self._transform(t_s, BASE_LINK, name, place)

    def _of_lines(self, place: int, message: SensorLines) -> Iterator[Stamped]:
        noise, none = self._cfg.localizer, np.empty(0)
        of_rate = np.diag((NOT_MEASURED, NOT_MEASURED, noise.gyroscope_sigma_rad_s**2)).ravel()
        ahead = np.diag((noise.accelerometer_sigma_m_s2**2, NOT_MEASURED, NOT_MEASURED)).ravel()
        no_orientation = np.array([-1.0, *[0.0] * 8])  # "not measured", by the definition of the message
        read = [decode_from_robot(bytes(line)) for line in message.lines]
        frames = [frame for frame in read if isinstance(frame, Sensors)]
        numbers = self._timeline.line_numbers(place, [frame.seq for frame in frames])
        for number, frame in zip(numbers, frames, strict=True):
            if number <= self._newest:
                continue  # received again
            self._newest = number
            for sample_s, ax_m_s2, wz_rad_s in frame.imu:
                t_s = self._sample_s(number, frame.t, sample_s)
                if t_s is None:
                    continue
                rate, acceleration = _Vector(0.0, 0.0, wz_rad_s), _Vector(ax_m_s2, 0.0, 0.0)
                header, of_turn = self._header(t_s, IMU_LINK), (_UPRIGHT, no_orientation)
                yield "/imu", t_s, ros.sensor_msgs__msg__Imu(header, *of_turn, rate, of_rate, acceleration, ahead)
            for sample_s, *rates_rad_s in frame.enc:
                t_s = self._sample_s(number, frame.t, sample_s)
                if t_s is None:
                    continue
                velocity = np.array([nan if rate is None else rate for rate in rates_rad_s])
                wheels = ros.sensor_msgs__msg__JointState(self._header(t_s, ""), WHEELS, none, velocity, none)
                yield "/joint_states", t_s, wheels

    def _sample_s(self, number: int, frame_s: float, sample_s: float) -> float | None:
        t_s = self._timeline.sample_s(number, frame_s, sample_s)
        self._left_out += t_s is None
        return t_s

    def _of_track(self, message: TrackMessage) -> Iterator[Stamped]:
        unknown = np.diag([NOT_MEASURED] * 3)
        for number, t_s, row, col, x_m, y_m, heading_rad, _ in message.rows:
            pose = self._mirror.deck_pose(PanelPose(PanelId(row, col), x_m, y_m, heading_rad))
            covariance, motion = self._covariances.get(number, unknown), self._motions.get(number, _UNKNOWN)
            odometry = self._odometry(t_s, pose, covariance, motion)
            yield "/odom", t_s, odometry
            here = odometry.pose.pose
            place = here.position.x, here.position.y, here.position.z
            moved = self._transform(t_s, MAP, BASE_LINK, place, here.orientation)
            yield "/tf", t_s, ros.tf2_msgs__msg__TFMessage([moved])

    def _of_truth(self, message: TruthMessage) -> Iterator[Stamped]:
        for _, t_s, x_m, y_m, heading_rad, *_ in message.rows:
            pose = DeckPose(x_m, y_m, heading_rad)
            yield "/ground_truth/odom", t_s, self._odometry(t_s, pose, np.zeros((3, 3)), _UNKNOWN)

    def _odometry(self, t_s: float, pose: DeckPose, covariance: FloatArray, motion: _Motion) -> Any:
        """Variances of height, roll and pitch are 0, since the surface gives them; also those of other velocities."""
        place = ros.geometry_msgs__msg__Point(*self._mirror.surface_point(pose.x_m, pose.y_m))
        turn = quaternion(self._mirror.robot_axes(pose))
        of_pose, of_twist = np.zeros((6, 6)), np.zeros((6, 6))
        of_pose[_PLANE] = covariance
        v_m_s, omega_rad_s, of_twist[0, 0], of_twist[5, 5] = motion
        speeds = _Vector(v_m_s, 0.0, 0.0), _Vector(0.0, 0.0, omega_rad_s)
        return ros.nav_msgs__msg__Odometry(
            self._header(t_s, MAP),
            BASE_LINK,
            ros.geometry_msgs__msg__PoseWithCovariance(ros.geometry_msgs__msg__Pose(place, turn), of_pose.ravel()),
            ros.geometry_msgs__msg__TwistWithCovariance(ros.geometry_msgs__msg__Twist(*speeds), of_twist.ravel()),
        )

    def _of_fix(self, message: FixMessage) -> Iterator[Stamped]:
        covariance = np.diag([NOT_MEASURED] * 6)
        covariance[:3, :3] = np.reshape(message.covariance_m2, (3, 3))
        pose = ros.geometry_msgs__msg__Pose(ros.geometry_msgs__msg__Point(*message.position_m), _UPRIGHT)
        known = ros.geometry_msgs__msg__PoseWithCovariance(pose, covariance.ravel())
        header = self._header(message.t_s, WORLD)
        yield "/laser/position", message.t_s, ros.geometry_msgs__msg__PoseWithCovarianceStamped(header, known)

    def _of_mission(self, message: MissionStatus) -> Iterator[Stamped]:
        yield self._diagnosis(message, "mission", message.state, {
            f"alarm {one.name}": (Severity[one.severity.upper()], one.cause) for one in message.alarms if not one.ended
        })  # fmt: skip

    def _of_danger(self, message: DangerEvent) -> Iterator[Stamped]:
        found = {f"danger {name}": (Severity(severity), cause) for name, cause, severity in message.active}
        yield self._diagnosis(message, "danger", message.cause or "ok", found)

    def _diagnosis(
        self, message: MissionStatus | DangerEvent, name: str, text: str, causes: Mapping[str, tuple[Severity, str]]
    ) -> Stamped:
        """Diagnostics of a message with its plain fields, and of each cause.

        OK if it is only reported, WARN if the robot continues by itself, else ERROR.
        """
        facts = {k: str(v) for k, v in msgspec.structs.asdict(message).items() if isinstance(v, str | int | float)}
        statuses = [
            ros.diagnostic_msgs__msg__DiagnosticStatus(
                int(severity > Severity.INFORM) + int(severity > Severity.PAUSE), f"ccatp: {what}", cause, "",
                [ros.diagnostic_msgs__msg__KeyValue(*fact) for fact in facts.items() if what == name],
            )
            for what, (severity, cause) in {name: (Severity(message.severity), text), **causes}.items()
        ]  # fmt: skip
        return (
            "/diagnostics",
            message.t_s,
            ros.diagnostic_msgs__msg__DiagnosticArray(self._header(message.t_s, ""), statuses),
        )
