"""Metrics in plain language: label, unit, number as text, and what the number says.

Metrics are known by the words of their key (`position_rmse_m`, `nees_mean`, `timing.p99_ms`), so that a
key nobody has told this file about is still shown, only without a reading.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import msgspec
import numpy as np

# Key suffix -> unit shown and the factor from the key's unit to it.
_UNITS = {
    "m": ("m", 1.0),
    "m2": ("m²", 1.0),
    "deg2": ("deg²", 1.0),
    "deg": ("deg", 1.0),
    "rad": ("deg", 180.0 / math.pi),
    "s": ("s", 1.0),
    "seconds": ("s", 1.0),
    "ms": ("ms", 1.0),
    "us": ("µs", 1.0),
    "hz": ("Hz", 1.0),
    "percent": ("%", 1.0),
}
_SHARES = {"share", "inside", "fraction", "precision", "recall", "accuracy"}
_SPELT = {
    "nees": "NEES",
    "nis": "NIS",
    "ate": "ATE",
    "rpe": "RPE",
    "rmse": "RMSE",
    "rms": "RMS",
    "dof": "dof",
}
_SPELT |= {
    "ospa": "OSPA",
    "gospa": "GOSPA",
    "p50": "median",
    "p95": "95th percentile",
    "p99": "99th percentile",
    "std": "standard deviation",
    "f1": "F1",
}
# The first entry whose words are all in the key gives the explanation.
_EXPLANATIONS: tuple[tuple[frozenset[str], str], ...] = (
    (
        frozenset({"association", "once"}),
        "The same, each sighting judged by what was decided in its frame.",
    ),
    (
        frozenset({"association", "accuracy", "used"}),
        "Of the sightings that were used, how many went where they belong.",
    ),
    (
        frozenset({"association", "accuracy"}),
        "Of all sightings, how many were rightly joined, founded or rejected.",
    ),
    (
        frozenset({"association", "precision"}),
        "Of the pairs of sightings given to one landmark, how many are of one.",
    ),
    (
        frozenset({"association", "recall"}),
        "Of the pairs of sightings of one landmark, how many were given to one.",
    ),
    (frozenset({"association", "f1"}), "Precision and recall of the pairs in one number: 1 is right."),
    (frozenset({"association", "spurious"}), "The log does not say which sightings are of no landmark."),
    (frozenset({"relations", "loop"}), "The same for motions between instants 100 s apart or more: loops."),
    (frozenset({"relations", "local"}), "The same for motions between instants close to each other."),
    (
        frozenset({"relations"}),
        "Error of motions that are known between pairs of instants; no alignment is needed.",
    ),
    (
        frozenset({"crispness", "beyond"}),
        "Of what the beams hit, how much lies more than 0.5 m from every contour.",
    ),
    (frozenset({"crispness"}), "Distance of what the beams hit, at its final place, to the contours."),
    (
        frozenset({"weakest", "direction"}),
        "Where the scans hold the vehicle least: at the end of a local map, as seen from its start.",
    ),
    (frozenset({"map", "error"}), "Distance of the contours' samples to the true walls."),
    (frozenset({"loop", "error"}), "Error of the drive's end as seen from its start."),
    (frozenset({"online"}), "The same for what was said at the time, before later loops were known."),
    (frozenset({"dead", "reckoning"}), "The same for the odometry alone: what the landmarks are worth."),
    (frozenset({"ate", "aligned"}), "Distance from the reference path, both laid over each other first."),
    (frozenset({"ate"}), "Distance from the reference path, over the whole run."),
    (frozenset({"rpe"}), "Error of the motion over short stretches: drift, not place."),
    (frozenset({"gospa"}), "Map error: misplaced landmarks, and a charge for each missed or false one."),
    (frozenset({"ospa"}), "Map error a landmark, missed and false ones counted in."),
    (frozenset({"cardinality", "course"}), "Features too many or too few, on average over the run."),
    (frozenset({"position", "rmse"}), "RMS distance from the reference position."),
    (frozenset({"position", "rms"}), "RMS distance from the reference position."),
    (frozenset({"heading"}), "Error of the direction that the vehicle points in."),
    (frozenset({"precision"}), "Of the pairings made, how many were right."),
    (frozenset({"recall"}), "Of the pairings that could be made, how many were."),
    (frozenset({"landmark"}), "Distance between estimated and true landmarks."),
    (frozenset({"landmarks"}), "Distance between estimated and true landmarks."),
    (frozenset({"feature"}), "Distance between estimated and true landmarks."),
)
# What a count says, by the words of its key; one of the association's by those behind "association".
_COUNTS = {
    "contour samples": "Points that the contours are known at.",
    "contour runs": "Unbroken stretches of contour.",
    "local maps loose": "Local maps that the scans hold no better than the odometry along one direction.",
    "crispness points": "Of what the beams hit, how much was measured.",
    "relations found": "Known motions both of whose instants have a pose.",
    "relations missed": "Known motions of which an instant has no pose.",
    "cardinality error": "Landmarks in the map less those that are there.",
    "right": "Sightings joined to a landmark that their own feature founded.",
    "wrong": "Sightings joined to another's landmark, though their feature had one.",
    "missed new": "Sightings of a feature without a landmark yet, joined to another's.",
    "right new": "Sightings that founded their feature's first landmark.",
    "false new": "Sightings that founded one more landmark of the same feature.",
    "unused": "Sightings of a feature that were left aside.",
    "false rejected": "Sightings of no feature, rightly left aside.",
    "false admitted": "Sightings of no feature that were used all the same.",
    "unscored": "Sightings of which nobody says what they were.",
    "spurious landmarks": "Landmarks in the map that are no feature.",
    "duplicate landmarks": "Landmarks in the map beyond the first of a feature.",
    "unknown landmarks": "Landmarks in the map of which nobody says what they are.",
    "missed features": "Features seen three times or more that have no landmark.",
}
# What a comparison shows first, as the evaluation names it.
HEADLINES = (
    "position_rmse_m",
    "heading_rmse_deg",
    "relations_translation_mean_m",
    "relations_rotation_mean_deg",
    "crispness_mean_m",
    "map_error_rms_m",
    "loop_error_m",
    "feature_rmse_m",
    "ate_aligned_rmse_m",
    "feature_aligned_rmse_m",
    "ospa_m",
    "gospa_m",
    "cardinality_error",
    "nees_mean",
    "nees_inside",
    "nis_mean",
    "nis_inside",
    "association_accuracy",
    "association_f1",
    "step_ms_mean",
    "step_ms_p99",
)
# A mean squared error over its expectation is called honest between these bounds.
HONEST = (0.6, 1.6)


class Metric(msgspec.Struct, frozen=True):
    """How a metric is shown: label, unit, factor to that unit, and the right value where there is one."""

    key: str
    label: str
    unit: str
    scale: float
    right: float | None

    @property
    def title(self) -> str:
        """Label with its unit."""
        return f"{self.label} ({self.unit})" if self.unit else self.label

    def format(self, value: Any) -> str:
        """A value in the unit shown, without the unit: three or four digits, "unknown" for None or NaN."""
        if isinstance(value, bool):
            return "yes" if value else "no"
        if isinstance(value, int | np.integer) and self.scale == 1.0:
            return f"{value:,}".replace(",", "\u202f")
        if isinstance(value, int | float | np.number):
            return number(self.scale * float(value))
        return "unknown" if value is None else str(value)


def metric_of(key: str) -> Metric:
    """Label, unit and right value of a metric, read from its key."""
    words = _words(key)
    unit, scale = "", 1.0
    if len(words) > 1 and words[-1] in _UNITS:
        unit, scale = _UNITS[words[-1]]
        words = words[:-1]
    elif "ms" in words[1:]:
        unit, words = "ms", [word for word in words if word != "ms"]
    elif _SHARES & set(words):
        unit, scale = "%", 100.0
    label = " ".join(_SPELT.get(word, word) for word in words)
    return Metric(
        key=key, label=label[:1].upper() + label[1:], unit=unit, scale=scale, right=_right(set(words))
    )


def flat(metrics: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Keys and values of nested metrics, keys joined by dots; lists longer than four are left out."""
    for key, value in metrics.items():
        name = f"{before}{key}"
        if isinstance(value, Mapping):
            yield from flat(value, f"{name}.")
        elif isinstance(value, list | tuple | np.ndarray):
            if len(value) <= 4:
                yield name, ", ".join(metric_of(name).format(item) for item in value)
        else:
            yield name, value


def numbers(metrics: Mapping[str, Any]) -> dict[str, float | None]:
    """The metrics that are numbers, flat, as bars and tables of a comparison want them."""
    found: dict[str, float | None] = {}
    for key, value in flat(metrics):
        if value is None:
            found[key] = None
        elif isinstance(value, int | float | np.number) and not isinstance(value, bool):
            # Whole numbers stay ints, so that a count is not shown with decimals.
            plain = value.item() if isinstance(value, np.number) else value
            found[key] = plain if math.isfinite(plain) else None
    return found


def headlines_first(keys: Iterable[str]) -> list[str]:
    """The keys, the headline metrics before the rest, otherwise in the order they come."""
    rank = {key: place for place, key in enumerate(HEADLINES)}
    return sorted(keys, key=lambda key: rank.get(key, len(rank)))


def reading(key: str, value: Any) -> str:
    """A sentence on what a metric's value says, empty where there is nothing to add."""
    words = set(_words(key))
    metric = metric_of(key)
    if metric.right is not None and isinstance(value, int | float) and math.isfinite(value):
        if "%" in metric.unit:
            return f"{100 * metric.right:.0f} % is right."
        judge = agreement if "nis" in words else honesty
        return f"{metric.right:g} is right. {judge(value / metric.right)}"
    if isinstance(value, int):
        spoken = " ".join(_words(key))
        return _COUNTS.get(spoken.partition("association ")[2] or spoken, "")
    return next((text for needed, text in _EXPLANATIONS if needed <= words), "")


def honesty(ratio: float) -> str:
    """What a mean normalised squared error says, given as its ratio to what it should be."""
    if not math.isfinite(ratio):
        return ""
    if ratio > HONEST[1]:
        return f"Too sure of itself: true errors are about {math.sqrt(ratio):.1f} times as large as stated."
    if ratio < HONEST[0]:
        return (
            f"Too cautious: true errors are about {math.sqrt(max(ratio, 0.0)):.2f} times as large as stated."
        )
    return "The stated uncertainty is honest."


def agreement(ratio: float) -> str:
    """What a mean NIS says, given as its ratio to what it should be."""
    if ratio > HONEST[1]:
        return "Sightings disagree more than stated: noise set too small, or wrong associations."
    if ratio < HONEST[0]:
        return "Sightings agree better than stated: noise set too large."
    return "Sightings agree with the map as well as stated."


def number(value: float) -> str:
    """A number as people read it: about three digits, no needless zeros, "unknown" if it is not finite."""
    if not math.isfinite(value):
        return "unknown"
    size = abs(value)
    if value == 0.0:
        return "0"
    if size >= 1e6 or size < 1e-4:
        return f"{value:.2e}"
    return f"{value:.{max(0, 2 - math.floor(math.log10(size)))}f}"


def _words(key: str) -> list[str]:
    return key.lower().replace(".", " ").replace("_", " ").replace("-", " ").split()


def _right(words: set[str]) -> float | None:
    """What the metric is on average for an honest filter; None where small or large is better instead."""
    if not words & {"nees", "nis"} or words & {
        "lower",
        "upper",
        "band",
        "low",
        "high",
        "count",
        "max",
        "min",
    }:
        return None
    if "dof" in words and "per" not in words:
        return None
    if words & _SHARES:
        return 0.95
    if "nees" in words:
        return 3.0
    return 1.0 if words & {"mean", "pooled", "per"} else None
