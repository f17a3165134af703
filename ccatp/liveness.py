"""Pure. Whether a run is alive: both loops are heard of, have joined the robot, and get its frames."""

from ccatp.wire.topics import BY_NAME, Presence

LOOPS = ("main", "danger")
STALE_AFTER_S = min(BY_NAME[f"presence.{name}"].stale_after_s for name in LOOPS)


class Liveness:
    """What the loops say of themselves, and how long ago.

    Args:
        stale_after_s: what is older than this does not count, neither a word of a loop nor a frame of the robot.
    """

    def __init__(self, stale_after_s: float = STALE_AFTER_S) -> None:
        """Nothing heard."""
        self._stale_after_s = stale_after_s
        self._presences: dict[str, Presence] = {}

    def heard(self, presence: Presence) -> None:
        """A loop is there. Its words are dated by its own clock, which is the machine's: waiting in line ages them."""
        self._presences[presence.process] = presence

    @property
    def has_joined(self) -> bool:
        """Whether both loops have said that they joined the robot."""
        return all(name in self._presences and self._presences[name].phase in ("joined", "done") for name in LOOPS)

    def trouble(self, now_s: float) -> str:
        """What is wrong, or nothing.

        Args:
            now_s: time of the machine's monotonic clock.
        """
        for name in LOOPS:
            presence = self._presences.get(name)
            if presence is None:
                return f"{name} was never heard of"
            age_s = now_s - presence.t_s
            if age_s > self._stale_after_s:
                return f"{name} was last heard of {age_s:.1f} s ago"
            if presence.phase == "joined":
                if presence.frame_age_s is None:
                    return f"{name} has had no frame from the robot yet"
                if presence.frame_age_s + age_s > self._stale_after_s:
                    return f"{name} had its last frame from the robot {presence.frame_age_s + age_s:.1f} s ago"
        return ""
