"""Pictures and pages of results: plain records in, matplotlib figures and self-contained HTML out."""

from kalmap.view.compare_figure import maps_figure
from kalmap.view.comparison import render_comparison, render_study
from kalmap.view.contour_report import contour_warnings
from kalmap.view.decision_figure import decision_figure
from kalmap.view.dots_figure import dots_figure
from kalmap.view.figures import comparison_figures, run_figures
from kalmap.view.inputs import (
    Aligned,
    Errors,
    RunView,
    SetCurve,
    SetView,
    StudyCurve,
    StudyDots,
    StudyRow,
    StudyTable,
)
from kalmap.view.intensity_figure import intensity_figure
from kalmap.view.report import Trail, render_report
from kalmap.view.set_figure import set_error_figure
from kalmap.view.study_figure import study_figure
from kalmap.view.style import save_figures

__all__ = [
    "Aligned",
    "Errors",
    "RunView",
    "SetCurve",
    "SetView",
    "StudyCurve",
    "StudyDots",
    "StudyRow",
    "StudyTable",
    "Trail",
    "comparison_figures",
    "contour_warnings",
    "decision_figure",
    "dots_figure",
    "intensity_figure",
    "maps_figure",
    "render_comparison",
    "render_report",
    "render_study",
    "run_figures",
    "save_figures",
    "set_error_figure",
    "study_figure",
]
