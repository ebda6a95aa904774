"""The life of a landmark, as an audit trail tells it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import msgspec

from kalmap.records import Reason

Ask = Callable[..., list[tuple[Any, ...]]]


class Sighted(msgspec.Struct, frozen=True):
    """A sighting that was given to the landmark of a story.

    range m, bearing rad. squared: d^2 to that landmark, NaN where the pair was not considered (it founded it).
    others: (landmark, d^2) of the other candidates, nearest first. trial: still on trial afterwards.
    """

    frame: int
    time: float
    sighting: int
    range: float
    bearing: float
    squared: float
    gate: float
    reason: Reason
    trial: bool
    others: tuple[tuple[int, float], ...]

    @property
    def margin(self) -> float:
        """By how much d^2 could have been larger, or the runner-up's smaller, before the decision changed."""
        second = min((squared for _, squared in self.others), default=math.inf)
        return min(self.gate, second) - self.squared


class Happened(msgspec.Struct, frozen=True):
    """Something that happened to a landmark in a frame; see `kalmap.records.Managed`."""

    frame: int
    time: float
    landmark: int
    action: str
    why: str
    into: int


class Passed(msgspec.Struct, frozen=True):
    """A sighting that had the landmark of a story inside its gate, at d^2 `squared`, and did not go to it.

    given: the landmark that it went to, SPURIOUS if it was left unused.
    """

    frame: int
    time: float
    sighting: int
    squared: float
    given: int
    reason: Reason


class Story(msgspec.Struct, frozen=True):
    """The life of a landmark.

    fate: "confirmed", "trial", "retired" or "merged": what it was at the end. founded, confirmed, ended: frames; None
    where that never happened, or before the trail began. into: what it was merged with, final: after all mergers.
    sightings, happened (mergers of others into it counted in), passed: in order of time.
    """

    landmark: int
    fate: str
    founded: int | None
    confirmed: int | None
    ended: int | None
    into: int | None
    final: int
    sightings: tuple[Sighted, ...]
    happened: tuple[Happened, ...]
    passed: tuple[Passed, ...]


def tell(ask: Ask, number: int) -> Story | None:
    """The story of a landmark, asked of the file through `ask(question, *values)`; None if there never was such a one.

    Raises TypeError or ValueError where the file holds what no writer writes.
    """
    rows = ask(
        "SELECT fate, founded, confirmed, ended, merged_into FROM landmarks WHERE landmark = ?", number
    )
    if not rows:
        return None
    fate, founded, confirmed, ended, into = rows[0]
    return Story(
        landmark=number,
        fate=fate,
        founded=founded,
        confirmed=confirmed,
        ended=ended,
        into=into,
        final=last_name(ask, number),
        sightings=_sighted(ask, number),
        happened=_happened(ask, number),
        passed=_passed(ask, number),
    )


def last_name(ask: Ask, label: int) -> int:
    """The landmark that a number stands for after all mergers."""
    met = {label}
    while True:
        rows = ask("SELECT merged_into FROM landmarks WHERE landmark = ? AND merged_into >= 0", label)
        if not rows or rows[0][0] in met:
            return label
        label = int(rows[0][0])
        met.add(label)


def _sighted(ask: Ask, number: int) -> tuple[Sighted, ...]:
    pairs: dict[tuple[int, int], dict[int, float]] = {}
    for frame, sighting, landmark, squared in ask(
        "SELECT c.frame, c.sighting, c.landmark, c.squared FROM sightings s JOIN candidates c"
        " ON c.frame = s.frame AND c.sighting = s.sighting WHERE s.landmark = ? AND c.squared IS NOT NULL"
        " ORDER BY c.squared DESC",
        number,
    ):
        # A pair that was considered twice stands with the smaller of its distances, which comes last.
        pairs.setdefault((frame, sighting), {})[landmark] = float(squared)
    found = []
    for frame, time, sighting, distance, bearing, gate, reason, trial in ask(
        "SELECT s.frame, f.time, s.sighting, s.range, s.bearing, f.gate, s.reason, s.trial"
        " FROM sightings s JOIN frames f USING (frame) WHERE s.landmark = ? ORDER BY s.frame, s.sighting",
        number,
    ):
        others = pairs.get((frame, sighting), {})
        squared = others.pop(number, math.nan)
        numbers = (known(distance), known(bearing), squared, known(gate))
        nearest_first = tuple(sorted(others.items(), key=lambda pair: pair[1]))
        found.append(
            Sighted(frame, known(time), sighting, *numbers, Reason(reason), bool(trial), nearest_first)
        )
    return tuple(found)


def _happened(ask: Ask, number: int) -> tuple[Happened, ...]:
    rows = ask(
        "SELECT m.frame, f.time, m.landmark, m.action, m.why, m.into_landmark FROM managed m"
        " JOIN frames f USING (frame) WHERE m.landmark = ?1 OR m.into_landmark = ?1 ORDER BY m.frame, m.number",
        number,
    )
    return tuple(Happened(frame, known(time), *rest) for frame, time, *rest in rows)


def _passed(ask: Ask, number: int) -> tuple[Passed, ...]:
    rows = ask(
        "SELECT s.frame, f.time, s.sighting, min(c.squared), s.landmark, s.reason FROM candidates c"
        " JOIN sightings s USING (frame, sighting) JOIN frames f USING (frame)"
        " WHERE c.landmark = ?1 AND s.landmark <> ?1 AND c.squared < f.gate"
        " GROUP BY s.frame, s.sighting ORDER BY s.frame, s.sighting",
        number,
    )
    return tuple(
        Passed(frame, known(time), sighting, float(squared), given, Reason(reason))
        for frame, time, sighting, squared, given, reason in rows
    )


def known(value: Any) -> float:
    """A number of the file; NaN where it is NULL."""
    return math.nan if value is None else float(value)
