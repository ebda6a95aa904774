"""What a log holds and what is wrong with it, found in its raw records before anything is merged.

`check_log` never raises on a log that can be opened: bad records become findings. A finding is a
"problem" (a strict run stops there, or the numbers are impossible) or a "note" (worth knowing).
"""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np

from kalmap.data.blocks import StreamEvents, covered
from kalmap.data.drive import DriveEvents
from kalmap.data.laser_check import LaserReport, laser_findings, laser_lines, laser_report
from kalmap.data.plausibility import Finding, implausible
from kalmap.data.streams import Fault, SightingStream, Stream, Streams, find_faults
from kalmap.data.unstream import streams_of_events
from kalmap.records import KalmapError, Log

FIRST_RECORDS = 3
"""How many records of each finding are named."""


class StreamReport(msgspec.Struct, frozen=True):
    """One sensor's stream.

    records: lines, rows or scans in the file; unusable: how many of them have a fault. instants:
    different times among the usable ones (frames, for sightings). begin, end: s, of the usable ones.
    period: s, median time between instants. longest_gap: s, and gap_at: s, when it began. None: too few.
    """

    name: str
    file: str
    records: int
    unusable: int
    instants: int
    begin: float | None
    end: float | None
    period: float | None
    longest_gap: float | None
    gap_at: float | None


class SightingReport(msgspec.Struct, frozen=True):
    """What the usable sightings say. identified: whether the log gives ids. per_frame: min, mean, max."""

    sightings: int
    empty_frames: int
    per_frame: tuple[int, float, int]
    identified: bool
    landmarks: int
    unidentified: int


class ReferenceReport(msgspec.Struct, frozen=True):
    """One reference: its kind, its frame, and how many poses, landmarks and relations it has."""

    kind: str
    frame: str
    poses: int
    landmarks: int
    relations: int = 0


class Report(msgspec.Struct, frozen=True):
    """All that `check_log` found. Encodes to JSON with `msgspec.json.encode`.

    begin, end: s, the span of the usable odometry; None without any. verdict: "good" (nothing), "notes"
    or "problems", after the gravest finding. laser: of logs of raw scans with odometry; None for others.
    """

    log: str
    source: str
    begin: float | None
    end: float | None
    streams: tuple[StreamReport, ...]
    sightings: SightingReport | None
    references: tuple[ReferenceReport, ...]
    findings: tuple[Finding, ...]
    verdict: Literal["good", "notes", "problems"]
    laser: LaserReport | None = None

    def text(self) -> str:
        """The report as lines to read in a terminal."""
        return format_report(self)


def check_log(log: Log) -> Report:
    """Counts, rates, gaps and everything wrong in a log, from its raw records where it has any.

    A log that is not made of raw streams (a simulated one) is judged by its events. Files that turn
    out to be unreadable are a problem too, named by the error's message.
    """
    findings: list[Finding] = []
    streams = None
    drive = log.open.drive if isinstance(log.open, DriveEvents) else None
    try:
        streams = (
            log.open.streams() if isinstance(log.open, StreamEvents | DriveEvents) else streams_of_events(log)
        )
    except KalmapError as error:
        findings.append(Finding("problem", "log", "cannot be read", 1, (str(error),)))
    good: dict[str, np.ndarray] = {}
    if streams is not None:
        for name, stream in streams.named().items():
            good[name], faults = find_faults(stream, streams.known_ids)
            findings += [*_grouped(name, faults), *_left_out(name, stream)]
            if drive is None or name != "odometry":  # a drive's odometry has the scans' own stamps
                findings += implausible(name, stream, good[name], log.defaults.sensor)
        findings += _outside(streams, good)
    if drive is not None:
        findings += laser_findings(drive)
    reports = () if streams is None else tuple(_stream(n, s, good[n]) for n, s in streams.named().items())
    if not log.references:
        findings.append(Finding("note", "references", "none: there is nothing to compare a result with", 0))
    odometry = next((r for r in reports if r.name == "odometry"), None)
    graves = {finding.severity for finding in findings}
    return Report(
        log=log.name,
        source=log.source,
        begin=None if odometry is None else odometry.begin,
        end=None if odometry is None else odometry.end,
        streams=reports,
        sightings=None if streams is None else _sightings(streams.sightings, good.get("sightings")),
        references=tuple(
            ReferenceReport(
                r.kind,
                r.frame,
                len(r.times),
                len(r.landmark_ids),
                0 if r.relations is None else len(r.relations.first),
            )
            for r in log.references
        ),
        findings=tuple(sorted(findings, key=lambda f: f.severity == "note")),
        verdict="problems" if "problem" in graves else "notes" if graves else "good",
        laser=None if drive is None else laser_report(drive),
    )


def _grouped(name: str, faults: list[Fault]) -> list[Finding]:
    """Faults of the same kind in the same field as one finding."""
    groups: dict[tuple[str, str], list[Fault]] = {}
    for fault in faults:
        groups.setdefault((fault.field, _kind(fault)), []).append(fault)
    return [
        Finding(
            "problem",
            name,
            f"{field}: {kind}",
            len(group),
            tuple(f"record {f.record}: {f.problem}" for f in group[:FIRST_RECORDS]),
        )
        for (field, kind), group in groups.items()
    ]


def _kind(fault: Fault) -> str:
    """The sort of a fault, without the numbers in it."""
    for words, kind in (
        ("goes back", "goes back"),
        ("ahead of the records", "ahead of the records that follow"),
        ("unknown id", "unknown id"),
        ("is missing", "is missing"),
        ("columns, found", "too many columns"),
        ("expected a number", "not a number"),
        ("found nan", "not finite"),
        ("inf", "not finite"),
        ("0 or more, found", "negative"),
        ("semi-definite", "not positive semi-definite"),
    ):
        if words in fault.problem:
            return kind
    return "impossible"


def _left_out(name: str, stream: Stream) -> list[Finding]:
    """Records of the same reason as one finding."""
    reasons: dict[str, list[int]] = {}
    for k, why in sorted(stream.left_out.items()):
        reasons.setdefault(why, []).append(k)
    return [
        Finding(
            "note",
            name,
            "left out: a known quirk of the log",
            len(rows),
            tuple(f"record {stream.records[k]}: {why}" for k in rows[:FIRST_RECORDS]),
        )
        for why, rows in reasons.items()
    ]


def _outside(streams: Streams, good: dict[str, np.ndarray]) -> list[Finding]:
    """Observations before the first or after the last odometry, which no event comes from."""
    found = []
    usable = {name: stream.times[good[name]] for name, stream in streams.named().items()}
    seen = np.concatenate([usable[n] for n in ("sightings", "scans") if n in usable] or [np.zeros(0)])
    begin, end = covered(streams.odometry, good["odometry"], seen)
    for name, times in usable.items():
        count = int(((times < begin) | (times > end)).sum())
        if count and name != "odometry":
            found.append(Finding("note", name, "outside the span of the odometry, left out", count))
    return found


def _stream(name: str, stream: Stream, good: np.ndarray) -> StreamReport:
    times = stream.times[good]
    instants = np.unique(times)
    gaps = np.diff(instants)
    longest = int(np.argmax(gaps)) if len(gaps) else None
    return StreamReport(
        name=name,
        file=stream.file,
        records=len(stream.times),
        unusable=int((~good).sum()) - len(stream.left_out),
        instants=len(instants),
        begin=float(instants[0]) if len(instants) else None,
        end=float(instants[-1]) if len(instants) else None,
        period=float(np.median(gaps)) if len(gaps) else None,
        longest_gap=None if longest is None else float(gaps[longest]),
        gap_at=None if longest is None else float(instants[longest]),
    )


def _sightings(stream: SightingStream | None, good: np.ndarray | None) -> SightingReport | None:
    if stream is None or good is None:
        return None
    seen = good if stream.empty is None else good & ~stream.empty
    frames, counts = np.unique(stream.times[good], return_counts=True)
    if stream.empty is not None:
        blind = np.isin(frames, stream.times[good & stream.empty])
        counts = np.where(blind, counts - 1, counts)
    ids = None if stream.ids is None else stream.ids[seen]
    return SightingReport(
        sightings=int(seen.sum()),
        empty_frames=int((counts == 0).sum()),
        per_frame=(int(counts.min()), float(counts.mean()), int(counts.max()))
        if len(counts)
        else (0, 0.0, 0),
        identified=ids is not None,
        landmarks=0 if ids is None else len(np.unique(ids[ids >= 0])),
        unidentified=0 if ids is None else int((ids < 0).sum()),
    )


def format_report(report: Report) -> str:
    """A report as lines to read in a terminal, without a line break at the end."""
    lines = [f"{report.log}  ({report.source})"]
    if report.begin is not None and report.end is not None:
        lines.append(f"  {report.begin:.3f} s to {report.end:.3f} s, {report.end - report.begin:.1f} s")
    for stream in report.streams:
        rate = f", every {stream.period:.4g} s" if stream.period else ""
        gap = (
            ""
            if stream.longest_gap is None
            else f", longest gap {stream.longest_gap:.4g} s at {stream.gap_at:.3f} s"
        )
        bad = f", {stream.unusable} unusable" if stream.unusable else ""
        lines.append(f"  {stream.name}: {stream.records} records{bad}, {stream.instants} instants{rate}{gap}")
    if report.sightings is not None:
        lines.append(_sighting_line(report.sightings))
    if report.laser is not None:
        lines += laser_lines(report.laser)
    for reference in report.references:
        size = f"{reference.poses} poses, {reference.landmarks} landmarks"
        if reference.relations:
            size = f"{reference.relations} relations"
        lines.append(f'  reference {reference.kind}: {size}, frame "{reference.frame}"')
    for finding in report.findings:
        count = f" ({finding.count})" if finding.count > 1 else ""
        lines.append(f"  {finding.severity}: {finding.stream}: {finding.what}{count}")
        lines += [f"    {record}" for record in finding.first]
    verdicts = {"good": "nothing to report", "notes": "no problems", "problems": "problems found"}
    return "\n".join([*lines, f"  {verdicts[report.verdict]}"])


def _sighting_line(seen: SightingReport) -> str:
    low, mean, high = seen.per_frame
    ids = (
        f"{seen.landmarks} landmarks, {seen.unidentified} unidentified"
        if seen.identified
        else "no identities"
    )
    frames = f"{low} to {high} a frame, mean {mean:.2f}, {seen.empty_frames} frames with none"
    return f"  {seen.sightings} sightings: {ids}; {frames}"


__all__ = ["Finding", "Report", "check_log", "format_report"]
