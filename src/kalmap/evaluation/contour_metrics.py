"""A map of contours, judged in flat numbers: by its own scans, and by what a reference knows."""

from __future__ import annotations

import math

from kalmap.evaluation import trajectory
from kalmap.evaluation.crispness import crispness, loop_error, map_error
from kalmap.evaluation.map_metrics import Metrics
from kalmap.records import Contours, Estimate, Reference, SensorConfig


def contour_metrics(estimate: Estimate, sensor: SensorConfig) -> Metrics:
    """What the map itself says: its size, what the estimator counted, and how crisp it is.

    `crispness_*_m` need the estimate's scans; only ranges that the sensor believes in are measured.
    """
    contours = estimate.contours
    if contours is None:
        return {}
    metrics: Metrics = {"contour_samples": len(contours), "contour_runs": len(contours.strands())}
    metrics |= estimate.counts or {}
    crisp = None
    if estimate.sweeps is not None:
        points = estimate.sweeps().points(sensor.min_range, sensor.max_range)
        crisp = crispness(points, contours)
    return metrics | {
        "crispness_mean_m": crisp.mean if crisp else None,
        "crispness_median_m": crisp.median if crisp else None,
        "crispness_p95_m": crisp.p95 if crisp else None,
        "crispness_beyond_share": crisp.beyond if crisp else None,
        "crispness_points": crisp.points if crisp else None,
    }


def contour_reference_metrics(
    contours: Contours, matched: trajectory.Matched, reference: Reference
) -> Metrics:
    """Errors against the true walls, and of the drive's end as seen from its start; None where they are not known."""
    walls, loop = map_error(contours, reference, matched), loop_error(matched)
    return {
        "map_error_mean_m": walls.mean if walls else None,
        "map_error_rms_m": walls.rms if walls else None,
        "map_error_p95_m": walls.p95 if walls else None,
        "loop_error_m": loop[0] if loop else None,
        "loop_error_deg": math.degrees(loop[1]) if loop else None,
    }
