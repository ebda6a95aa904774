import math

import msgspec
import numpy as np
import pytest

from kalmap.records import AssociationConfig, ConfigError, FilterConfig, KalmapError
from kalmap.simulate import simulate, world_by_name
from kalmap.study import (
    Case,
    Method,
    RunRecord,
    StudyResult,
    compare_seeds,
    paired_rows,
    run_cases,
    run_study,
    runs_csv,
    summary_csv,
)
from kalmap.study.cases import METRICS, run_case
from kalmap.study.store import Store, case_key
from kalmap.study.workers import carry_out

EKF = Method("ekf", FilterConfig(name="ekf", coordinates="additive"))
CDKF = Method("cr-cdkf", FilterConfig(name="cr-cdkf"))
# clocks differ from run to run
CLOCKS = {"runtime_s", "step_ms_mean", "step_ms_p99"}


@pytest.fixture(scope="module")
def world():
    return msgspec.structs.replace(world_by_name("course-35"), laps=1)


@pytest.fixture(scope="module")
def study(world, tmp_path_factory):
    out = tmp_path_factory.mktemp("study")
    return run_study([world], [EKF, CDKF], [1, 2, 3], workers=1, out=out), out


def timeless(result):
    return [
        msgspec.structs.replace(r, metrics={k: v for k, v in r.metrics.items() if k not in CLOCKS})
        for r in result.records
    ]


def test_every_method_meets_every_seed_and_its_numbers_are_the_runs_own(study, world):
    result, _ = study
    assert [(r.method, r.seed) for r in result.records] == [
        (m, s) for m in ("ekf", "cr-cdkf") for s in (1, 2, 3)
    ]
    for record in result.records:
        assert set(record.metrics) == set(METRICS) and record.error is None
        assert record.metrics["position_rmse_m"] > 0 and record.metrics["steps"] > 8000
        assert len(record.times) == len(record.position_squared) == len(record.heading_squared) == 200
    one = run_case(Case(world, CDKF, 2))
    assert one.position_squared == result.of(world.name, "cr-cdkf")[1].position_squared


def test_methods_are_paired_the_log_depends_on_world_and_seed_alone(study, world):
    result, _ = study
    ekf, cdkf = (result.of(world.name, name) for name in ("ekf", "cr-cdkf"))
    for a, b in zip(ekf, cdkf, strict=True):
        assert (a.seed, a.times) == (b.seed, b.times)
    first, again = simulate(world, 2), simulate(world, 2)
    for x, y in zip(first, again, strict=True):
        np.testing.assert_array_equal(x.values, y.values)
    test = result.paired(world.name, "cr-cdkf", "ekf", "position_rmse_m")
    differences = [
        b.metrics["position_rmse_m"] - a.metrics["position_rmse_m"] for a, b in zip(ekf, cdkf, strict=True)
    ]
    assert test.n == 3 and test.mean_difference == pytest.approx(np.mean(differences))


def test_two_workers_give_what_one_gives(study, world):
    result, _ = study
    told = []
    parallel = run_study(
        [world], [EKF, CDKF], [1, 2, 3], workers=2, progress=lambda done, total: told.append((done, total))
    )
    assert timeless(parallel) == timeless(result)
    assert told == [(k, 6) for k in range(7)]


def test_a_study_goes_on_where_it_was(study, world, monkeypatch):
    result, out = study
    ran = []
    real = run_case
    monkeypatch.setattr("kalmap.study.montecarlo.run_case", lambda case: (ran.append(case), real(case))[1])
    told = []
    again = run_study([world], [EKF, CDKF], [1, 2, 3], workers=1, out=out, progress=lambda *p: told.append(p))
    assert again == result and not ran and told == [(6, 6)]
    more = run_study([world], [EKF, CDKF], [3, 4], workers=1, out=out)
    assert [(case.method.name, case.seed) for case in ran] == [("ekf", 4), ("cr-cdkf", 4)]
    assert len(more.records) == 4
    ran.clear()
    sequential = Method("cr-cdkf", FilterConfig(name="cr-cdkf", use="sequential"))
    run_study([world], [sequential], [1], workers=1, out=out)
    noisier = msgspec.structs.replace(world, sigma_range=0.2)
    run_study([noisier], [CDKF], [1], workers=1, out=out)
    assert len(ran) == 2


def test_a_stopped_study_keeps_what_was_finished(world, tmp_path, monkeypatch):
    real = run_case

    def stop_at_two(case):
        if case.seed == 2:
            raise KeyboardInterrupt
        return real(case)

    monkeypatch.setattr("kalmap.study.montecarlo.run_case", stop_at_two)
    with pytest.raises(KeyboardInterrupt):
        run_study([world], [EKF], [1, 2, 3], workers=1, out=tmp_path)
    assert len(list((tmp_path / "runs").glob("*.json"))) == 1
    assert not list((tmp_path / "runs").glob(".*"))


def test_a_damaged_file_is_run_again(world, tmp_path):
    case = Case(world, EKF, 1)
    first = run_cases([case], workers=1, out=tmp_path)
    (path,) = (tmp_path / "runs").iterdir()
    path.write_bytes(path.read_bytes()[:100])
    assert Store(tmp_path / "runs").read(case) is None
    assert timeless(run_cases([case], workers=1, out=tmp_path)) == timeless(first)
    assert Store(tmp_path / "runs").read(case) is not None


def test_the_key_follows_everything_a_run_depends_on(world):
    case = Case(world, EKF, 1)
    others = [
        Case(world, EKF, 2),
        Case(world, Method("ekf", FilterConfig(name="ekf")), 1),
        Case(msgspec.structs.replace(world, laps=2), EKF, 1),
        Case(msgspec.structs.replace(world, landmarks=world.landmarks + 1e-9), EKF, 1),
        Case(world, EKF, 1, AssociationConfig(method="likelihood")),
        Case(world, EKF, 1, keep_joint=True),
    ]
    assert len({case_key(c) for c in [case, *others]}) == 7
    assert case_key(Case(world, Method("another name", EKF.filter), 1)) == case_key(case)


def test_the_joint_state_is_kept_where_asked_for(world, tmp_path):
    case = Case(world, EKF, 1, keep_joint=True)
    (record,) = run_cases([case], workers=1, out=tmp_path).records
    n = len(record.joint.mean)
    assert n == 3 + 2 * record.metrics["landmarks"] and np.shape(record.joint.covariance) == (n, n)
    assert Store(tmp_path / "runs").read(case) == record


def test_unknown_association_is_judged_too(world):
    record = run_case(Case(world, CDKF, 1, AssociationConfig(method="likelihood")))
    assert record.metrics["association_accuracy"] > 0.9


@pytest.mark.parametrize(
    ("methods", "seeds", "workers", "says"),
    [
        ([EKF, EKF], [1], 1, "twice"),
        ([EKF], [1, 1], 1, "twice"),
        ([EKF], [-1], 1, "seed"),
        ([EKF], [1], 0, "workers"),
        ([Method("x", FilterConfig(name="ekf", scope="full"))], [1], 1, "scope"),
    ],
)
def test_what_makes_no_sense_is_refused_before_the_first_run(world, methods, seeds, workers, says):
    with pytest.raises(ConfigError, match=says):
        run_study([world], methods, seeds, workers=workers)


def record(method, seed, position, *, error=None, world="w"):
    metrics = {} if error else dict.fromkeys(METRICS, 1.0) | {"position_rmse_m": position}
    squares = [] if error else [position**2, 4.0 * position**2]
    return RunRecord(world, method, seed, metrics, [0.0, 1.0] if not error else [], squares, squares, error)


@pytest.fixture
def fabricated():
    return StudyResult(
        (
            record("a", 1, 3.0),
            record("a", 2, 4.0),
            record("a", 3, 0.0, error="not positive definite, step 7"),
            record("b", 1, 2.0),
            record("b", 2, 2.0),
            record("b", 3, 9.0),
        )
    )


def test_both_means_over_runs_and_failures_are_counted_not_averaged(fabricated):
    a = fabricated.summary("w", "a")
    assert (a.runs, a.failed) == (2, 1)
    assert a.mean["position_rmse_m"] == pytest.approx(3.5)
    assert a.rms["position_rmse_m"] == pytest.approx(math.sqrt(12.5))
    assert a.error_of_mean["position_rmse_m"] == pytest.approx(0.5)
    assert fabricated.failures() == ["w, seed 3, a: not positive definite, step 7"]
    assert fabricated.summary("w", "b").error_of_mean["position_rmse_m"] == pytest.approx(7 / 3)


def test_pairs_are_seeds_that_both_finished(fabricated):
    test = fabricated.paired("w", "b", "a", "position_rmse_m")
    assert (test.n, test.mean_difference, test.better) == (2, -1.5, 2)
    assert fabricated.paired("w", "b", "nobody", "position_rmse_m") is None
    first, second = paired_rows(fabricated, "position_rmse_m")
    assert first.test is None and first.failed == 1
    assert second.method == "b" and second.test == test


def test_curves_are_the_root_mean_square_over_runs(fabricated):
    curve = fabricated.curve("w", "a")
    np.testing.assert_allclose(curve.position, [math.sqrt(12.5), math.sqrt(50.0)])
    assert fabricated.curve("w", "nobody") is None


def test_csv_names_both_means(fabricated):
    head, *rows = summary_csv(fabricated).splitlines()
    assert head.startswith(
        "world,method,runs,failed,position_rmse_m_mean,position_rmse_m_rms,position_rmse_m_sem"
    )
    assert len(rows) == 2 and rows[0].startswith("w,a,2,1,3.5,3.5355")
    runs = runs_csv(fabricated).splitlines()
    assert len(runs) == 7 and runs[3].endswith('not positive definite, step 7"')


def test_paired_rows_want_one_world():
    result = StudyResult((record("a", 1, 1.0), record("a", 1, 1.0, world="v")))
    with pytest.raises(ConfigError, match="one world"):
        paired_rows(result, "position_rmse_m")


def test_compare_seeds_is_a_study_in_one_world(study, world):
    result, out = study
    assert compare_seeds(world, [EKF, CDKF], [1, 2, 3], workers=1, out=out) == result


def die(task):
    import os

    os._exit(3)


def test_a_dead_worker_is_a_kalmap_error():
    with pytest.raises(KalmapError, match="worker process died"):
        list(carry_out(die, [1, 2], workers=2))
