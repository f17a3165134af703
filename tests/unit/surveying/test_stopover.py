"""From the end of a leg to the request for a measurement."""

import pytest

from ccatp.config.models import Config
from ccatp.core import PanelId, PanelPose, PointId
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.survey.route_follower import StateEstimate
from ccatp.survey.stops import SETTLE_LIMIT_S, SettleAndMeasure

DT, MEASURING_S = 0.01, 0.5
POINT = PointId(5, 5, 1)


@pytest.fixture(scope="module")
def mirror(config: Config) -> Mirror:
    return build_mirror(config.mirror)


@pytest.fixture
def stopover(config: Config) -> SettleAndMeasure:
    return SettleAndMeasure(config.control, MEASURING_S)


def at(mirror: Mirror, frame: int, speed_m_s: float = 0.0) -> StateEstimate:
    return StateEstimate(frame * DT, DT, PanelPose(PanelId(5, 5), 0.0, 0.0, 0.0), mirror.deck_pose, speed_m_s, 0.0)


def test_asks_once_and_only_after_the_measuring_time_at_rest(stopover: SettleAndMeasure, mirror: Mirror) -> None:
    settled = next(k for k in range(100) if stopover.has_settled(at(mirror, k)))
    asked = [k for k in range(settled, settled + 200) if stopover.is_due(at(mirror, k))]
    assert asked == [settled + round(MEASURING_S / DT)]
    assert (stopover.request, stopover.is_asked) == (1, True)


def test_an_interrupted_stop_begins_anew_and_asks_again(stopover: SettleAndMeasure, mirror: Mirror) -> None:
    for k in range(2):
        settled = next(j for j in range(1000 * k, 1000 * k + 100) if stopover.has_settled(at(mirror, j)))
        assert any(stopover.is_due(at(mirror, j)) for j in range(settled, settled + 60))
        stopover.interrupt()
        assert not stopover.is_asked
    assert stopover.request == 2


def test_the_measuring_time_begins_anew_where_the_robot_moves_once_more(
    stopover: SettleAndMeasure, mirror: Mirror
) -> None:
    settled = next(k for k in range(100) if stopover.has_settled(at(mirror, k)))
    moves = range(settled + 20, settled + 30)
    asked = [k for k in range(settled, settled + 200) if stopover.is_due(at(mirror, k, speed_m_s=0.01 * (k in moves)))]
    assert len(asked) == 1
    assert asked[0] > moves[-1] + round(MEASURING_S / DT)  # the mean speed takes its time to forget the motion


@pytest.mark.fault("E9")
def test_who_moves_for_ever_is_never_measured_and_restless(stopover: SettleAndMeasure, mirror: Mirror) -> None:
    settled = next(k for k in range(100) if stopover.has_settled(at(mirror, k)))
    frames = range(settled + 1, settled + 2000)
    assert [k for k in frames if stopover.is_due(at(mirror, k, speed_m_s=0.01))] == []
    limit = settled + round(SETTLE_LIMIT_S / DT)
    assert not stopover.is_restless((limit - 1) * DT)
    assert stopover.is_restless((limit + 1) * DT)


@pytest.mark.fault("E9")
def test_a_measurement_during_which_the_robot_moves_is_not_wanted(stopover: SettleAndMeasure, mirror: Mirror) -> None:
    settled = next(k for k in range(100) if stopover.has_settled(at(mirror, k)))
    asked = next(k for k in range(settled, settled + 200) if stopover.is_due(at(mirror, k)))
    assert not stopover.is_due(at(mirror, asked + 1))
    assert stopover.is_asked
    stopover.is_due(at(mirror, asked + 2, speed_m_s=0.01))
    assert not stopover.is_asked
    again = next(k for k in range(asked + 3, asked + 400) if stopover.is_due(at(mirror, k)))
    assert again > asked + 2 + round(MEASURING_S / DT)
    assert stopover.request == 2


def test_who_never_rests_is_restless_after_the_limit(stopover: SettleAndMeasure, mirror: Mirror) -> None:
    frames = round(SETTLE_LIMIT_S / DT)
    for k in range(frames):
        assert not stopover.has_settled(at(mirror, k, speed_m_s=0.01))
    assert not stopover.is_restless((frames - 1) * DT)
    assert stopover.is_restless((frames + 1) * DT)


def test_a_point_is_arrived_at_once(stopover: SettleAndMeasure) -> None:
    assert stopover.arrival_at(POINT) == POINT
    assert stopover.arrival_at(None) is None  # a fix that finds the robot again is no arrival
    assert stopover.arrival_at(POINT) is None
    assert stopover.arrival_at(POINT._replace(point=2)) == POINT._replace(point=2)
