"""Which landmarks are believed in: on trial, confirmed, retired.

A landmark on trial stands in the filter's state, so that it is as correlated with the robot as it should be, but
corrects nothing until it is confirmed: a false one that is retired leaves no trace.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Protocol

import msgspec
import numpy as np

from kalmap.association.checks import check
from kalmap.kernels.region import tally_by_range


class Review(msgspec.Struct, frozen=True):
    """What a frame says about the landmarks near the robot.

    indices: (K,) landmarks that were looked for. seen: (K,) bool, whether a sighting went to it. expected: (K,)
    bool, whether it should be seen: in the field of view, and nothing before it. believed: (K,) bool, confirmed
    already. ranges: (K,) m. reach: m, how far the sensor can be relied on.
    """

    indices: np.ndarray
    seen: np.ndarray
    expected: np.ndarray
    believed: np.ndarray
    ranges: np.ndarray
    reach: float

    def rows(self) -> Iterator[tuple[int, bool, bool, float]]:
        """(index, seen, expected, range) of each landmark."""
        return zip(
            self.indices.tolist(),
            self.seen.tolist(),
            self.expected.tolist(),
            self.ranges.tolist(),
            strict=True,
        )


class Verdict(msgspec.Struct, frozen=True):
    """What a frame changes: new scores by index, and who is confirmed or retired, each with the reason."""

    scores: tuple[tuple[int, float], ...] = ()
    confirmed: tuple[tuple[int, str], ...] = ()
    retired: tuple[tuple[int, str], ...] = ()
    extra: Any = None


class Management(Protocol):
    """Scores landmarks frame by frame. `scores` holds a number for each, `confirmed` a bool."""

    @property
    def tries(self) -> bool:
        """Whether new landmarks are on trial first."""
        ...

    @property
    def first_score(self) -> float: ...

    def review(self, scores: list[float], confirmed: list[bool], extra: Any, review: Review) -> Verdict: ...

    def settle(self, extra: Any, change: Any) -> None:
        """Bring what is remembered beside the scores up to a verdict's `extra`, in place."""
        ...

    def start(self) -> Any:
        """What is remembered beside the scores."""
        ...

    def existence(self, score: float) -> float:
        """Probability that a landmark with this score is real."""
        ...


class _Plain(msgspec.Struct, frozen=True):
    """What managements without a memory beside the scores share."""

    def start(self) -> Any:
        return []

    def settle(self, extra: Any, change: Any) -> None:
        """Nothing is remembered beside the scores."""

    def existence(self, score: float) -> float:
        """1: these managements believe or do not."""
        return 1.0


class Keep(_Plain, frozen=True, tag=True):
    """Every new landmark is believed at once and for ever."""

    @property
    def tries(self) -> bool:
        return False

    @property
    def first_score(self) -> float:
        return 1.0

    def review(self, scores: list[float], confirmed: list[bool], extra: Any, review: Review) -> Verdict:
        """Nothing ever changes."""
        return Verdict()


_FRAME = 2.0**-20  # added to a trial's score by a frame, so that one number holds both counts


class Trial(_Plain, frozen=True, tag=True):
    """So many sightings within so many frames that could have given one, or the landmark is gone.

    confirm: sightings, the founding one counted. window: frames, fewer than a million. Confirmed landmarks stay.
    """

    confirm: int = 3
    window: int = 30

    def __post_init__(self) -> None:
        check(self.confirm >= 1, "confirm", "1 or more", self.confirm)
        check(self.window >= 1, "confirm_window", "1 or more frames", self.window)

    @property
    def tries(self) -> bool:
        return self.confirm > 1

    @property
    def first_score(self) -> float:
        return 1.0 + _FRAME

    def review(self, scores: list[float], confirmed: list[bool], extra: Any, review: Review) -> Verdict:
        """The score is the sightings, and in steps of 2^-20 the frames: exact in binary."""
        changes, believed, gone = [], [], []
        for index, seen, expected, _ in review.rows():
            if confirmed[index] or not (seen or expected):
                continue
            score = scores[index] + seen + _FRAME
            changes.append((index, score))
            count, frames = int(score), round((score - int(score)) / _FRAME)
            if count >= self.confirm:
                believed.append((index, f"{count} sightings in {frames} frames"))
            elif frames >= self.window:
                gone.append((index, f"{count} of {self.confirm} sightings after {frames} frames in view"))
        return Verdict(tuple(changes), tuple(believed), tuple(gone))


_RANGE_BINS = 6  # of the sensor's range, for the probability of detection
_PRIOR_FRAMES = 20.0  # how many frames the assumed probability of detection counts for


class _Learning(msgspec.Struct, frozen=True):
    """Managements that learn, as the run goes and by range, how often a landmark that is there is seen.

    detection: the probability of detection that they start from.
    """

    detection: float = 0.9

    def __post_init__(self) -> None:
        check(0.0 < self.detection < 1.0, "detection", "a probability between 0 and 1", self.detection)

    def start(self) -> Any:
        """For each bin of the range [sightings, frames in view] of landmarks believed in."""
        return [[0.0, 0.0] for _ in range(_RANGE_BINS)]

    def settle(self, extra: Any, change: Any) -> None:
        """Count who was seen of those that should have been."""
        for place, (seen, frames) in enumerate(change or ()):
            extra[place][0] += seen
            extra[place][1] += frames

    def tally(self, review: Review) -> list[list[float]]:
        """What this frame adds to the memory: by bins, believed landmarks seen, and those that should have been."""
        counts = np.zeros((_RANGE_BINS, 2))
        expected = review.expected & review.believed
        tally_by_range(review.ranges, review.seen, expected, review.reach, counts)
        return counts.tolist()

    def existence(self, score: float) -> float:
        """1: believed in, or not there at all."""
        return 1.0

    def detection_at(self, extra: Any, distance: float, reach: float) -> float:
        """P_D at a distance in m: the share seen so far, with the assumed one as a prior; in [0.05, 0.98]."""
        seen, frames = extra[_bin(distance, reach)]
        share = (seen + _PRIOR_FRAMES * self.detection) / (frames + _PRIOR_FRAMES)
        return min(0.98, max(0.05, share))


class Counter(_Learning, frozen=True, tag=True):
    """The information counter of Zhou, Zhao & Zhang 2010, equation (9).

    T goes up by one with every sighting and down by one with every frame in which the landmark should have been
    seen and was not; out of view it stays. T >= `admit` admits to the map; T <= `expel` removes, also from the
    map.

    A miss counts only at ranges at which landmarks that are there are seen more often than not, which is
    learned: the paper's sensor sees everything, a real one does not, and a counter that falls while the
    landmark stands is none.
    """

    admit: int = 2
    expel: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self.admit > self.expel, "confirm", f"more than {self.expel}", self.admit)

    @property
    def tries(self) -> bool:
        return self.admit > 1

    @property
    def first_score(self) -> float:
        return 1.0

    def review(self, scores: list[float], confirmed: list[bool], extra: Any, review: Review) -> Verdict:
        """The score is T."""
        changes, believed, gone = [], [], []
        for index, seen, expected, distance in review.rows():
            if seen:
                score = scores[index] + 1.0
            elif expected and self.detection_at(extra, distance, review.reach) > 0.5:
                score = scores[index] - 1.0
            else:
                continue
            changes.append((index, score))
            if score <= self.expel:
                gone.append((index, f"information counter {score:.0f}"))
            elif not confirmed[index] and score >= self.admit:
                believed.append((index, f"information counter {score:.0f}"))
        return Verdict(tuple(changes), tuple(believed), tuple(gone), self.tally(review))


class Existence(_Learning, frozen=True, tag=True):
    """Existence probability in log-odds (Thrun, Burgard & Fox 2005, section 13.6; Musicki & Evans 2004).

    A sighting adds ln(P_D / P_F), a frame in which the landmark should have been seen adds ln((1 - P_D) / (1 -
    P_F)).
    false_rate: P_F, the probability that something else lies in the gate of a landmark that is not there.
    prior: of a newly founded landmark. admit, expel: probabilities. most: largest log-odds either way, so that
    something that stood for long and left is noticed some day.
    """

    false_rate: float = 0.1
    prior: float = 0.3
    admit: float = 0.97
    expel: float = 0.1
    most: float = 12.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check(0.0 <= self.expel < 1.0, "existence.expel", "a probability below 1", self.expel)
        for name in ("false_rate", "prior", "admit"):
            value = getattr(self, name)
            check(0.0 < value < 1.0, f"existence.{name}", "a probability between 0 and 1", value)
        check(self.expel < self.prior, "existence.prior", "more than expel", self.prior)
        check(0.0 < self.most < math.inf, "existence.most", "a positive number", self.most)

    @property
    def tries(self) -> bool:
        return self.admit > self.prior

    @property
    def first_score(self) -> float:
        return math.log(self.prior / (1.0 - self.prior))

    def existence(self, score: float) -> float:
        """The probability behind the log-odds."""
        return 0.5 * (1.0 + math.tanh(0.5 * score))  # 1 / (1 + exp(-score)) that cannot overflow

    def review(self, scores: list[float], confirmed: list[bool], extra: Any, review: Review) -> Verdict:
        """The score is the log-odds."""
        changes, believed, gone = [], [], []
        for index, seen, expected, distance in review.rows():
            if not (seen or expected):
                continue
            p = self.detection_at(extra, distance, review.reach)
            false = min(self.false_rate, 0.9 * p)
            step = math.log(p / false) if seen else math.log((1.0 - p) / (1.0 - false))
            score = max(-self.most, min(scores[index] + step, self.most))
            changes.append((index, score))
            probability = self.existence(score)
            if probability <= self.expel:
                gone.append((index, f"existence probability {probability:.3f}"))
            elif not confirmed[index] and probability >= self.admit:
                believed.append((index, f"existence probability {probability:.3f}"))
        return Verdict(tuple(changes), tuple(believed), tuple(gone), self.tally(review))


def _bin(distance: float, reach: float) -> int:
    return min(_RANGE_BINS - 1, int(_RANGE_BINS * distance / reach))


BuiltInManagement = Keep | Trial | Counter | Existence
