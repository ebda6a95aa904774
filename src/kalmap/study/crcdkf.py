"""Chen & Cheng 2012 again: complexity-reduced CDKF-SLAM in Bailey's world, tables 1 and 2 and figure 2."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from kalmap.records.config import Use
from kalmap.study.claims import Claim, better, bounded, mean_bounded, not_comparable
from kalmap.study.crcdkf_cases import Agreement, Maps, Plan, agreement, make_plan
from kalmap.study.crcdkf_report import write_report
from kalmap.study.montecarlo import Progress, run_cases
from kalmap.study.paper_report import Reproduction
from kalmap.study.published import CRCDKF, CRCDKF_STEPS
from kalmap.study.result import StudyResult

# the reduced and the full filter must agree to rounding; the paper's means may be missed by so much
_AGREE = 1e-9
_WITHIN = 0.15
# what the invariant filters must reach in set a: NEES, feature and position RMS in m
_INVARIANT = {"nees_mean": 4.0, "feature_rmse_m": 1.6, "position_rmse_m": 3.9}


class CrcdkfReproduction(Reproduction, frozen=True, kw_only=True):
    """agreement: of the full and the reduced filter, where both were run.

    comparable: the world was the paper's; else it was the package's own course, and claims about the paper's
    numbers are "not comparable".
    """

    agreement: Agreement | None
    comparable: bool


def reproduce_crcdkf(
    out: Path | str,
    runs: int = 50,
    workers: int | None = None,
    maps: Maps | None = None,
    progress: Progress | None = None,
    *,
    full_runs: int | None = None,
    full_b: bool = False,
    use: Use = "joint",
    laps: int | None = None,
) -> CrcdkfReproduction:
    """Run sets a and b and write what came out into the folder `out`.

    It then holds `crcdkf.md`, `crcdkf.csv`, `runs.csv`, `claims.json`, `report.html`, `manifest.json`,
    `figures/*.png` and the single runs in `runs/`.

    Seeds 1 to `runs`, the same for every method. maps: Bailey's maps (see `bailey_maps`); None falls back to
    the package's own course, and every page says so. full_runs: seeds of the full CDKF, which takes about a
    hundred times as long as the reduced one (it is numpy, and O(n^3)); None for all. full_b: the full CDKF in
    set b too. use: "joint" update of a frame's sightings, or "sequential", one after the other, as the
    paper has it. laps: other than two, for a quick look (then nothing is comparable with the paper).

    A stopped reproduction goes on where it was. Raises `ConfigError` for settings that make no sense.
    """
    out = Path(out)
    plan = make_plan(maps, runs, full_runs, use, full_b, laps)
    out.mkdir(parents=True, exist_ok=True)
    started = datetime.now(UTC)
    result = run_cases(plan.cases, workers=workers, out=out, progress=progress)
    agreed = agreement(plan, result)
    claims = crcdkf_claims(plan, result, agreed)
    files = write_report(out, plan, result, claims, started)
    return CrcdkfReproduction(
        result=result, claims=claims, files=files, agreement=agreed, comparable=plan.comparable
    )


def crcdkf_claims(plan: Plan, result: StudyResult, agreed: Agreement | None) -> list[Claim]:
    """Every target and every claim of the paper, with what came out."""
    a = plan.worlds["a"].name
    steps = result.summary(a, "cr-cdkf:additive")
    published = [
        bounded(
            f"{a}: control steps of two laps",
            steps.mean["steps"],
            low=CRCDKF_STEPS - 5,
            high=CRCDKF_STEPS + 5,
            runs=steps.runs,
        )
    ]
    for name in ("ekf", "cr-cdkf"):
        paper = CRCDKF["a", name].position_rms_m
        published.append(
            mean_bounded(
                result,
                a,
                f"{name}:additive",
                "position_rmse_m",
                low=(1 - _WITHIN) * paper,
                high=(1 + _WITHIN) * paper,
            )
        )
    for name in ("cr-cdkf", "ekf"):
        for metric, high in _INVARIANT.items():
            published.append(mean_bounded(result, a, f"{name}:invariant", metric, high=high))
    if not plan.comparable:
        published = [not_comparable(claim) for claim in published]
    return [published[0], _same_filter(a, agreed), *published[1:], *_comparisons(plan, result)]


def _same_filter(world: str, agreed: Agreement | None) -> Claim:
    text = f"{world}: full and reduced CDKF, last joint mean and covariance, largest relative difference"
    return bounded(text, agreed.worst if agreed else None, high=_AGREE, runs=1 if agreed else 0)


def _comparisons(plan: Plan, result: StudyResult) -> list[Claim]:
    """The paper's "better than", and ours of invariant over additive coordinates, in both sets."""
    claims = []
    for world in (plan.worlds["a"].name, plan.worlds["b"].name):
        cr, ekf, ukf = "cr-cdkf:additive", "ekf:additive", "cr-ukf:additive"
        for metric in ("position_rmse_m", "heading_rmse_deg", "feature_rmse_m"):
            claims.append(better(result, world, cr, ekf, metric))
        for metric in ("position_rmse_m", "feature_rmse_m"):
            claims.append(better(result, world, cr, ukf, metric))
        for name in ("cr-cdkf", "ekf"):
            for metric in ("nees_mean", "position_rmse_m", "feature_rmse_m"):
                claims.append(better(result, world, f"{name}:invariant", f"{name}:additive", metric))
    return claims
