"""A run at a glance: the numbers that people look for first, each with a sentence on what it says."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from kalmap.geometry.ellipses import ellipse_axes
from kalmap.view.consistency import chi_square_band, shares
from kalmap.view.contour_report import Card, contour_cards, relation_cards
from kalmap.view.inputs import Errors, RunView, SetView
from kalmap.view.reading import agreement, honesty, number


def summary_cards(run: RunView, metrics: Mapping[str, Any] | None = None) -> list[Card]:
    """Cards (label, value, unit, what it says) of a run; what is not known is left out. metrics: of the run, flat."""
    metrics = metrics or {}
    related = list(relation_cards(metrics))
    return [
        *_course(run),
        *_map(run, metrics),
        *_set(run.sets),
        *related,
        *(_errors(run.errors, run) if run.errors is not None or not related else ()),
        *_innovations(run),
        *_time(run),
    ]


def _course(run: RunView) -> Iterator[Card]:
    poses, times = run.course.poses, run.course.times
    if not len(times):
        yield "Path", "none", "", "The trace is empty: no frame was processed."
        return
    length = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
    yield "Path", number(length), "m", f"in {number(float(times[-1] - times[0]))} s, {len(times)} instants."


def _map(run: RunView, metrics: Mapping[str, Any]) -> Iterator[Card]:
    estimate = run.estimate
    if estimate.contours is None:
        used = int(run.trace.sightings.sum())
        yield "Landmarks", str(len(estimate.landmarks)), "", f"from {used} sightings used."
    else:
        yield from contour_cards(estimate.contours, metrics)
    if np.isfinite(estimate.covariance).all():
        axes, _ = ellipse_axes(estimate.covariance[:2, :2])
        heading = float(np.degrees(np.sqrt(max(estimate.covariance[2, 2], 0.0))))
        says = f"Half axes of the 95 % ellipse; heading sigma {number(heading)} deg."
        yield "Final pose, stated", f"{number(axes[0])} × {number(axes[1])}", "m", says


def _set(sets: SetView | None) -> Iterator[Card]:
    if sets is None or sets.curve is None or sets.true_number is None or not len(sets.times):
        return
    cutoff = "" if sets.cutoff is None else f", cut off at {sets.cutoff:.3g} m"
    says = (
        f"at the end{cutoff}: {sets.number[-1]:.0f} landmarks, {sets.true_number[-1]:.0f} have been in view."
    )
    yield "OSPA", number(float(sets.curve.ospa[-1])), "m", says


def _errors(errors: Errors | None, run: RunView) -> Iterator[Card]:
    if errors is None or not len(errors):
        yield "Accuracy", "unknown", "", "This log has no reference path to compare with."
        return
    kind = run.reference.kind if run.reference is not None else "reference"
    squared = (errors.values[:, :2] ** 2).sum(axis=1)
    if np.isfinite(squared).any():
        rms = float(np.sqrt(np.nanmean(squared)))
        yield (
            "Position error",
            number(rms),
            "m RMS",
            f"against the {kind}; largest {number(_largest(squared))} m.",
        )
    if errors.has_heading():
        rms = float(np.degrees(np.sqrt(np.nanmean(errors.values[:, 2] ** 2))))
        yield "Heading error", number(rms), "deg RMS", f"against the {kind}."
    if np.isfinite(errors.nees).any():
        mean = float(np.nanmean(errors.nees))
        inside = shares(errors.nees, float(errors.nees_dof))[1]
        low, high = (float(bound) for bound in chi_square_band(errors.nees_dof))
        says = f"{errors.nees_dof} is right for a pose. {honesty(mean / errors.nees_dof)} "
        says += f"{100 * inside:.0f} % of the instants lie in the 95 % band, {number(low)} to {number(high)}."
        yield "NEES", number(mean), "mean", says


def _innovations(run: RunView) -> Iterator[Card]:
    known = np.isfinite(run.trace.nis) & (run.trace.nis_dof > 0)
    if not known.any():
        return
    ratio = float(run.trace.nis[known].sum() / run.trace.nis_dof[known].sum())
    inside = shares(run.trace.nis[known], run.trace.nis_dof[known])[1]
    says = agreement(ratio)
    yield (
        "NIS / dof",
        number(ratio),
        "mean",
        f"1 is right. {says} {100 * inside:.0f} % of the frames in the 95 % band.",
    )


def _time(run: RunView) -> Iterator[Card]:
    spent = run.trace.step_seconds[np.isfinite(run.trace.step_seconds)]
    if not len(spent):
        return
    says = f"99 % below {number(1e3 * float(np.percentile(spent, 99)))} ms."
    covered = float(np.ptp(run.trace.step_times))
    if covered > 0.0 and spent.sum() > 0.0:
        says += f" The log ran at {number(covered / float(spent.sum()))} times its recorded speed."
    yield "Time per step", number(1e3 * float(spent.mean())), "ms", says


def _largest(squared: np.ndarray) -> float:
    return float(np.sqrt(np.nanmax(squared)))
