"""All pictures of a run or a comparison by name, with their captions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from kalmap.view.compare_figure import bars_figure, error_curves_figure, maps_figure
from kalmap.view.consistency_figure import consistency_figure
from kalmap.view.error_figure import error_figure
from kalmap.view.inputs import RunView, SetView
from kalmap.view.intensity_figure import intensity_figure
from kalmap.view.map_figure import map_figure
from kalmap.view.plan_figure import close_up_figure, plan_figure
from kalmap.view.reading import numbers
from kalmap.view.set_figure import run_set_figure, runs_set_figure
from kalmap.view.timing_figure import timing_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CAPTIONS = {
    "map": (
        "The estimated path and map. Each ellipse should hold its landmark's true place in 95 of 100 cases; "
        "a dot marks its centre, however small the ellipse."
    ),
    "plan": (
        "The floor plan: contours (black) over what the scans swept (white: free, blue-grey: occupied, grey: unknown). "
        "The path is the drive as it is seen at the end. Each ellipse should hold the true place in 95 of 100 cases."
    ),
    "plan-close-up": (
        "The part with the most samples, each with its 95 % ellipse at true size, over everything that the beams hit. "
        "A wall that was mapped twice shows as two bands of points or two lines."
    ),
    "errors": (
        "Estimate minus reference. The band is three standard deviations as the filter states them: "
        "the curve should leave it only in 3 of 1000 instants. A wide band may reach beyond the axis."
    ),
    "consistency": (
        "Squared errors, measured in the filter's own standard deviations. Above the band the filter is too "
        "sure of itself, below it too cautious. NEES needs the truth; NIS compares each frame of sightings "
        "with what the filter expected and needs no truth."
    ),
    "timing": "How long each odometry sample took, the update by a frame of sightings counted in.",
    "association": (
        "The frame in which most was decided in doubt, or where nothing was, most was seen. A sighting may go to a "
        "landmark in whose gate it lies. The close-ups show the sightings in most doubt (s and a number, as "
        "`kalmap why` counts them), with lines to the landmark each got and to the nearest three that it did not get."
    ),
    "set": (
        "The map as a set. The reference counts its landmarks that have been in view so far. OSPA is the distance to "
        "them a landmark, with a missed or false one at the cut-off; its two parts are what misplaced ones and what "
        "missing or false ones come to."
    ),
    "intensity": (
        "How many landmarks the last map expects where: all Gaussians of the best particle, also those that are too "
        "unsure to count as landmarks. Integrated over an area it is the number expected there."
    ),
    "maps": "The maps side by side, at the same scale.",
    "error-curves": "Distance to the reference position, and size of the heading error, over time.",
    "metrics": "Metrics by method. A dashed line is the right value; elsewhere, shorter errors are better.",
    "study": "Root mean square error over all runs, at each instant.",
}


def run_figures(run: RunView) -> dict[str, Figure]:
    """Map, errors, consistency and timing of a run, and of a random finite set its number and intensity.

    A map of contours is drawn as a floor plan with a close-up. What is not known is said in the picture.
    """
    if run.estimate.contours is None:
        drawn = {"map": map_figure(run)}
    else:
        drawn = {"plan": plan_figure(run), "plan-close-up": close_up_figure(run)}
    drawn |= {"errors": error_figure(run)}
    if run.sets is not None:
        drawn |= {"set": run_set_figure(run), "intensity": _intensity(run, run.sets)}
    return drawn | {"consistency": consistency_figure(run), "timing": timing_figure(run)}


def _intensity(run: RunView, sets: SetView) -> Figure:
    landmarks, kind = (run.reference.landmarks, run.reference.kind) if run.reference else (None, "")
    path = run.path()[0]
    return intensity_figure(sets.weights, sets.means, sets.covariances, landmarks, path, kind)


def comparison_figures(
    runs: Sequence[RunView], metrics: Mapping[str, Mapping[str, Any]]
) -> dict[str, Figure]:
    """Maps, error curves and metric bars of several methods. metrics: method -> its metrics."""
    drawn = {"maps": maps_figure(runs), "error-curves": error_curves_figure(runs)}
    if any(run.sets is not None for run in runs):
        drawn["set"] = runs_set_figure(runs)
    return drawn | {"metrics": bars_figure({method: numbers(row) for method, row in metrics.items()})}
