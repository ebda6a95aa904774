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
CRCDKF_RUNS = 50
# Steps of the two laps: the paper says 17,383; the map and the rules of the simulator give 17,381.
CRCDKF_STEPS = 17_381


class PublishedAssociation(msgspec.Struct, frozen=True):
    """A row of Zhou, Zhao & Zhang 2010, tables 1 (10 movers) and 2 (50): means over 20 runs.

    time_s: its "mean running time", the paper does not say of what. features: in the last map of one run, said
    beside figure 2.
    """

    accuracy: float
    time_s: float
    features: int | None = None


DJNN = {
    (10, "jcbb"): PublishedAssociation(0.9372, 0.1853),
    (10, "nn"): PublishedAssociation(0.9304, 0.1499),
    (10, "djnn"): PublishedAssociation(0.9340, 0.0231),
    (50, "jcbb"): PublishedAssociation(0.9051, 0.3041, 456),
    (50, "nn"): PublishedAssociation(0.8962, 0.2366),
    (50, "djnn"): PublishedAssociation(0.9174, 0.0295, 282),
}
DJNN_RUNS = 20

# Yan et al. 2014, table 2: mean seconds a run of 726 looks, by clutter a look, over 10 runs.
SRCKF_PHD_SECONDS = {
    (1, "srckf-phd"): 69.7603,
    (1, "rb-phd"): 59.6959,
    (2, "srckf-phd"): 84.2715,
    (2, "rb-phd"): 71.0705,
    (3, "srckf-phd"): 100.4406,
    (3, "rb-phd"): 85.4459,
}
SRCKF_PHD_RUNS = 10
