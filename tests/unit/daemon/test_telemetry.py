"""Publications of the main loop: frames, fixes, display state."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import structlog
import zmq

from ccatp.config.models import Config
from ccatp.core import DeckPose, Fix, PanelId, PanelPose
from ccatp.daemon.telemetry import BATCH_FRAMES, SurveyTelemetry
from ccatp.links.bus import Publisher, Subscriber
from ccatp.links.topics import DisplayState, FixMessage, Message, MissionStatus, SensorLines, TrackMessage
from ccatp.localizer import Localizer, build_localizer
from ccatp.mirror.mirror import build_mirror


class Listener:
    """Takes what is published."""

    def __init__(self) -> None:
        self.received: list[tuple[str, Message]] = []

    def send(self, name: str, message: Message) -> None:
        self.received.append((name, message))

    def of(self, name: str) -> list[Any]:
        return [message for topic, message in self.received if topic == name]


def survey_telemetry() -> tuple[SurveyTelemetry, Listener]:
    listener = Listener()
    return SurveyTelemetry(cast(Publisher, listener), structlog.get_logger()), listener


def localizer() -> Localizer:
    pose = PanelPose(PanelId(1, 2), 0.1, 0.2, 0.3)
    return cast(Localizer, SimpleNamespace(pose=pose, deck_pose=DeckPose(0.0, 0.0, 0.0), position_sigma_m=1e-3))


def test_a_frame_that_is_not_newer_is_recorded_without_an_estimate() -> None:
    telemetry, listener = survey_telemetry()
    telemetry.publish_frame(7, 1.0, localizer(), "driving", b'{"seq":7}')
    telemetry.stale_frame(8, b'{"seq":8}')
    telemetry.publish_frame(9, 1.01, localizer(), "driving", b'{"seq":9}')
    telemetry.flush()
    (lines,), (track,) = listener.of("sensors"), listener.of("track")
    assert isinstance(lines, SensorLines)
    assert isinstance(track, TrackMessage)
    assert [msgspec.json.decode(line)["seq"] for line in lines.lines] == [7, 8, 9]
    assert [row[0] for row in track.rows] == [7, 9]


def test_stale_frames_alone_are_no_batch_of_estimates() -> None:
    telemetry, listener = survey_telemetry()
    for seq in range(BATCH_FRAMES):
        telemetry.stale_frame(seq, b"{}")
    assert len(listener.of("sensors")) == 1
    assert not listener.of("track")
    assert not listener.of("timing")


def test_a_fix_belongs_behind_the_last_frame_whatever_it_was() -> None:
    telemetry, listener = survey_telemetry()
    telemetry.publish_frame(7, 1.0, localizer(), "measuring", b"{}")
    telemetry.stale_frame(8, b"{}")
    telemetry.publish_fix(None, Fix(1.0, (0.0, 0.0, 0.0), (0.0,) * 9, 1.0, (1,), 0.0), 0.0, is_fused=False)
    (fix,) = listener.of("fix")
    assert isinstance(fix, FixMessage)
    assert (fix.seq, fix.is_fused) == (8, False)


LINE = b'{"type":"sensors"}'
STATUS = MissionStatus(seq=1, t_s=0.1, state="driving")


def test_a_display_state_for_a_subscriber_only(config: Config, tmp_path: Path) -> None:
    mirror = build_mirror(config.mirror)
    localizer = build_localizer(config, mirror)
    endpoint = f"ipc://{tmp_path}/main"
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    publisher = Publisher(context, endpoint)
    telemetry = SurveyTelemetry(publisher, structlog.get_logger())
    subscriber = Subscriber(context, [endpoint], ["display_state"], keeps_newest=True)
    try:
        while not publisher.has_subscriber("display_state"):
            pass
        telemetry.publish_status(STATUS)  # before the first frame
        for seq in (2, 3):
            telemetry.publish_frame(seq, 0.1 * seq, localizer, "driving", LINE)
            telemetry.publish_status(STATUS)
        received = subscriber.receive(5.0)
        while received is not None and isinstance(received[1], DisplayState) and received[1].seq < 3:
            received = subscriber.receive(5.0)
        assert received is not None
        state = received[1]
        assert isinstance(state, DisplayState)
        base = mirror.base_pose
        assert (state.x_m, state.y_m) == (base.x_m, base.y_m)
        assert bytes(state.line) == LINE
        assert state.covariance_m2[0] > 0.0
        subscriber.close()
        while publisher.has_subscriber("display_state"):
            pass
        telemetry.publish_status(STATUS)  # without a subscriber nothing is put together
    finally:
        subscriber.close()
        publisher.close()
        context.destroy(linger=0)
