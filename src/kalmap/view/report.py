"""The report of a run: one HTML page that needs nothing but itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from kalmap.records import REASONS, Estimate, Landmarks, Manifest
from kalmap.records.trail import TrailSummary
from kalmap.view import page
from kalmap.view.contour_report import contour_section
from kalmap.view.figures import CAPTIONS, run_figures
from kalmap.view.inputs import RunView
from kalmap.view.reading import flat, headlines_first, metric_of, number, reading
from kalmap.view.summary import summary_cards

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LANDMARKS_SHOWN = 50
_SKIPPED_SHOWN = 50
_ASSOCIATION = "association"  # the figure that stands in the section of this name


class Trail(msgspec.Struct, frozen=True):
    """The audit trail as a report speaks of it.

    file: its name beside the report. command: what to type to ask it about a frame, the frame's number left out.
    """

    summary: TrailSummary
    file: str
    command: str


def render_report(
    run: RunView,
    *,
    metrics: Mapping[str, Any],
    manifest: Manifest,
    figures: Mapping[str, Figure | bytes] | None = None,
    warnings: Sequence[str] = (),
    trail: Trail | None = None,
) -> str:
    """The page of a run as HTML.

    metrics: as in `metrics.json`, nested as it likes; None or NaN reads as unknown.
    figures: name -> figure, or its PNG; drawn here if not given. warnings: what the reader must know first.
    trail: adds a section on data association, with the figure called "association" if there is one.
    """
    figures = run_figures(run) if figures is None else figures
    drawn = {name: page.picture(figure, name, CAPTIONS.get(name, name)) for name, figure in figures.items()}
    decisions = drawn.pop(_ASSOCIATION, "")
    sections = (
        ("warnings", "Warnings", page.warnings_html([*_failures(manifest), *warnings])),
        ("summary", "At a glance", page.cards(summary_cards(run, dict(flat(metrics))))),
        ("figures", "Pictures", "\n".join(drawn.values())),
        ("metrics", "Metrics", _metrics(metrics)),
        (_ASSOCIATION, "Association", "" if trail is None else _association(trail) + decisions),
        _map_section(run.estimate),
        ("biases", "Biases estimated", _biases(run.estimate.biases)),
        ("skipped", "Skipped records", _skipped(manifest)),
        ("configuration", "Configuration", configuration(manifest.config)),
        ("origin", "Where this comes from", origin(manifest)),
    )
    how = f"Filter {run.method} in {run.estimate.coordinates} coordinates"
    lead = f"{how if run.sets is None and run.estimate.contours is None else run.method} on {manifest.source}"
    return page.page(
        f"{run.log}: {run.method}", lead, sections, f"kalmap {manifest.kalmap}, {manifest.finished}"
    )


def configuration(config: Any) -> str:
    """HTML of the resolved settings."""
    shown = msgspec.json.format(msgspec.json.encode(config), indent=2).decode()
    return (
        "<p>Every setting that the run depended on, as resolved. Lengths in metres, times in seconds, "
        f"angles in degrees where the name ends in <code>_deg</code>.</p><pre>{page.text(shown)}</pre>"
    )


def origin(manifest: Manifest) -> str:
    """HTML of the manifest: version, seed, command and data hashes."""
    rows = [
        ("kalmap", manifest.kalmap),
        ("command", manifest.command),
        ("log", manifest.log),
        ("source", manifest.source),
        ("seed", manifest.seed),
        ("started", manifest.started),
        ("finished", manifest.finished),
        ("Python", f"{manifest.python} on {manifest.platform}"),
        ("packages", ", ".join(f"{name} {version}" for name, version in sorted(manifest.packages.items()))),
    ]
    body = "".join(_pair(name, value) for name, value in rows)
    body += "".join(_pair(f"SHA-256 of {name}", digest) for name, digest in manifest.data_sha256.items())
    if not manifest.data_sha256:
        body += _pair("data", "no files: the log was made from the seed")
    return page.framed_table("", body)


def _pair(name: str, value: Any) -> str:
    return f'<tr><th>{page.text(name)}</th><td class="mono">{page.text(value)}</td></tr>'


def _failures(manifest: Manifest) -> list[str]:
    """What the manifest says went wrong, worst first."""
    found = []
    if manifest.error:
        found.append(f"The run ended with an error: {manifest.error}")
    if manifest.interrupted:
        found.append("The run was interrupted; this is what there was until then.")
    elif not manifest.completed and not manifest.error:
        found.append("The run did not reach the end of the log.")
    if manifest.skipped_total:
        found.append(f"Bad records skipped: {manifest.skipped_total}. They are listed below.")
    return found


def _metrics(metrics: Mapping[str, Any]) -> str:
    rows, unknown = [], []
    values, before = dict(flat(metrics)), ""
    for key in headlines_first(values):
        metric, value = metric_of(key), values[key]
        if value is None or (isinstance(value, float) and not np.isfinite(value)):
            unknown.append(metric.title)
        else:
            says = reading(key, value)
            rows.append((metric.label, metric.format(value), metric.unit, says if says != before else ""))
            before = says
    if not rows and not unknown:
        return "<p>No metrics: there was nothing to compare with.</p>"
    missing = (
        f'<p class="soft">Not known for this run: {page.text("; ".join(unknown))}.</p>' if unknown else ""
    )
    return page.table(("metric", "value", "", "what it says"), rows, numeric=(1,)) + missing


def _association(trail: Trail) -> str:
    """HTML of the audit trail's counts, and of how to ask it."""
    counts = trail.summary
    rows = [(REASONS.get(reason, reason), number) for reason, number in sorted(counts.reasons.items())]
    sentences = [
        f"{counts.sightings} sightings in {counts.frames} frames: {counts.matched} matched, {counts.founded} founded "
        f"a landmark, {counts.unused} left unused.",
        f"{counts.landmarks} landmarks were founded or known: {counts.confirmed} ended in the map, {counts.trial} on "
        f"trial, {counts.retired} retired, {counts.merged} merged into another.",
    ]
    if counts.worst:
        share = f"{counts.trouble.total} sightings of {counts.troubled} frames"
        sentences.append(f"Decided in doubt: {share} ({counts.trouble.in_words()}).")
    told = "".join(f"<p>{page.text(sentence)}</p>" for sentence in sentences)
    worst = [(number, f"{time:.6g}", found.in_words()) for number, time, found in counts.worst]
    frame = counts.worst[0][0] if counts.worst else counts.first or 0
    link = f'<a href="{page.text(trail.file)}">{page.text(trail.file)}</a>'
    ask = (
        f"<p>Every decision with its candidates, distances, gate and reason is in {link}. To ask about a frame, or "
        f"with <code>--landmark N</code> for the story of a landmark:</p>"
        f"<pre>{page.text(f'{trail.command} --frame {frame}')}</pre>"
    )
    tables = page.table(("sightings went where they went because", "count"), rows, numeric=(1,))
    if worst:
        tables += "<h3>Frames with the most trouble</h3>"
        tables += page.table(("frame", "time (s)", "decided in doubt"), worst, numeric=(0, 1))
    return told + ask + tables


def _map_section(estimate: Estimate) -> tuple[str, str, str]:
    if estimate.contours is not None:
        return "contours", "Contours", contour_section(estimate.contours)
    return "landmarks", "Landmarks", _landmarks(estimate.landmarks)


def _landmarks(landmarks: Landmarks) -> str:
    count = len(landmarks)
    if not count:
        return "<p>The map holds no landmarks.</p>"
    shown = min(count, _LANDMARKS_SHOWN)
    sentence = f"{count} in the map" + (
        f"; the first {shown} are listed, all are in landmarks.csv." if shown < count else "."
    )
    deviations = np.sqrt(np.maximum(np.diagonal(landmarks.covariances, axis1=1, axis2=2), 0.0))
    rows = (
        (
            landmarks.ids[index],
            f"{landmarks.positions[index, 0]:.3f}",
            f"{landmarks.positions[index, 1]:.3f}",
            number(deviations[index, 0]),
            number(deviations[index, 1]),
            landmarks.sightings[index],
            number(landmarks.existence[index]),
        )
        for index in range(shown)
    )
    columns = ("id", "x (m)", "y (m)", "sigma x (m)", "sigma y (m)", "sightings", "existence")
    return f"<p>{page.text(sentence)}</p>" + page.table(columns, rows, numeric=range(7))


def _biases(biases: Mapping[str, tuple[float, float]]) -> str:
    """HTML of the constant errors; offsets are angles or turn rates, and shown in degrees too."""
    if not biases:
        return ""
    rows = []
    for name, (value, deviation) in biases.items():
        unit = {"steering_offset": "deg", "turn_rate_offset": "deg/s"}.get(name, "")
        scale = 180.0 / np.pi if unit else 1.0
        rows.append((name.replace("_", " "), number(scale * value), number(scale * deviation), unit))
    return page.table(("bias", "value", "sigma", ""), rows, numeric=(1, 2))


def _skipped(manifest: Manifest) -> str:
    if not manifest.skipped_total:
        return "<p>None: every record of the log was used.</p>"
    shown = manifest.skipped[:_SKIPPED_SHOWN]
    rows = [
        tuple(record.get(name, "") for name in ("file", "record", "field", "problem")) for record in shown
    ]
    sentence = f"Records passed over: {manifest.skipped_total}"
    if len(shown) < manifest.skipped_total:
        sentence += f"; the first {len(shown)} are listed"
    return f"<p>{sentence}.</p>" + page.table(("file", "record", "field", "problem"), rows, numeric=(1,))
