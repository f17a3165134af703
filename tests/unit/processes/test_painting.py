"""Main puts a picture together for those who asked, and for nobody else."""

from pathlib import Path

import zmq

from ccatp.config.models import Config
from ccatp.daemon.telemetry import DisplayStatePublisher, localizer_pose
from ccatp.links.bus import Publisher, Subscriber
from ccatp.links.topics import DisplayState
from ccatp.localizer import build_localizer
from ccatp.mirror.mirror import build_mirror

LINE = b'{"type":"sensors"}'


def test_a_picture_for_a_subscriber_only(config: Config, tmp_path: Path) -> None:
    mirror = build_mirror(config.mirror)
    localizer = build_localizer(config, mirror)
    endpoint = f"ipc://{tmp_path}/main"
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    publisher = Publisher(context, endpoint)
    painter = DisplayStatePublisher(publisher, localizer_pose)
    subscriber = Subscriber(context, [endpoint], ["display_state"], keeps_newest=True)
    try:
        while not publisher.has_subscriber("display_state"):
            pass
        painter.publish_if_subscribed(1, 0.1)  # nothing is seen yet
        painter.update(localizer, LINE)
        painter.publish_if_subscribed(2, 0.2)
        painter.publish_if_subscribed(3, 0.3)
        received = subscriber.receive(5.0)
        while received is not None and isinstance(received[1], DisplayState) and received[1].seq < 3:
            received = subscriber.receive(5.0)
        assert received is not None
        picture = received[1]
        assert isinstance(picture, DisplayState)
        base = mirror.base_pose
        assert (picture.x_m, picture.y_m) == (base.x_m, base.y_m)
        assert bytes(picture.line) == LINE
        assert picture.covariance_m2[0] > 0.0
        subscriber.close()
        while publisher.has_subscriber("display_state"):
            pass
        painter.publish_if_subscribed(4, 0.4)  # nobody asked: nothing is sent, as the next subscriber finds
    finally:
        subscriber.close()
        publisher.close()
        context.destroy(linger=0)
