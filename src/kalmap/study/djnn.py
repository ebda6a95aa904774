"""Zhou, Zhao & Zhang 2010 again: dynamic joint nearest neighbour among moving objects, tables 1 and 2, figure 2."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from kalmap.study.claims import Claim, above, better, bounded, mean_bounded, times_less
from kalmap.study.djnn_cases import FEW, MANY, Plan, make_plan
from kalmap.study.djnn_report import write_report
from kalmap.study.montecarlo import Progress, run_cases
from kalmap.study.paper_report import Reproduction
from kalmap.study.published import DJNN
from kalmap.study.result import StudyResult

_ACCURACY, _TIME, _FEATURES = "association_accuracy", "association_ms", "landmarks"
_AT_ONCE = "association_accuracy_at_once"
_MOST_FEATURES, _JCBB_FEATURES, _TIMES = 300, 400, 5.0
# what a local region may change of a run's accuracy: nothing that a table would show
_SAME = 0.001
_COMPARED = ("nn", "jcbb", "djnn")


def reproduce_djnn(
    out: Path | str,
    runs: int = 20,
    workers: int | None = None,
    progress: Progress | None = None,
    *,
    mda_runs: int | None = None,
    methods: Sequence[str] | None = None,
    world: Mapping[str, Any] | None = None,
) -> Reproduction:
    """Run NN, JCBB, MDA, DJNN and its parts among 10 and 50 movers and write what came out into the folder `out`.

    It then holds `djnn.md`, `djnn.csv`, `runs.csv`, `claims.json`, `report.html`, `manifest.json`, `figures/*.png`
    and the single runs in `runs/`.

    Seeds 1 to `runs`, the same for every method. mda_runs: seeds of MDA with all features, which takes about
    a minute a run; None for at most six. methods: names, None for all of `kalmap.study.djnn_cases.GROUPS`.
    world: fields of `World` other than the study's, for a quick look (then every page says so).

    A stopped reproduction goes on where it was. Raises `ConfigError` for settings that make no sense.
    """
    out = Path(out)
    plan = make_plan(runs, mda_runs, methods, world)
    out.mkdir(parents=True, exist_ok=True)
    started = datetime.now(UTC)
    result = run_cases(plan.cases, workers=workers, out=out, progress=progress)
    claims = djnn_claims(plan, result)
    return Reproduction(result=result, claims=claims, files=write_report(out, plan, result, claims, started))


def djnn_claims(plan: Plan, result: StudyResult) -> list[Claim]:
    """Every target and every order that the paper states, with what came out."""
    few, many = (plan.worlds[movers].name for movers in (FEW, MANY))
    return [
        *_said("asked", _asked(result, many)),
        *_said("paper, table 1", _table_1(result, few)),
        *_said("paper, table 2", _table_2(result, many)),
        *_said("paper, in words", _words(result, many)),
        *_said("without the tentative set's hindsight", _at_once(result, many)),
        *_said("kalmap's own", _own(result, many)),
    ]


def _said(whose: str, claims: list[Claim]) -> list[Claim]:
    """The claims with who made them."""
    return [msgspec.structs.replace(claim, claim=f"{claim.claim} [{whose}]") for claim in claims]


def _asked(result: StudyResult, many: str) -> list[Claim]:
    return [
        above(result, many, "djnn", "nn", _ACCURACY),
        above(result, many, "djnn", "jcbb", _ACCURACY),
        mean_bounded(result, many, "djnn", _FEATURES, high=_MOST_FEATURES),
        mean_bounded(result, many, "jcbb", _FEATURES, low=_JCBB_FEATURES),
        times_less(result, many, "djnn", "nn", _TIME, _TIMES),
        times_less(result, many, "djnn", "jcbb", _TIME, _TIMES),
    ]


def _table_1(result: StudyResult, few: str) -> list[Claim]:
    """The three lie close together: nearer than what the paper calls a difference, that of its table 2."""
    accuracies = [result.summary(few, method).mean[_ACCURACY] for method in _COMPARED]
    known = [value for value in accuracies if value is not None]
    spread = max(known) - min(known) if len(known) == len(_COMPARED) else None
    paper = [DJNN[MANY, method].accuracy for method in _COMPARED]
    runs = min(result.summary(few, method).runs for method in _COMPARED)
    text = f"{few}: largest difference of nn, jcbb and djnn in mean accuracy"
    return [
        bounded(text, spread, high=max(paper) - min(paper), runs=runs),
        above(result, few, "jcbb", "djnn", _ACCURACY),
        above(result, few, "djnn", "nn", _ACCURACY),
        above(result, few, "jcbb", "nn", _ACCURACY),
        *_order_in_time(result, few),
    ]


def _table_2(result: StudyResult, many: str) -> list[Claim]:
    return [
        above(result, many, "jcbb", "nn", _ACCURACY),
        better(result, many, "djnn", "jcbb", _FEATURES),
        *_order_in_time(result, many),
    ]


def _order_in_time(result: StudyResult, world: str) -> list[Claim]:
    return [better(result, world, "djnn", "nn", _TIME), better(result, world, "nn", "jcbb", _TIME)]


def _at_once(result: StudyResult, many: str) -> list[Claim]:
    """The asked comparisons, had a sighting that founds a tentative feature to be judged there and then."""
    return [above(result, many, "djnn", "nn", _AT_ONCE), above(result, many, "djnn", "jcbb", _AT_ONCE)]


def _words(result: StudyResult, many: str) -> list[Claim]:
    """What each part is for, and what the paper expects of MDA, which it did not run."""
    return [
        above(result, many, "nn + interference", "nn", _ACCURACY),
        above(result, many, "nn + tentative", "nn", _ACCURACY),
        better(result, many, "nn + tentative", "nn", _FEATURES),
        better(result, many, "nn + local", "nn", _TIME),
        _unchanged(result, many, "nn + local", "nn"),
        above(result, many, "mda", "nn", _ACCURACY),
        better(result, many, "djnn", "mda", _TIME),
    ]


def _unchanged(result: StudyResult, world: str, first: str, second: str) -> Claim:
    one, two = result.common(world, first, second, _ACCURACY)
    text = f"{world}: {first} and {second}, largest difference in accuracy of a seed"
    return bounded(text, float(np.abs(one - two).max()) if len(one) else None, high=_SAME, runs=len(one))


def _own(result: StudyResult, many: str) -> list[Claim]:
    return [
        mean_bounded(result, many, "djnn, own gates", _FEATURES, high=_MOST_FEATURES),
        mean_bounded(result, many, "djnn, existence", _FEATURES, high=_MOST_FEATURES),
        above(result, many, "djnn, own gates", "djnn", _ACCURACY),
        above(result, many, "djnn, existence", "djnn, own gates", _ACCURACY),
    ]
