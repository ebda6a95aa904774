"""Claims, and whether a study bears them out. One that fails is stated as plainly as one that holds."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np

from kalmap.evaluation import paired_test
from kalmap.study.result import StudyResult
from kalmap.view import StudyRow, StudyTable

Verdict = Literal["holds", "fails", "undecided", "not comparable", "not measured"]

SIGNIFICANT = 0.05

_METRIC_NAMES = {
    "position_rmse_m": "position RMS (m)",
    "heading_rmse_deg": "heading RMS (deg)",
    "feature_rmse_m": "feature RMS (m)",
    "nees_mean": "NEES",
    "association_accuracy": "accuracy",
    "association_accuracy_at_once": "accuracy at once",
    "association_ms": "time per call (ms)",
    "landmarks": "map features",
    "ospa_course_m": "OSPA over the run (m)",
    "cardinality_course_error": "error of the number of features over the run",
    "runtime_s": "time per run (s)",
}


class Claim(msgspec.Struct, frozen=True):
    """One claim and what was measured.

    claim: in words. asked, got: the target and the measurement in words, `value` the number itself. p_value:
    two-sided Wilcoxon signed-rank where methods are compared. runs: how many it rests on.
    """

    claim: str
    asked: str
    got: str
    verdict: Verdict
    value: float | None = None
    p_value: float | None = None
    runs: int = 0


def bounded(
    claim: str, value: float | None, *, low: float | None = None, high: float | None = None, runs: int = 0
) -> Claim:
    """Holds if low <= value <= high; None is no bound."""
    parts = [f">= {low:.6g}"] if low is not None else []
    parts += [f"<= {high:.6g}"] if high is not None else []
    asked = " and ".join(parts)
    if value is None:
        return Claim(claim, asked, "-", "not measured")
    inside = (low is None or value >= low) and (high is None or value <= high)
    return Claim(claim, asked, f"{value:.6g}", "holds" if inside else "fails", value, runs=runs)


def mean_bounded(
    result: StudyResult,
    world: str,
    method: str,
    metric: str,
    *,
    low: float | None = None,
    high: float | None = None,
) -> Claim:
    """The mean over the runs of a metric within bounds."""
    summary = result.summary(world, method)
    name = f"{world}: {method}, mean {_METRIC_NAMES[metric]}"
    return bounded(name, summary.mean[metric], low=low, high=high, runs=summary.runs)


def better(result: StudyResult, world: str, first: str, second: str, metric: str) -> Claim:
    """The first method's metric is below the second's on the same seeds.

    Holds if the mean of the paired differences is below zero and the Wilcoxon test finds it significant at
    5 %; undecided if it is below zero but not significant; else it fails.
    """
    return _compared(result, world, first, second, metric, higher=False)


def above(result: StudyResult, world: str, first: str, second: str, metric: str) -> Claim:
    """The same the other way round: the first method's metric is above the second's, where more is better."""
    return _compared(result, world, first, second, metric, higher=True)


def _compared(
    result: StudyResult, world: str, first: str, second: str, metric: str, *, higher: bool
) -> Claim:
    way, sign, side = ("above", ">", "higher") if higher else ("below", "<", "lower")
    name = f"{world}: {first} {way} {second} in {_METRIC_NAMES[metric]}"
    asked = f"mean difference {sign} 0"
    test = result.paired(world, first, second, metric)
    # which of the two is smaller, as the test counts it
    smaller = result.paired(world, second, first, metric) if higher else test
    if test is None or smaller is None:
        return Claim(name, asked, "-", "not measured")
    interval = "" if test.low is None else f" (95 %: {test.low:+.4f} to {test.high:+.4f})"
    got = f"{test.mean_difference:+.4f}{interval}, {side} in {smaller.better} of {test.n}"
    verdict = _verdict(smaller.mean_difference < 0, test.p_value)
    return Claim(name, asked, got, verdict, test.mean_difference, test.p_value, test.n)


def _verdict(right: bool, p_value: float) -> Verdict:
    """Of a comparison: the right way round, and not by chance."""
    if not right:
        return "fails"
    return "holds" if p_value < SIGNIFICANT else "undecided"


def times_less(result: StudyResult, world: str, first: str, second: str, metric: str, factor: float) -> Claim:
    """The first method's metric is at least `factor` times less than the second's on the same seeds.

    value: the ratio of the medians, second over first, which a run that was disturbed does not move. Holds if it is at
    least the factor, and the Wilcoxon test of `factor` times the first against the second is significant.
    """
    name = f"{world}: {first} at least {factor:g} times below {second} in {_METRIC_NAMES[metric]}"
    asked = f"ratio of medians >= {factor:g}"
    one, two = result.common(world, first, second, metric)
    test = paired_test(factor * one, two)
    if test is None or not one.all():
        return Claim(name, asked, "-", "not measured")
    ratio, ratios = float(np.median(two) / np.median(one)), two / one
    got = f"{ratio:.2f} (seed by seed {ratios.min():.2f} to {ratios.max():.2f})"
    return Claim(name, asked, got, _verdict(ratio >= factor, test.p_value), ratio, test.p_value, test.n)


def not_comparable(claim: Claim) -> Claim:
    """The claim's measurement without a verdict: what it speaks of is not what was run."""
    return msgspec.structs.replace(claim, verdict="not comparable")


def tally(claims: list[Claim]) -> str:
    """ "21 claims: 18 hold, 2 fail, 1 undecided"."""
    words = {"holds": "hold", "fails": "fail"}
    counts: dict[str, int] = {}
    for claim in claims:
        counts[claim.verdict] = counts.get(claim.verdict, 0) + 1
    parts = [f"{count} {words.get(verdict, verdict)}" for verdict, count in counts.items()]
    return f"{len(claims)} claims: {', '.join(parts)}"


def claims_markdown(claims: list[Claim]) -> str:
    """A table, one row a claim."""
    lines = ["| verdict | claim | asked | got | p | runs |", "| --- | --- | --- | --- | --- | --- |"]
    for c in claims:
        verdict = c.verdict if c.verdict == "holds" else f"**{c.verdict}**"
        p = "" if c.p_value is None else f"{c.p_value:.2g}"
        lines.append(f"| {verdict} | {c.claim} | {c.asked} | {c.got} | {p} | {c.runs or ''} |")
    return "\n".join(lines) + "\n"


def claims_table(claims: list[Claim]) -> StudyTable:
    """The same for the report page, the verdict before each claim."""
    rows = [
        StudyRow(f"{c.verdict.upper()}: {c.claim} ({c.asked})", (c.value, c.p_value, c.runs or None))
        for c in claims
    ]
    note = (
        "got: the measurement, for a comparison the mean paired difference (its interval is in claims.json) "
        "or, where a factor is asked, the ratio of the medians. "
        "p: two-sided Wilcoxon signed-rank test on the same seeds. A comparison holds if the mean paired "
        f"difference has the right sign and p < {SIGNIFICANT}; right sign without that is undecided."
    )
    return StudyTable("Claims", ("got", "p", "runs"), tuple(rows), note)
