"""Pure. Judges of what the robot enforces by itself, on frames and the robot's own clock.

The ages in a frame tell on the robot's clock when a message arrived, so a slow network or a stalled client is never
taken for a fault of the robot.
"""

from collections.abc import Sequence
from typing import Literal

from ccatp.conformance.reading import Frame
from ccatp.conformance.verdict import NotApplicable, require

Key = Literal["drive", "permit"]
LOST_S = 0.05
EARLY_FRAMES, LATE_FRAMES = 2, 3  # a robot acts from frame to frame


def judge_ttl(frames: Sequence[Frame], key: Key, ttl_s: float, frame_s: float) -> str:
    """Frames from the last drive or permit on, the other key being renewed all the while.

    Args:
        frames: of more than the time-to-live.
        key: what is no longer sent.
        ttl_s: the time-to-live.
        frame_s: period of the frames.

    Raises:
        Broken: held too early, too late or never.
    """
    held_s: float | None = None
    has_moved, age_s = False, 0.0
    for frame in frames:
        age_s, other_s = (frame.age_s, frame.permit_age_s) if key == "drive" else (frame.permit_age_s, frame.age_s)
        if frame.is_held:
            early = has_moved and max(age_s, other_s) < ttl_s - EARLY_FRAMES * frame_s
            require(not early, f"held at a {key} age of {age_s:.3f} s, ttl_s {ttl_s:g}")
            held_s = age_s if held_s is None else held_s
        else:
            has_moved, held_s = True, None
            require(
                age_s <= ttl_s + LATE_FRAMES * frame_s, f"not held at a {key} age of {age_s:.3f} s, ttl_s {ttl_s:g}"
            )
    span_s = frames[-1].t_s - frames[0].t_s
    require(held_s is not None, f"not held {span_s:.2f} s after the last {key}, its age said to be {age_s:.3f} s")
    return f"held at a {key} age of {held_s:.3f} s, ttl_s {ttl_s:g}"


def judge_lost(frames: Sequence[Frame], witness: Key, ttl_s: float, frame_s: float) -> str | None:
    """Frames after one session ended and the other sent a last message right behind.

    Args:
        frames: from the end of the session on, of some 0.2 s.
        witness: the message that the other session sent; its arrival is the moment at which the loss was there, too.
        ttl_s: the time-to-live.
        frame_s: period of the frames.

    Returns:
        What was seen; ``None`` if the frames do not reach over the time in question.

    Raises:
        Broken: wheels not held in time.
        NotApplicable: the time-to-live is so short that it would hold them as soon.
    """
    if ttl_s < LOST_S + 4 * frame_s:
        raise NotApplicable(f"ttl_s {ttl_s:g} holds the wheels as soon")
    arrival_s = max(_arrival_s(frame, witness) for frame in frames)
    due_s, expiry_s = arrival_s + LOST_S + frame_s, arrival_s + ttl_s - frame_s
    judged = [frame for frame in frames if due_s < frame.t_s < expiry_s]
    for frame in judged:
        require(frame.is_held, f"not held {1e3 * (frame.t_s - arrival_s):.0f} ms after the end of the session")
    first = next((frame for frame in frames if frame.is_held), None)
    if not judged or first is None:
        return None
    return f"held {max(0.0, 1e3 * (first.t_s - arrival_s)):.0f} ms after the end of the session"


def judge_newest(frames: Sequence[Frame], newest: int, old: int) -> None:
    """Frames from when a drive and then an older one were sent.

    Raises:
        Broken: the older came into force, or the newer never did.
    """
    require(all(frame.drive_seq != old for frame in frames), f"drive {old} came into force after {newest}")
    require(any(frame.drive_seq == newest for frame in frames), f"drive {newest} never came into force")


def judge_once(frames: Sequence[Frame], seq: int, frame_s: float) -> None:
    """Frames in which a drive was sent, and sent again under the same number.

    Raises:
        Broken: the second came into force, too: the age starts anew.
    """
    in_force = [frame for frame in frames if frame.drive_seq == seq]
    require(bool(in_force), f"drive {seq} never came into force")
    # A robot that makes up for late frames says 0 of what arrived after their time: that tells no arrival.
    arrivals_s = [frame.drive_arrival_s for frame in in_force if frame.age_s > 0.0]
    spread_s = max(arrivals_s) - min(arrivals_s) if arrivals_s else 0.0
    require(spread_s <= 0.5 * frame_s, f"a second drive {seq} came into force {1e3 * spread_s:.0f} ms after the first")


def judge_untouched(frames: Sequence[Frame], fans: tuple[float, float], tolerance: float, cause: str) -> None:
    """Fan duties of all frames.

    Raises:
        Broken: they differ from ``fans``.
    """
    for frame in frames:
        require(is_duty(frame.fans, fans, tolerance), f"fans went from {list(fans)} to {list(frame.fans)} {cause}")


def is_duty(seen: tuple[float, float], wanted: tuple[float, float], tolerance: float) -> bool:
    """Whether duties are those."""
    return all(abs(a - b) <= tolerance for a, b in zip(seen, wanted, strict=True))


def mean_rates(frames: Sequence[Frame]) -> tuple[float, float] | None:
    """Mean (right, left) wheel rates of all encoder samples in the frames, rad/s; ``None`` without samples."""
    samples = [sample for frame in frames for sample in frame.enc]
    if not samples:
        return None
    return sum(wr for _, wr, _ in samples) / len(samples), sum(wl for _, _, wl in samples) / len(samples)


def _arrival_s(frame: Frame, key: Key) -> float:
    return frame.drive_arrival_s if key == "drive" else frame.permit_arrival_s
