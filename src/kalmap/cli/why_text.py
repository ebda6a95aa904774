"""An audit trail in words: a frame, a landmark's story, the counts of a run."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from kalmap.records import Frame, Reason
from kalmap.records.trail import TrailSummary, doubts, trouble

if TYPE_CHECKING:
    from kalmap.data.audit_story import Sighted, Story

LONG_LIFE = 20
"""Sightings of a landmark above which only first, last and the ones most in doubt are shown."""
_NARROW = 0.25  # of the gate: a margin below this is worth showing
_OTHERS = 3  # runners-up shown for a sighting

_FATES = {
    "confirmed": "in the map at the end",
    "trial": "still on trial at the end",
    "retired": "retired",
    "merged": "merged into another",
}


def frame_text(frame: Frame, reasons: Mapping[int, str], of: int) -> str:
    """Every decision of a frame. reasons: sentences. of: how many frames there are."""
    why, kinds = frame.why, doubts(frame)
    x, y, heading = frame.pose.tolist()
    lines = [
        f"frame {frame.number} (one of {of}), t = {_short(frame.time)} s, "
        f"robot expected at ({_short(x)}, {_short(y)}) m, heading {_short(math.degrees(heading))} deg",
        f"a pair is possible below d^2 = {_short(why.gate)}; a new landmark beyond {_short(why.new_gate)}",
        *(f"note: {note}" for note in why.notes),
        "",
    ]
    if not len(frame.values):
        lines.append("nothing was seen")
    else:
        lines += _aligned(
            ("sighting", "range m", "bearing deg", "landmark", "d^2", "others (d^2)", "why"),
            (_decision(frame, m, reasons, kinds[m]) for m in range(len(frame.values))),
        )
    lines += [""] * bool(why.managed)
    lines += [f"landmark {one.landmark} {_action(one.action, one.into)}: {one.why}" for one in why.managed]
    if any(kinds):
        lines += ["", f"decided in doubt: {trouble(frame).in_words()}"]
    return "\n".join(lines)


def _decision(frame: Frame, m: int, reasons: Mapping[int, str], doubt: str) -> tuple[str, ...]:
    """A row of a frame's table."""
    label, reason = int(frame.labels[m]), int(frame.why.reasons[m])
    candidates = candidates_of(frame, m)
    own = next((squared for landmark, squared, _ in candidates if landmark == label), math.nan)
    others = [(landmark, squared) for landmark, squared, _ in candidates if landmark != label]
    trial = ", on trial" if frame.trial[m] else ""
    given = (
        "unused" if label < 0 else f"{label} new{trial}" if reason == Reason.FOUNDED else f"{label}{trial}"
    )
    sentence = reasons.get(reason, "?") + (" [a close rival]" if doubt == "rival" else "")
    if reason == Reason.CONTEST_LOST:
        sentence = _winner(frame, others) or sentence
    value = frame.values[m].tolist()
    return (
        str(m),
        f"{value[0]:.2f}",
        f"{math.degrees(value[1]):.1f}",
        given,
        _distance(own),
        _runners_up(others),
        sentence,
    )


def _winner(frame: Frame, others: Sequence[tuple[int, float]]) -> str:
    """Who has the landmark that a sighting lost."""
    labels = frame.labels.tolist()
    won = next((landmark for landmark, _ in others if landmark in labels), None)
    return "" if won is None else f"landmark {won} went to sighting {labels.index(won)}: left unused"


def candidates_of(frame: Frame, m: int) -> list[tuple[int, float, float]]:
    """(landmark, d^2, ln det S) of every candidate of a sighting, nearest first."""
    why = frame.why
    rows = [k for k, (sighting, _) in enumerate(why.pairs.tolist()) if sighting == m]
    found = [(int(why.pairs[k, 1]), float(why.squared[k]), float(why.log_volume[k])) for k in rows]
    return sorted(found, key=lambda pair: (math.isnan(pair[1]), pair[1]))


def landmark_text(story: Story, reasons: Mapping[int, str], everything: bool) -> str:
    """The story of a landmark; of a long life, unless `everything` is wanted, the sightings worth a look."""
    lines = [_headline(story), ""]
    told = {one.action for one in story.happened if one.landmark == story.landmark}
    if story.founded is not None and "founded" not in told:
        lines.append(f"frame {story.founded}: founded")
    lines += [
        f"frame {one.frame}, t = {_short(one.time)} s: "
        + (f"landmark {one.landmark} " if one.landmark != story.landmark else "")
        + f"{_action(one.action, one.into if one.landmark == story.landmark else story.landmark)}: {one.why}"
        for one in story.happened
    ]
    lines += [""] * (lines[-1] != "")
    shown = list(story.sightings)
    if len(shown) > LONG_LIFE and not everything:
        shown = _worth_a_look(story.sightings)
        lines.append(
            f"first, last and the most doubtful of its {len(story.sightings)} sightings (--all shows all)"
        )
    elif shown:
        lines.append("its sightings")
    if shown:
        lines += _aligned(
            ("frame", "t s", "sighting", "range m", "bearing deg", "d^2", "others (d^2)", "why"),
            (_sighting(one, reasons) for one in shown),
        )
    return "\n".join([*lines, *_passed(story, reasons, everything)]).rstrip()


def _headline(story: Story) -> str:
    """One sentence: what became of it, and when it was seen."""
    fate = _FATES.get(story.fate, story.fate)
    if story.fate == "merged":
        fate = f"merged into {story.into}" + (f", now {story.final}" if story.final != story.into else "")
    if story.ended is not None:
        fate += f" in frame {story.ended}"
    if not story.sightings:
        return f"landmark {story.landmark}: {fate}; no sighting was given to it"
    first, last = story.sightings[0].frame, story.sightings[-1].frame
    count = f"{len(story.sightings)} sighting{'s' if len(story.sightings) > 1 else ''}"
    return f"landmark {story.landmark}: {fate}; {count}, frames {first} to {last}"


def _sighting(one: Sighted, reasons: Mapping[int, str]) -> tuple[str, ...]:
    trial = " (on trial)" if one.trial else ""
    return (
        str(one.frame),
        _short(one.time),
        str(one.sighting),
        f"{one.range:.2f}",
        f"{math.degrees(one.bearing):.1f}",
        _distance(one.squared),
        _runners_up(one.others),
        reasons.get(one.reason, "?") + trial,
    )


def most_in_doubt(sightings: Iterable[Sighted], count: int) -> list[Sighted]:
    """The sightings with the least margin, the narrowest first; those whose margin is unknown come last."""
    return sorted(sightings, key=lambda one: (math.isnan(one.margin), one.margin))[:count]


def _worth_a_look(sightings: Sequence[Sighted]) -> list[Sighted]:
    """First, last and the ones decided narrowly, in order of time."""
    narrow = [one for one in sightings if one.margin < _NARROW * one.gate]
    chosen = [sightings[0], *most_in_doubt(narrow, LONG_LIFE - 2), sightings[-1]]
    places = {(one.frame, one.sighting): one for one in chosen}
    return [places[place] for place in sorted(places)]


def _passed(story: Story, reasons: Mapping[int, str], everything: bool) -> list[str]:
    """Sightings that might have been this landmark's, the nearest of them first."""
    if not story.passed:
        return []
    nearest = sorted(story.passed, key=lambda one: one.squared)
    shown = sorted(nearest if everything else nearest[:5], key=lambda one: (one.frame, one.sighting))
    times = "once" if len(nearest) == 1 else f"{len(nearest)} times"
    some = "" if len(shown) == len(nearest) else f"; the {len(shown)} nearest"
    lines = ["", f"it lay inside the gate of a sighting that did not go to it {times}{some}"]
    return lines + _aligned(
        ("frame", "t s", "sighting", "d^2", "went to", "why"),
        (
            (
                str(one.frame),
                _short(one.time),
                str(one.sighting),
                _distance(one.squared),
                "unused" if one.given < 0 else str(one.given),
                reasons.get(one.reason, "?"),
            )
            for one in shown
        ),
    )


def summary_text(summary: TrailSummary, reasons: Mapping[int, str], result: str) -> str:
    """The counts of a run, and where to look."""
    if not summary.frames:
        return "the audit trail holds no frame"
    span = f"{summary.first} to {summary.last}, t = {_known(summary.begin)} to {_known(summary.end)} s"
    lines = [
        f"{summary.frames} frames ({span}), {summary.sightings} sightings: {summary.matched} matched, "
        f"{summary.founded} founded a landmark, {summary.unused} unused",
        *_aligned(
            ("sightings", "why"),
            ((str(n), reasons.get(r, f"reason {r}")) for r, n in sorted(summary.reasons.items())),
        ),
        "",
        f"{summary.landmarks} landmarks: {summary.confirmed} in the map at the end, {summary.trial} on trial, "
        f"{summary.retired} retired, {summary.merged} merged into another",
        "",
    ]
    if not summary.worst:
        return "\n".join([*lines, "no sighting was decided in doubt"])
    share = f"{summary.trouble.total} sightings of {summary.troubled} frames were decided in doubt"
    worst = ((str(n), _short(time), found.in_words()) for n, time, found in summary.worst)
    ask = f"kalmap why {shlex.quote(result)} --frame {summary.worst[0][0]}"
    lines += [f"{share}: {summary.trouble.in_words()}", "the frames with the most trouble"]
    return "\n".join(
        [*lines, *_aligned(("frame", "t s", "decided in doubt"), worst), "", f"look closer: {ask}"]
    )


def _action(action: str, into: int) -> str:
    return f"merged into {into}" if action == "merged" else action


def _runners_up(others: Sequence[tuple[int, float]]) -> str:
    """ "18 (7.2), 19 (11)", the first few."""
    shown = ", ".join(f"{landmark} ({_distance(squared)})" for landmark, squared in others[:_OTHERS])
    more = len(others) - _OTHERS
    return f"{shown}, {more} more" if more > 0 else shown or "-"


def _distance(squared: float) -> str:
    if math.isnan(squared):
        return "-"
    return f"{squared:.2f}" if squared < 100.0 else f"{squared:.3g}"


def _known(value: float | None) -> str:
    return "?" if value is None else _short(value)


def _short(value: float) -> str:
    """A number with two decimals at most, no needless zeros; "?" where it is not known."""
    if math.isnan(value):
        return "?"
    return f"{value:.2f}".rstrip("0").rstrip(".") if math.isfinite(value) else "infinity"


def _aligned(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a table: numbers flush right, the last column and what has words in it flush left."""
    table = [tuple(columns), *map(tuple, rows)]
    widths = [max(len(row[k]) for row in table) for k in range(len(columns))]
    words = [k for k in range(len(columns)) if columns[k].startswith(("other", "why", "decided", "landmark"))]
    lines = []
    for row in table:
        cells = [row[k].ljust(width) if k in words else row[k].rjust(width) for k, width in enumerate(widths)]
        lines.append(("  " + "  ".join(cells)).rstrip())
    return lines
