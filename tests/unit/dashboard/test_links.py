"""What is lost, in virtual time."""

import pytest

from ccatp.links.topics import Heartbeat, MissionStatus
from ccatp.report.dashboard.view import Links


def presence(process: str, t_s: float, *, pid: int = 1, phase: str = "joined", age_s: float | None = 0.01) -> Heartbeat:
    return Heartbeat(seq=0, t_s=t_s, process=process, pid=pid, phase=phase, frame_age_s=age_s)


def status(exit_status: int) -> MissionStatus:
    return MissionStatus(
        seq=1, t_s=0.0, state="done", cause="", done=0, skipped=0, total=9, point="", elapsed_s=0.0, eta_s=0.0,
        error_mm=0.0, code=0, outcome="", lower_bound_s=0.0, exit_status=exit_status,
    )  # fmt: skip


@pytest.fixture
def links() -> Links:
    links = Links()
    links.presence(presence("main", 10.0))
    links.presence(presence("danger", 10.0))
    return links


def whats(links: Links, now_s: float) -> list[str]:
    return [loss.what for loss in links.losses(now_s)]


def test_before_anybody_spoke_nothing_is_lost_but_it_is_not_well() -> None:
    links = Links()
    assert links.losses(10.0) == []
    assert links.trouble(10.0) == "main was never heard of"
    assert [link.phase for link in links.shown(10.0)] == [
        "no heartbeat yet",
        "no heartbeat yet",
        "no frame yet",
        "no fix yet",
    ]


def test_all_is_well(links: Links) -> None:
    assert links.losses(10.1) == []
    assert links.trouble(10.1) == ""
    links.fix_s = 9.0
    shown = {link.name: link for link in links.shown(10.1)}
    assert all(link.is_well for link in shown.values())
    assert shown["robot"].age_s == pytest.approx(0.11)
    assert shown["laser"].age_s == pytest.approx(1.1)


def test_a_loop_that_says_nothing(links: Links) -> None:
    links.presence(presence("danger", 10.9))
    assert whats(links, 10.95) == []
    assert whats(links, 11.05) == ["the main loop has not reported"]
    assert links.trouble(11.05) == "the main loop has not reported for 1.1 s"
    assert whats(links, 12.0) == ["the main loop has not reported", "the danger loop has not reported"]


def test_pictures_that_were_wanted_and_do_not_come_show_it_sooner(links: Links) -> None:
    links.picture(10.0)
    assert whats(links, 10.75) == []
    assert whats(links, 10.85) == ["the main loop has not reported"]
    links.look_away()
    assert whats(links, 10.85) == []


def test_a_loop_that_is_gone_shows_at_once_and_until_another_one_speaks(links: Links) -> None:
    links.cut("main", 10.2)
    assert str(links.losses(10.3)[0]) == "the main loop is gone for 0.1 s"
    links.cut("main", 10.3)
    links.presence(presence("main", 10.15))  # one of its last words, which was on its way
    assert links.losses(10.7)[0].for_s == pytest.approx(0.5)
    links.picture(10.1)
    links.presence(presence("main", 11.0, pid=2, phase="starting", age_s=None))
    assert links.losses(11.0) == []
    assert links.restarts == {"main": 1, "danger": 0}


def test_a_connection_that_came_back_is_no_loss(links: Links) -> None:
    links.cut("danger", 10.2)
    links.presence(presence("danger", 10.4))
    assert links.losses(10.45) == []
    assert links.restarts["danger"] == 0


def test_the_robot_is_away(links: Links) -> None:
    links.presence(presence("main", 10.5, phase="rejoining", age_s=0.5))
    links.presence(presence("danger", 10.5))
    assert whats(links, 10.6) == ["the robot has been away"]
    assert not next(link for link in links.shown(10.6) if link.name == "robot").is_well


def test_the_robot_sends_nothing(links: Links) -> None:
    links.presence(presence("main", 11.0, age_s=0.95))
    links.presence(presence("danger", 11.0))
    assert whats(links, 11.04) == []
    assert whats(links, 11.1) == ["the robot has sent no frame"]


def test_after_the_end_nothing_is_lost(links: Links) -> None:
    links.status(status(-1))
    assert whats(links, 20.0) != []
    links.status(status(0))
    assert links.losses(20.0) == []
    assert links.trouble(20.0) == ""
