"""How a run ended: what, by whom, why, and with which alarms."""

import msgspec
import pytest

from ccatp.conditions import text_of
from ccatp.conditions.danger import EMERGENCY, ENCODERS_STALE
from ccatp.conditions.mission import OPERATOR
from ccatp.core import Cause
from ccatp.errors import ExitStatus
from ccatp.links.topics import Alarm, MissionStatus, Turn
from ccatp.survey.ending import By, End, ending_of, ending_text, read_ending
from ccatp.survey.events import SurveyOutcome

STALE, FIRE = ENCODERS_STALE.cause(), EMERGENCY.cause(kind="fire")
CALLED, UNNAMED = OPERATOR.cause(by="eva"), OPERATOR.cause()


def status(cause: Cause, outcome: SurveyOutcome = SurveyOutcome.NONE, by: str = "") -> MissionStatus:
    return MissionStatus(
        seq=1, t_s=2.0, state="done", cause=text_of(cause), condition=cause.condition, outcome=outcome,
        stopped_by=by if outcome is SurveyOutcome.STOPPED else "", turn=Turn(why=cause),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("cause", "outcome", "exit_status", "what", "by", "text"),
    [
        (Cause(), SurveyOutcome.COMPLETE, ExitStatus.COMPLETE, End.COMPLETE, By.MISSION, "complete"),
        (CALLED, SurveyOutcome.AT_BASE, ExitStatus.ABORTED, End.AT_BASE, By.OPERATOR, "returned to base; by eva"),
        (FIRE, SurveyOutcome.AT_BASE, ExitStatus.ABORTED, End.AT_BASE, By.OBSERVATORY,
         "returned to base; by the observatory, emergency: fire"),
        (STALE, SurveyOutcome.STOPPED, ExitStatus.HELD, End.STOPPED, By.OPERATOR,
         "stopped where it was; by eva, held before: encoder samples stale"),
        (CALLED, SurveyOutcome.STOPPED, ExitStatus.HELD, End.STOPPED, By.OPERATOR, "stopped where it was; by eva"),
        (STALE, SurveyOutcome.NONE, ExitStatus.HELD, End.FAULTED, By.MISSION,
         "ended with a fault; encoder samples stale"),
        (STALE, SurveyOutcome.NONE, ExitStatus.INTERRUPTED, End.INTERRUPTED, By.SIGNAL,
         "interrupted; by a signal, held before: encoder samples stale"),
        (Cause(), SurveyOutcome.NONE, ExitStatus.USAGE, End.FAILED, By.PROGRAM, "failed"),
    ],
)  # fmt: skip
def test_the_end_names_what_happened_and_who_did_it(
    cause: Cause, outcome: SurveyOutcome, exit_status: ExitStatus, what: End, by: By, text: str
) -> None:
    ending = ending_of(status(cause, outcome, by="eva"), exit_status)
    assert (ending.what, ending.by, ending_text(ending)) == (what, by, text)
    assert ending.who == ("eva" if by is By.OPERATOR else "")


def test_an_operator_without_a_name_is_still_the_operator() -> None:
    ending = ending_of(status(UNNAMED, SurveyOutcome.AT_BASE), ExitStatus.ABORTED)
    assert ending_text(ending) == "returned to base; by an operator"


def test_the_death_of_a_process_ends_a_run_before_its_status_says_so() -> None:
    ending = ending_of(status(STALE), ExitStatus.HELD, failure="main died of signal 9")
    assert (ending.what, ending.by) == (End.FAILED, By.PROGRAM)
    assert ending_text(ending) == "failed; main died of signal 9"


@pytest.mark.parametrize(
    ("exit_status", "what"), [(ExitStatus.INTERRUPTED, End.INTERRUPTED), (ExitStatus.HELD, End.FAILED)]
)
def test_a_run_without_a_status_ended_too(exit_status: ExitStatus, what: End) -> None:
    assert ending_of(None, exit_status).what is what


def test_alarms_that_are_active_at_the_end_are_listed_acknowledged_or_not_and_ended_ones_are_not() -> None:
    def alarm(name: str, ended: str = "", by: str = "") -> Alarm:
        return Alarm(
            name=name, severity="hold", cause="c", advice="", since="", since_s=0.0, ended=ended, acknowledged_by=by
        )

    found = status(STALE, SurveyOutcome.STOPPED, by="eva")
    found.alarms = [alarm("encoders_stale", by="eva"), alarm("lifted"), alarm("yaw_disagrees", ended="2026-01-01")]
    ending = ending_of(found, ExitStatus.HELD)
    assert [one.name for one in ending.alarms] == ["encoders_stale", "lifted"]
    assert ending_text(ending).endswith("; alarms active at the end: encoders_stale (hold), lifted (hold)")
    assert read_ending({"ended": msgspec.to_builtins(ending)}) == ending
    died = ending_of(found, ExitStatus.HELD, failure="dataloop died")  # its death does not end the alarms
    assert died.alarms == ending.alarms


@pytest.mark.parametrize("summary", [None, {}, {"ended": 3}, {"ended": {"what": "vanished", "by": "mission"}}])
def test_a_summary_of_another_version_has_no_known_end(summary: dict[str, object] | None) -> None:
    assert read_ending(summary) is None
