"""Time stamps of samples that are possible (interface control document 1).

A sample is taken before its frame is sent, and at most a second before. A sample with another time is not used: its
place in time is not known. What is not used is missing, so the rules for silent sensors apply.
"""

from collections.abc import Sequence
from typing import TypeVar

from ccatp.core import EdgeSample, GravitySample, ImuSample, WheelSample

LATEST_S = 1e-3
"""A sample may be later than its frame by this, because the robot rounds its times."""
OLDEST_S = 1.0
"""A sample may be older than its frame by this."""

_Sample = TypeVar("_Sample", ImuSample, WheelSample, EdgeSample)


def possible_samples(frame_s: float, samples: Sequence[_Sample]) -> Sequence[_Sample]:
    """The samples of a frame at ``frame_s`` whose times are possible; ``samples`` itself if all are."""
    oldest_s, latest_s = frame_s - OLDEST_S, frame_s + LATEST_S
    for sample in samples:
        if not oldest_s <= sample[0] <= latest_s:
            return [sample for sample in samples if oldest_s <= sample[0] <= latest_s]
    return samples


def possible_gravity(frame_s: float, sample: GravitySample | None) -> GravitySample | None:
    """The reading of gravity in a frame at ``frame_s``, if there is one and its time is possible."""
    return sample if sample is not None and -OLDEST_S <= sample[0] - frame_s <= LATEST_S else None


def worst_offset_s(frame_s: float, samples: Sequence[ImuSample | WheelSample | EdgeSample | GravitySample]) -> float:
    """Offset to the frame, s, of the sample that is furthest from it; > 0: later. 0 without samples."""
    return max((sample[0] - frame_s for sample in samples), key=abs, default=0.0)
