"""The robot's own rules, and commands that wait on their way, in virtual time. Every test starts from "held"."""

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ccatp.onboard.rules import HELD, LinkedRobot, SlideMonitor

DT_S, TTL_S, FASTEST = 0.01, 0.25, 8.0
# A robot with nothing but roles and commands.
Bare = type("Bare", (LinkedRobot,), dict.fromkeys(LinkedRobot.__abstractmethods__))


class Rig:
    def __init__(self, frames: int = 0, ttl_s: float = TTL_S, floor: float = 0.0) -> None:
        self.robot: LinkedRobot = Bare((ttl_s, FASTEST, floor), DT_S, 1.0 / DT_S, frames)

    def moves(self, frame: int) -> bool:
        """Whether the wheels turn in the step after ``frame``."""
        self.at(frame)._release_commands()
        return self.robot.rules.set_points((frame + 1) * DT_S) != HELD

    def at(self, frame: int) -> LinkedRobot:
        self.robot.seq, self.robot.t_s = frame, frame * DT_S
        return self.robot


def slid_after_s(
    slide: tuple[float, float], gravity: tuple[float, float], *, noise_m_s2: float = 0.2, is_read: bool = True
) -> float | None:
    """A drive round a bend, then a body that is accelerated by (ahead, left) m/s^2 over its wheels: when it is found.

    Both accelerations are off by 0.3 m/s^2. ``is_read``: the left wheel.
    """
    monitor, rng = SlideMonitor((0.055, 0.04), 0.03, 0.15), random.Random(3)
    right_rad = left_rad = 0.0
    for k in range(200):
        t_s, is_sliding = DT_S * k, k > 100
        right_rad, left_rad = right_rad + 4.0 * DT_S, left_rad + 2.0 * DT_S  # 0.09 m/s, 0.4 rad/s: 0.036 m/s^2
        noise = [0.3 + noise_m_s2 * rng.gauss(0.0, 1.0) for _ in range(2)]
        ahead, left = slide if is_sliding else (0.0, 0.0)
        sample = t_s, noise[0] + ahead, 0.4, noise[1] + 0.036 + left
        if monitor.step(sample, (right_rad, left_rad if is_read else None), (t_s, *gravity, 0.3)):
            return t_s - 100 * DT_S
    return None


@pytest.mark.parametrize("angle_rad", [0.0, 1.0, 1.57, 2.5, -1.57])
@pytest.mark.parametrize("slide_m_s2", [2.2, 4.0])
def test_a_slide_downhill_is_found_in_any_direction(slide_m_s2: float, angle_rad: float) -> None:
    way = math.cos(angle_rad), math.sin(angle_rad)
    after_s = slid_after_s((slide_m_s2 * way[0], slide_m_s2 * way[1]), (0.9 * way[0], 0.9 * way[1]))
    assert after_s is not None
    assert 0.0 < after_s <= 0.05 + 1e-9


@pytest.mark.parametrize(
    ("slide", "gravity", "is_read"),
    [
        ((0.0, 0.0), (0.0, 0.9), True),
        ((0.0, -4.0), (0.0, 0.9), True),
        ((0.0, 4.0), (0.0, 0.1), True),
        ((0.0, 20.0), (0.0, 0.9), True),
        ((0.0, 4.0), (0.0, 0.9), False),
    ],
    ids=["a bend", "uphill", "on a level", "more than gravity: the sensor", "a wheel that is not read"],
)
def test_what_is_no_slide(slide: tuple[float, float], gravity: tuple[float, float], *, is_read: bool) -> None:
    assert slid_after_s(slide, gravity, is_read=is_read) is None


@pytest.mark.parametrize(
    ("drive", "needs"),
    [
        ((3.0, 3.0), "forward"),
        ((-3.0, -3.0), "reverse"),
        ((3.0, -3.0), "turn"),
        ((3.0, 2.0), "forward turn"),
        ((-3.0, 2.0), "reverse turn"),
        ((0.0, 1e-9), "forward turn"),
        ((0.0, 0.0), ""),
    ],
)
def test_directions(drive: tuple[float, float], needs: str) -> None:
    for bits in range(8):
        allowed = {name for k, name in enumerate(("forward", "reverse", "turn")) if bits >> k & 1}
        robot = Rig().robot
        robot.join("monitor")
        robot.drive(1, *drive)
        robot.permit(1, "forward" in allowed, "reverse" in allowed, "turn" in allowed)
        may = set(needs.split()) <= allowed
        assert robot.rules.set_points(0.01) == (drive if may else HELD)
        assert robot.rules.is_held is not may


def test_fans_keep_their_floor_and_their_duty() -> None:
    robot = Rig(floor=0.6).robot
    fans = robot.fans
    assert fans.duty == (0.6, 0.6)
    assert robot.command_fans(1, 0.0, 0.9)
    assert fans.duty == (0.6, 0.9)
    robot.join("controller")
    assert fans.duty == (0.6, 0.9)
    assert robot.command_fans(0, 2.0, 0.7)
    assert fans.duty == (1.0, 0.7)
    fans.health = (1.0, 0.0)
    assert fans.thrust == 0.5


EVENTS = st.one_of(
    st.tuples(st.just("drive"), st.integers(0, 20), st.floats(-20, 20), st.floats(-20, 20)),
    st.tuples(st.just("permit"), st.integers(0, 20), st.booleans(), st.booleans(), st.booleans()),
    st.tuples(st.sampled_from(["join", "lose"]), st.sampled_from(["controller", "monitor"])),
    st.tuples(st.just("wait"), st.floats(0.0, 0.3)),
)


@given(st.lists(EVENTS, max_size=40))
def test_wheels_turn_only_with_both_keys(events: list[tuple[object, ...]]) -> None:
    """Invariant I1 against a plain model that remembers the newest of each kind."""
    robot = Rig().robot
    r = robot.rules
    now, needs_permit = 0.0, False
    drive: tuple[int, float, float, float] | None = None
    permit: tuple[int, bool, bool, bool, float] | None = None
    drive_seq = permit_seq = -1
    for name, *args in events:
        if name == "wait":
            now += float(args[0])  # type: ignore[arg-type]
        elif name in ("drive", "permit"):
            getattr(robot, str(name))(*args, now_s=now)
            if name == "drive" and args[0] > drive_seq:  # type: ignore[operator]
                drive = (*args, now)  # type: ignore[assignment]
                drive_seq = args[0]  # type: ignore[assignment]
            elif name == "permit" and args[0] > permit_seq:  # type: ignore[operator]
                permit = (*args, now)  # type: ignore[assignment]
                permit_seq = args[0]  # type: ignore[assignment]
        else:
            getattr(robot, str(name))(*args)
            if args == ["controller"]:
                drive, drive_seq = None, -1
            else:
                permit, permit_seq = None, -1
                needs_permit |= name == "join"
        right, left = r.set_points(now + 0.01)
        assert max(abs(right), abs(left)) <= FASTEST * (1 + 1e-12)
        if (right, left) != HELD:
            assert drive is not None
            assert now + 0.01 - drive[3] <= TTL_S + 1e-8
            assert (right + left > 0) == (drive[1] + drive[2] > 0)
            if needs_permit:
                assert permit is not None
                assert now + 0.01 - permit[4] <= TTL_S + 1e-8
                assert permit[1] or right + left <= 0
                assert permit[2] or right + left >= 0
                assert permit[3] or right == left


def test_the_time_to_live_covers_the_delay() -> None:
    rig = Rig(2, ttl_s=0.05)
    rig.at(0).drive(1, 3.0, 3.0)
    assert [rig.moves(frame) for frame in range(8)] == [False, False, True, True, True, False, False, False]


@pytest.mark.parametrize("frames", [0, 2])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_commands_that_are_not_finite_are_dropped(frames: int, bad: float) -> None:
    robot = Rig(frames).robot
    assert not robot.drive(1, bad, 1.0)
    assert not robot.drive(1, 1.0, bad)
    assert not robot.command_fans(1, bad, 0.5)
    assert robot.drive(1, 1.0, 1.0)
    assert robot.command_fans(1, 0.5, 0.5)


def test_what_is_on_its_way_goes_with_its_session() -> None:
    rig = Rig(2)
    robot = rig.at(0)
    robot.join("monitor")
    robot.drive(10, 3.0, 3.0)
    robot.permit(10, True, True, True)
    robot.command_fans(10, 0.7, 0.7)
    robot.lose("controller")
    assert not any(rig.moves(frame) for frame in range(5))
    assert robot.fans.duty == (0.7, 0.7)  # fans are not changed by a lost session
    rig.at(5).join("controller")
    robot.drive(0, 3.0, 3.0)  # the next one counts again
    assert [rig.moves(frame) for frame in range(5, 8)] == [False, False, True]
    robot.permit(11, False, False, False)
    robot.lose("monitor")
    robot.rules.permit(True, True, True, 0.07)
    assert rig.moves(9)  # the denial never arrives
