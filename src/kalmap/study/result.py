"""The runs of a study, summed up: means over runs, RMS over runs, paired differences, curves over time."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence

import msgspec
import numpy as np

from kalmap.evaluation import PairedTest, paired_test
from kalmap.study.cases import METRICS, RunRecord
from kalmap.view import SetCurve, StudyCurve


class Summary(msgspec.Struct, frozen=True):
    """One method in one world.

    runs: how many were finished; failed: how many more the filter gave up. For each metric over the finished
    runs: mean, the root of the mean square (rms) and the standard error of the mean; None where unknown.
    """

    world: str
    method: str
    runs: int
    failed: int
    mean: dict[str, float | None]
    rms: dict[str, float | None]
    error_of_mean: dict[str, float | None]


class StudyResult(msgspec.Struct, frozen=True):
    """All runs, in the order in which the study was asked for them."""

    records: tuple[RunRecord, ...]

    def groups(self) -> list[tuple[str, str]]:
        """The pairs (world, method), in order."""
        return list(dict.fromkeys((record.world, record.method) for record in self.records))

    def of(self, world: str, method: str) -> list[RunRecord]:
        """The finished runs of a method in a world."""
        return [r for r in self.records if (r.world, r.method) == (world, method) and r.error is None]

    def values(self, world: str, method: str, metric: str) -> dict[int, float]:
        """seed -> metric of the finished runs that know it."""
        known = ((r.seed, r.metrics.get(metric)) for r in self.of(world, method))
        return {seed: value for seed, value in known if value is not None}

    def paired(self, world: str, first: str, second: str, metric: str) -> PairedTest | None:
        """First minus second over the seeds that both finished; None if there is none."""
        return paired_test(*self.common(world, first, second, metric))

    def common(self, world: str, first: str, second: str, metric: str) -> tuple[np.ndarray, np.ndarray]:
        """A metric of two methods, both (n,), over the seeds that both finished and know it for."""
        one, two = self.values(world, first, metric), self.values(world, second, metric)
        seeds = [seed for seed in one if seed in two]
        return np.array([one[s] for s in seeds]), np.array([two[s] for s in seeds])

    def summary(self, world: str, method: str) -> Summary:
        """Means, root mean squares and errors of the mean over the runs."""
        columns = {key: list(self.values(world, method, key).values()) for key in METRICS}
        failed = sum((r.world, r.method) == (world, method) and r.error is not None for r in self.records)
        return Summary(
            world=world,
            method=method,
            runs=len(self.of(world, method)),
            failed=failed,
            mean={key: float(np.mean(v)) if v else None for key, v in columns.items()},
            rms={key: float(np.sqrt(np.mean(np.square(v)))) if v else None for key, v in columns.items()},
            error_of_mean={
                key: float(np.std(v, ddof=1)) / math.sqrt(len(v)) if len(v) > 1 else None
                for key, v in columns.items()
            },
        )

    def summaries(self) -> list[Summary]:
        """One for each method in each world."""
        return [self.summary(*group) for group in self.groups()]

    def curve(self, world: str, method: str, label: str | None = None) -> StudyCurve | None:
        """RMS over the runs at each instant (figure 2 of Chen & Cheng 2012); None if no run was finished."""
        runs = self.of(world, method)
        if not runs:
            return None
        return StudyCurve(
            method=label or method,
            times=np.array(runs[0].times),
            position=np.sqrt(np.mean([r.position_squared for r in runs], axis=0)),
            heading=np.sqrt(np.mean([r.heading_squared for r in runs], axis=0)),
        )

    def set_curve(self, world: str, method: str) -> tuple[np.ndarray, SetCurve, np.ndarray] | None:
        """Means over the runs at each instant: times (F,) s, the map as a set, and (F,) the true number of features.

        None if no run was finished, or there is no true map.
        """
        runs = [record.sets for record in self.of(world, method) if record.sets is not None]
        if not runs:
            return None
        columns = (
            np.mean([getattr(run, name) for run in runs], axis=0)
            for name in ("estimated", "ospa", "localisation", "cardinality", "true")
        )
        *curve, true = columns
        return np.array(runs[0].times), SetCurve(method, *curve), true

    def failures(self) -> list[str]:
        """What made filters give up: a line for every world, seed and reason, with the methods it met."""
        methods: dict[tuple[str, int, str], list[str]] = {}
        for r in self.records:
            if r.error is not None:
                methods.setdefault((r.world, r.seed, r.error), []).append(r.method)
        return [
            f"{world}, seed {seed}, {', '.join(names) if len(names) < 4 else f'{len(names)} methods'}: {why}"
            for (world, seed, why), names in methods.items()
        ]


def summary_csv(result: StudyResult) -> str:
    """One row a world and method: for every metric `_mean` over the runs of each run's value (each run's own
    RMS, where it is one), `_rms` the root of the mean of its square over the runs, `_sem` the mean's error.
    """
    columns = ["world", "method", "runs", "failed"]
    columns += [f"{key}_{kind}" for key in METRICS for kind in ("mean", "rms", "sem")]
    rows = []
    for s in result.summaries():
        numbers = [part[key] for key in METRICS for part in (s.mean, s.rms, s.error_of_mean)]
        rows.append([s.world, s.method, s.runs, s.failed, *numbers])
    return csv_text(columns, rows)


def runs_csv(result: StudyResult) -> str:
    """One row a run."""
    rows = [
        [r.world, r.method, r.seed, *(r.metrics.get(key) for key in METRICS), r.error] for r in result.records
    ]
    return csv_text(["world", "method", "seed", *METRICS, "error"], rows)


def csv_text(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Comma-separated text; what is not known is an empty field."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return stream.getvalue()
