"""How long a step takes."""

from __future__ import annotations

import msgspec
import numpy as np


class StepTimes(msgspec.Struct, frozen=True):
    """Milliseconds a step: mean, median, 99th percentile and the slowest."""

    mean_ms: float
    p50_ms: float
    p99_ms: float
    max_ms: float


def step_times(step_seconds: np.ndarray) -> StepTimes | None:
    """Summary of `Trace.step_seconds` (S,); samples that are not finite are passed over, None for none."""
    known = 1000.0 * np.asarray(step_seconds)[np.isfinite(step_seconds)]
    if len(known) == 0:
        return None
    p50, p99 = np.percentile(known, [50, 99])
    return StepTimes(float(known.mean()), float(p50), float(p99), float(known.max()))
