"""Numbers that the papers report, to stand beside ours."""

from __future__ import annotations

import msgspec


class Published(msgspec.Struct, frozen=True):
    """A row of Chen & Cheng 2012, tables 1 (set a) and 2 (set b): means over 50 runs."""

    position_rms_m: float
    heading_rms_deg: float
    feature_rms_m: float
    total_s: float
    step_ms: float


CRCDKF = {
    ("a", "ekf"): Published(4.0070, 2.3125, 3.0340, 10.87, 0.63),
    ("a", "cdkf"): Published(3.8193, 2.1874, 2.6853, 84.24, 4.85),
    ("a", "cr-ukf"): Published(3.8102, 2.1837, 2.6723, 15.75, 0.91),
    ("a", "cr-cdkf"): Published(3.7784, 2.1607, 2.6340, 15.68, 0.90),
    ("b", "ekf"): Published(2.6918, 1.5495, 2.0683, 11.93, 0.69),
    ("b", "cr-ukf"): Published(2.6093, 1.5014, 1.8543, 17.24, 0.99),
    ("b", "cr-cdkf"): Published(2.5954, 1.4878, 1.8258, 16.84, 0.97),
}
# Steps of the two laps: the paper says 17,383; the map and the rules of the simulator give 17,381.
CRCDKF_STEPS = 17_381
