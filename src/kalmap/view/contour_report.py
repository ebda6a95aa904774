"""What a report says of a map of contours, in cards and in a section of its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from kalmap.records import Contours
from kalmap.view import page
from kalmap.view.reading import number

Card = tuple[str, str, str, str]

LEAST_LATENCY = 0.03
"""s, worth telling."""
LEAST_SCALE = 0.03
"""Share of the odometry's ways or turns, worth telling."""
LEAST_ON_CONTOURS = 0.75
"""Of the ranges. A piece of contour needs four; if more than every fourth range is on none, the usual four are torn."""


def contour_cards(contours: Contours, metrics: Mapping[str, Any]) -> Iterator[Card]:
    """Cards (label, value, unit, what it says); what is not known is left out."""
    yield (
        "Contour samples",
        str(len(contours)),
        "",
        f"in {_runs(contours)}, {number(_length(contours))} m of contours.",
    )
    crisp, beyond = metrics.get("crispness_mean_m"), metrics.get("crispness_beyond_share")
    if crisp is not None:
        shown = f"Mean distance of what the beams hit to the contours; {number(100 * (beyond or 0.0))} % lie far off."
        yield "Crispness", number(100.0 * crisp), "cm", shown
    walls = metrics.get("map_error_rms_m")
    if walls is not None:
        yield "Map error", number(100.0 * walls), "cm RMS", "Distance of the samples to the true walls."
    loop, turned = metrics.get("loop_error_m"), metrics.get("loop_error_deg")
    if loop is not None and turned is not None:
        yield (
            "Loop error",
            number(loop),
            "m",
            f"and {number(turned)} deg: the end of the drive as seen from its start.",
        )


def relation_cards(metrics: Mapping[str, Any]) -> Iterator[Card]:
    """One card on the known motions between instants, where there are any."""
    moved, turned = metrics.get("relations_translation_mean_m"), metrics.get("relations_rotation_mean_deg")
    if moved is None or turned is None:
        return
    spread = f"± {number(metrics['relations_translation_std_m'])} m and {number(turned)}"
    says = f"{spread} ± {number(metrics['relations_rotation_std_deg'])} deg, over {metrics['relations_found']} motions"
    missed = metrics.get("relations_missed")
    yield "Relations error", number(moved), "m mean", f"{says}, {missed} not found." if missed else f"{says}."


def contour_warnings(metrics: Mapping[str, Any]) -> tuple[str, ...]:
    """What must be known of a map of contours: scans that hold the vehicle badly, or not at all, or come late,
    and wheels that measure wrong."""
    return (*_torn(metrics), *_loose(metrics), *_late(metrics), *_off_scale(metrics))


def _torn(metrics: Mapping[str, Any]) -> Iterator[str]:
    """Scans of which much is no contour."""
    share = metrics.get("ranges_on_contours_share")
    if share is not None and share < LEAST_ON_CONTOURS:
        yield (
            f"{number(100.0 * (1.0 - share))} % of the ranges lie on no contour: the scans are torn by ranges that are "
            "bad or missing, or what they show is no wall. The map may be far worse than its covariances say."
        )


def _loose(metrics: Mapping[str, Any]) -> Iterator[str]:
    """Scans that tell nothing of the way along a direction."""
    loose, maps = metrics.get("local_maps_loose"), metrics.get("local_maps")
    sigma, direction = metrics.get("weakest_direction_sigma_m"), metrics.get("weakest_direction_deg")
    if not loose or maps is None or sigma is None or direction is None:
        return
    where = "The scans" if maps == loose == 1 else f"In {loose} of {maps} local maps the scans"
    yield (
        f"{where} hold the vehicle along one direction no better than its odometry does, as in a corridor without "
        f"features: the map is only as long there as the odometry says (weakest at {number(direction)} deg, standard "
        f"deviation {number(sigma)} m)."
    )


def _late(metrics: Mapping[str, Any]) -> Iterator[str]:
    """Stamps of scans and of the odometry that do not belong together."""
    latency, sigma = metrics.get("latency_s"), metrics.get("latency_sigma_s")
    if latency is None or sigma is None or abs(latency) < max(LEAST_LATENCY, 3.0 * sigma):
        return
    late = "later" if latency > 0 else "earlier"
    yield (
        f"The scans are stamped {1e3 * abs(latency):.0f} ms {late} than they were taken, by the odometry's clock "
        f"(standard deviation {1e3 * sigma:.0f} ms): the vehicle is told where it was then."
    )


def _off_scale(metrics: Mapping[str, Any]) -> Iterator[str]:
    """Odometry whose ways or turns are too long or too short as a whole."""
    for name, what in (("way_scale", "ways"), ("turn_scale", "turns")):
        scale, sigma = metrics.get(name), metrics.get(f"{name}_sigma")
        if scale is None or sigma is None or abs(scale) < max(LEAST_SCALE, 3.0 * sigma):
            continue
        yield (
            f"The odometry's {what} are told too {'short' if scale > 0 else 'long'}: they were multiplied by "
            f"{1.0 + scale:.3f} (standard deviation {sigma:.3f})."
        )


def contour_section(contours: Contours) -> str:
    """HTML of how large the map is, and how sure."""
    if not len(contours):
        return "<p>The map holds no contours.</p>"
    sentence = (
        f"{len(contours)} samples in {_runs(contours)}, {number(_length(contours))} m of contours; all "
        "are in contours.csv and contours.geojson. Standard deviations as the estimator states them:"
    )
    across = _sigmas(contours.covariances, contours.normals)
    along = _sigmas(contours.covariances, np.column_stack([-contours.normals[:, 1], contours.normals[:, 0]]))
    rows = [
        (name, *(number(100.0 * value) for value in np.percentile(sigmas, (50, 95, 100))))
        for name, sigmas in (("across the contour", across), ("along the contour", along))
    ]
    columns = ("sigma of samples", "median (cm)", "95 % below (cm)", "largest (cm)")
    return f"<p>{page.text(sentence)}</p>" + page.table(columns, rows, numeric=(1, 2, 3))


def _runs(contours: Contours) -> str:
    count = len(contours.strands())
    return f"{count} run{'s' * (count != 1)}"


def _length(contours: Contours) -> float:
    segments = contours.segments()
    return float(np.hypot(*(segments[:, 2:] - segments[:, :2]).T).sum())


def _sigmas(covariances: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(N,) standard deviation of each sample along its unit vector."""
    return np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", directions, covariances, directions), 0.0))
