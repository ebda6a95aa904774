"""Monte Carlo studies: methods x worlds x seeds, comparisons on one log, and the papers' tables again."""

from kalmap.study.cases import Case, Method, RunRecord
from kalmap.study.claims import Claim
from kalmap.study.compare import (
    Compared,
    PairedRow,
    compare_methods,
    compare_seeds,
    paired_rows,
)
from kalmap.study.crcdkf import reproduce_crcdkf
from kalmap.study.crcdkf_cases import bailey_maps
from kalmap.study.djnn import reproduce_djnn
from kalmap.study.methods import parse_method, parse_methods
from kalmap.study.montecarlo import run_cases, run_study
from kalmap.study.paper_report import Reproduction
from kalmap.study.result import StudyResult, Summary, runs_csv, summary_csv
from kalmap.study.slasem import reproduce_slasem
from kalmap.study.srckf_phd import reproduce_srckf_phd

__all__ = [
    "Case",
    "Claim",
    "Compared",
    "Method",
    "PairedRow",
    "Reproduction",
    "RunRecord",
    "StudyResult",
    "Summary",
    "bailey_maps",
    "compare_methods",
    "compare_seeds",
    "paired_rows",
    "parse_method",
    "parse_methods",
    "reproduce_crcdkf",
    "reproduce_djnn",
    "reproduce_slasem",
    "reproduce_srckf_phd",
    "run_cases",
    "run_study",
    "runs_csv",
    "summary_csv",
]
