"""What an audit trail comes to: which decisions were in doubt, and the counts over all frames."""

from __future__ import annotations

import math

import msgspec

from kalmap.records.decisions import Frame, Reason

CLOSE = 2.0 * math.log(10.0)
"""Two landmarks are rivals if their d^2 + ln det S differ by less: one is not ten times as likely as the other."""

_BY_REASON: dict[int, str] = {
    Reason.CONTEST_LOST: "contest",
    Reason.JOINTLY_INCOMPATIBLE: "contest",
    Reason.BETWEEN_GATES: "between gates",
    Reason.OFFSET: "offset",
    Reason.WIDENED: "offset",
}


class Trouble(msgspec.Struct, frozen=True):
    """How many sightings of a frame, or of many, were decided in doubt, by kind of doubt; see `doubts`."""

    contests: int = 0
    between_gates: int = 0
    offsets: int = 0
    rivals: int = 0

    @property
    def total(self) -> int:
        """All of them: what frames are ranked by."""
        return self.contests + self.between_gates + self.offsets + self.rivals

    def in_words(self) -> str:
        """For example "2 contests, 1 between gates"; empty where nothing was in doubt."""
        counts = (
            (self.contests, "contest", "contests"),
            (self.between_gates, "between gates", "between gates"),
            (self.offsets, "by offset", "by offset"),
            (self.rivals, "close rival", "close rivals"),
        )
        return ", ".join(f"{count} {one if count == 1 else many}" for count, one, many in counts if count)


class TrailSummary(msgspec.Struct, frozen=True):
    """The counts of a whole trail.

    frames, sightings: how many. first, last: numbers of the frames; begin, end: their times, s; None without frames.
    matched, founded, unused: what became of the sightings. reasons: how many sightings had each `Reason`.
    landmarks: how many numbers there ever were; confirmed, trial: how many of them ended in the map, or on trial;
    retired, merged: how many were removed, or became part of another.
    troubled: frames with any doubt; trouble: the doubts of all frames; worst: (number, time s, doubts) of the frames
    with the most, most first.
    """

    frames: int
    sightings: int
    first: int | None
    last: int | None
    begin: float | None
    end: float | None
    matched: int
    founded: int
    unused: int
    reasons: dict[int, int]
    landmarks: int
    confirmed: int
    trial: int
    retired: int
    merged: int
    troubled: int
    trouble: Trouble
    worst: tuple[tuple[int, float, Trouble], ...]


def doubts(frame: Frame) -> list[str]:
    """For each sighting the kind of doubt in which it was decided, "" where there was none.

    "contest": it lost its landmark to another sighting or to joint compatibility. "between gates": too far to match,
    too near to found. "offset": matched only after an offset of the frame was taken off, or after the gate was
    widened. "rival": another landmark than the one it was given lay inside the gate and was nearly as likely
    (`CLOSE`), or it was left unused with a landmark inside the gate.
    """
    why, labels = frame.why, frame.labels.tolist()
    found = [_BY_REASON.get(reason, "") for reason in why.reasons.tolist()]
    distances = zip(why.squared.tolist(), why.log_volume.tolist())
    pairs = [
        (pair, squared, squared + volume) for pair, (squared, volume) in zip(why.pairs.tolist(), distances)
    ]
    limits = dict.fromkeys(range(len(labels)), math.inf)
    for (m, landmark), _, normalised in pairs:
        if landmark == labels[m]:
            limits[m] = min(limits[m], normalised + CLOSE)
    for (m, landmark), squared, normalised in pairs:
        rival = landmark != labels[m] and squared < why.gate and normalised < limits[m]
        if rival and not found[m]:
            found[m] = "rival"
    return found


def trouble(frame: Frame) -> Trouble:
    """How much of a frame was decided in doubt: each sighting counts once, by its kind of doubt (`doubts`).

    The frames with the largest `total` are the ones to look at first.
    """
    kinds = doubts(frame)
    return Trouble(
        contests=kinds.count("contest"),
        between_gates=kinds.count("between gates"),
        offsets=kinds.count("offset"),
        rivals=kinds.count("rival"),
    )
