"""Glue. What operators are told of a survey's states, and who looks after one that is held for long."""

from ccatp.assembly import Parts
from ccatp.config.models import Config
from ccatp.processes.telling import Teller
from ccatp.surveying.budget import home_time_s
from ccatp.surveying.states import State
from ccatp.surveying.vigil import Call, Vigil
from ccatp.wire.robot import Sensors


class SurveyWatch:
    """Tells states, reminds of faults, and sends a robot home that nobody comes for.

    Args:
        cfg: the configuration.
        parts: the survey.
        teller: tells it.
    """

    def __init__(self, cfg: Config, parts: Parts, teller: Teller) -> None:
        """Nothing to look after."""
        self._limits, self._base = cfg.limits, parts.mirror.base_pose
        self._mission, self._localizer, self._teller = parts.mission, parts.localizer, teller
        self._vigil = Vigil(cfg, falls=parts.mirror.overhang)

    def keep_vigil(self, sensors: Sensors) -> None:
        """A fault that nobody looks after: an alarm now and then, and home before the battery is too low for it."""
        mission, vigil, pose = self._mission, self._vigil, self._localizer.deck_pose
        knows_place = not (mission.is_lost or self._localizer.is_frozen)
        home_s = home_time_s(self._base, self._limits, pose.x_m, pose.y_m) if knows_place else None
        call = vigil.watch(sensors.t, sensors.soc, home_s)
        if call is Call.REMIND:
            held_s = vigil.held_s(sensors.t)
            self._teller.say("error", f"held for {held_s:.0f} s, waiting for an operator: {mission.cause}")
        elif call is Call.RETURN:
            mission.abort(f"nobody came, and the battery ({sensors.soc:.0%}) lasts for little more than the way home")

    def tell_state(self, before: State, seq: int) -> None:
        """The mission's state is another one than before, in frame ``seq``."""
        mission, teller = self._mission, self._teller
        if not mission.is_faulted:
            self._vigil.over()
        teller.log.debug("state", seq=seq, before=before, after=mission.state, cause=mission.cause)
        if mission.state in (State.HELD, State.BACKING_OFF) or before is State.HELD:
            teller.say("warning", state_text(mission.state, mission.cause))
        if mission.state is State.RETURNING and before is not State.BACKING_OFF:
            teller.say("warning", f"returning to base: {mission.cause}")


def state_text(state: State, cause: str) -> str:
    """What is said of the state in which a mission is held, or of the one after that."""
    if cause:
        return f"{state}: {cause}"
    return f"{state}" if state in (State.HELD, State.BACKING_OFF, State.DONE) else f"going on: {state}"
