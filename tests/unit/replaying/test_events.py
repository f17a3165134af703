"""The order of what was recorded in batches and what was recorded at once."""

from ccatp.core import Fix
from ccatp.links.robot_messages import CommandEcho, Sensors
from ccatp.links.topics import FixMessage
from ccatp.records.run_reader import Event, Fixed, FixGiven, Marked, Message, Stood, fix_given, in_order


def frame(seq: int) -> Sensors:
    echo = CommandEcho(seq=-1, age=0.0, permit_age=0.0, held=False)
    return Sensors(seq, 0.01 * seq, [], [], [], None, (0.0, 0.0), 1.0, echo, [])


def fix(t_s: float) -> Fix:
    return Fix(t_s, (0.0, 0.0, 0.0), (1.0,) * 9, 1.0, (1, 2, 3), 0.0)


def told(messages: list[Message]) -> list[str]:
    def name(event: Event) -> str:
        if isinstance(event, Marked):
            return f"{event.sensors.seq}{' rests' if event.at_rest else ''}"
        return f"fix {event.fix.t_s:g}{'' if event.was_fused else ' refused'}"

    return [name(event) for event in in_order(messages)]


def test_a_fix_comes_behind_its_frame_wherever_it_was_recorded() -> None:
    given = FixGiven(1, fix(7.0), True)
    wanted = ["0", "1", "fix 7", "2", "3"]
    assert told([given, *map(frame, range(4))]) == wanted  # before the batch
    assert told([frame(0), frame(1), given, frame(2), frame(3)]) == wanted  # between two


def test_a_rest_comes_in_its_frame_and_before_the_fix_there() -> None:
    assert told([Stood(1), FixGiven(1, fix(7.0), True), *map(frame, range(3))]) == ["0", "1 rests", "fix 7", "2"]


def test_fixes_keep_their_order() -> None:
    messages: list[Message] = [FixGiven(0, fix(1.0), False), FixGiven(0, fix(2.0), True), frame(0), frame(1)]
    assert told(messages) == ["0", "fix 1 refused", "fix 2", "1"]


def test_at_the_end_only_what_belongs_to_a_frame_that_is_there() -> None:
    messages: list[Message] = [frame(0), frame(1), FixGiven(1, fix(1.0), True), FixGiven(2, fix(2.0), True), Stood(2)]
    assert told(messages) == ["0", "1", "fix 1"]


def test_where_frames_are_missing_a_fix_comes_before_the_next_one() -> None:
    assert told([frame(0), FixGiven(3, fix(1.0), True), frame(7)]) == ["0", "fix 1", "7"]


def test_a_recorded_fix_is_the_fix_again() -> None:
    message = FixMessage(
        seq=5, t_s=1.5, point=None, is_fused=False, position_m=(1.0, 2.0, 3.0), covariance_m2=[0.5] * 9, dop=1.25,
        residual_rms_m=1e-6, channels=[1, 4], jump_mm=0.0,
    )  # fmt: skip
    assert fix_given(message) == FixGiven(5, Fix(1.5, (1.0, 2.0, 3.0), (0.5,) * 9, 1.25, (1, 4), 1e-6), False)
    assert list(in_order([frame(5), fix_given(message)]))[1] == Fixed(fix_given(message).fix, False)
    message.is_set_aside = True
    assert list(in_order([frame(5), fix_given(message)]))[1] == Fixed(fix_given(message).fix, False, was_set_aside=True)
