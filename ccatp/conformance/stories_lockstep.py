"""Edge. Stories of a server whose clock waits for its clients."""

from ccatp.conformance.pair import STILL, Pair
from ccatp.conformance.reading import Frame
from ccatp.conformance.stage import Stage
from ccatp.conformance.verdict import require

LOOK_S = 0.3  # wall time in which a frame would have come
BEYOND_TTL_S = 0.2


def waits_for_drive(stage: Stage) -> str:
    """A permit alone."""
    pair = Pair(stage)
    pair.steady()
    pair.permit()
    require(not pair.pause(LOOK_S), "a frame without a drive for the one before")
    pair.rates = STILL
    _comes(pair, "drive and permit")
    return "no frame on a permit alone, one on permit and drive"


def waits_for_permit(stage: Stage) -> str:
    """A drive alone."""
    pair = Pair(stage)
    pair.steady()
    pair.drive()
    require(not pair.pause(LOOK_S), "a frame without a permit for the one before")
    _comes(pair, "permit and drive")
    return "no frame on a drive alone, one on drive and permit"


def waits_for_this_frame(stage: Stage) -> str:
    """Answers to the frame before."""
    pair = Pair(stage)
    pair.steady()
    pair.run(2 * stage.facts.frame_s)
    before = pair.newest.seq - 1
    pair.drive(ack=before)
    pair.permit(ack=before)
    require(not pair.pause(LOOK_S), f"a frame on answers to {before}, not to {before + 1}")
    _comes(pair, "answers to it")
    return "no frame on answers to an older one"


def one_step(stage: Stage) -> str:
    """One frame for each pair of answers, one period on."""
    pair = Pair(stage)
    before = pair.steady()
    require(not pair.pause(LOOK_S), "a second frame on one drive and one permit")
    pair.drive()
    pair.permit()
    frames = pair.pause(LOOK_S)
    require(len(frames) == 1, f"{len(frames)} frames on one drive and one permit")
    step_s = frames[0].t_s - before.t_s
    require(abs(step_s - stage.facts.frame_s) < 0.5 * stage.facts.frame_s, f"a step of {step_s:.4f} s")
    return f"one frame on one drive and one permit, {1e3 * step_s:.3g} ms on"


def time_stands_still(stage: Stage) -> str:
    """An answer held back for longer than it would live."""
    pair = Pair(stage)
    before = pair.steady()
    wait_s = stage.facts.ttl_s + BEYOND_TTL_S
    require(not pair.pause(wait_s), "frames while the answer is held back")
    pair.rates = STILL
    frame = _comes(pair, "an answer that was held back")
    require(
        not frame.is_held, f"held after {wait_s:.2f} s of waiting, ages {frame.age_s:.3f}, {frame.permit_age_s:.3f} s"
    )
    grown_s = max(frame.age_s - before.age_s, frame.permit_age_s - before.permit_age_s)
    require(grown_s < stage.facts.frame_s * 1.5, f"ages grew by {grown_s:.3f} s while time stood still")
    return f"{wait_s:.2f} s of waiting, the ages {frame.age_s:.3f} and {frame.permit_age_s:.3f} s"


def _comes(pair: Pair, what: str) -> Frame:
    newest = pair.newest.seq
    return pair.expect(lambda frame: frame.seq > newest, f"no frame on {what}")
