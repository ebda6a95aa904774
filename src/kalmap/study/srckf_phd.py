"""Yan et al. 2014 again: SRCKF-PHD-SLAM against RB-PHD-SLAM, figures 2, 3, 4 and 6 and table 2."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from kalmap.study.claims import Claim, above, better, mean_bounded, not_comparable
from kalmap.study.montecarlo import Progress, run_cases
from kalmap.study.paper_report import Reproduction
from kalmap.study.result import StudyResult
from kalmap.study.srckf_phd_cases import CAR_PARK, OWN_RB, OWN_SRCKF, RB, SRCKF, Plan, make_plan
from kalmap.study.srckf_phd_report import write_report

_POSITION, _TIME, _FEATURES = "position_rmse_m", "runtime_s", "landmarks"
_OSPA, _NUMBER = "ospa_course_m", "cardinality_course_error"
_MOST_SECONDS, _MOST_CAR_ERROR, _POLES = 1.0, 0.6, (14, 16)


def reproduce_srckf_phd(
    out: Path | str,
    runs: int = 10,
    workers: int | None = None,
    progress: Progress | None = None,
    *,
    car_park: Path | None = None,
    world: Mapping[str, Any] | None = None,
) -> Reproduction:
    """Run both filters, as published and as kalmap has them, at clutter 1, 2 and 3, and write what came out.

    The folder `out` then holds `srckf-phd.md`, `srckf-phd.csv`, `runs.csv`, `claims.json`, `report.html`,
    `manifest.json`, `figures/*.png` and the single runs in `runs/`.

    Seeds 1 to `runs`, the same for every method. car_park: the folder of that log, None to leave it out. world: fields
    of `World` other than the study's, for a quick look (then every page says so).

    A stopped reproduction goes on where it was. Raises `ConfigError` for settings that make no sense.
    """
    out = Path(out)
    plan = make_plan(runs, car_park, world)
    out.mkdir(parents=True, exist_ok=True)
    started = datetime.now(UTC)
    result = run_cases(plan.cases, workers=workers, out=out, progress=progress)
    claims = srckf_phd_claims(plan, result)
    return Reproduction(result=result, claims=claims, files=write_report(out, plan, result, claims, started))


def srckf_phd_claims(plan: Plan, result: StudyResult) -> list[Claim]:
    """Every order that the paper states and every target, with what came out."""
    names = [world.name for world in plan.worlds.values()]
    claims = []
    for name in names:
        claims += _said("paper", _in_world(result, name))
    for name in names:
        claims += _said("asked", [mean_bounded(result, name, SRCKF, _TIME, high=_MOST_SECONDS)])
        claims += _said("kalmap's own", _own(result, name))
    if plan.altered:
        claims = [not_comparable(claim) for claim in claims]
    if plan.car_park is not None:
        claims += _car_park(result)
    return claims


def _said(whose: str, claims: list[Claim]) -> list[Claim]:
    """The claims with who made them."""
    return [msgspec.structs.replace(claim, claim=f"{claim.claim} [{whose}]") for claim in claims]


def _in_world(result: StudyResult, world: str) -> list[Claim]:
    """Figures 2, 4 and 3, and that the better filter takes longer, table 2."""
    orders = [better(result, world, SRCKF, RB, metric) for metric in (_POSITION, _OSPA, _NUMBER)]
    return [*orders, above(result, world, SRCKF, RB, _TIME)]


def _own(result: StudyResult, world: str) -> list[Claim]:
    """The same order under the better proposal and weighting, and what these are worth to either filter."""
    orders = [better(result, world, OWN_SRCKF, OWN_RB, metric) for metric in (_POSITION, _OSPA, _NUMBER)]
    pairs = ((OWN_SRCKF, SRCKF), (OWN_RB, RB))
    gains = [
        better(result, world, own, paper, metric) for own, paper in pairs for metric in (_POSITION, _OSPA)
    ]
    return [*orders, *gains]


def _car_park(result: StudyResult) -> list[Claim]:
    low, high = _POLES
    bounds = [
        claim
        for method in (SRCKF, OWN_SRCKF)
        for claim in (
            mean_bounded(result, CAR_PARK, method, _POSITION, high=_MOST_CAR_ERROR),
            mean_bounded(result, CAR_PARK, method, _FEATURES, low=low, high=high),
        )
    ]
    return [
        *_said("paper", [better(result, CAR_PARK, SRCKF, RB, _POSITION)]),
        *_said("asked", bounds),
        *_said("kalmap's own", [better(result, CAR_PARK, OWN_SRCKF, OWN_RB, _POSITION)]),
    ]
