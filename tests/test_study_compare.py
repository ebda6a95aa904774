import msgspec
import pytest

from kalmap.records import AssociationConfig, ConfigError, FilterConfig
from kalmap.simulate import simulate, world_by_name
from kalmap.slam import FILTERS
from kalmap.study import Method, compare_methods, parse_method, parse_methods


@pytest.fixture(scope="module")
def log():
    return simulate(msgspec.structs.replace(world_by_name("course-35"), laps=1), 1)


def test_parse_method_takes_names_and_suffixes():
    assert parse_method("ekf") == Method("ekf", FilterConfig(name="ekf"))
    chosen = FilterConfig(name="cr-cdkf", coordinates="additive", use="sequential")
    assert parse_method(" CR-CDKF:Additive:sequential ") == Method("cr-cdkf:additive:sequential", chosen)
    base = FilterConfig(name="cr-cdkf", coordinates="additive", use="sequential", scope="reduced")
    assert parse_method("cdkf", base).filter == FilterConfig(
        name="cdkf", coordinates="additive", use="sequential"
    )
    assert parse_method("cdkf:invariant:joint", base).filter == FilterConfig(name="cdkf")


def test_parse_method_takes_an_association():
    given = AssociationConfig(gate=0.99, merge=False)
    assert parse_method("ekf", association=given).association is None
    method = parse_method("ekf:DJNN:additive", association=given)
    assert method.association == AssociationConfig(method="djnn", gate=0.99, merge=False)
    assert method.filter == FilterConfig(name="ekf", coordinates="additive")
    assert parse_method("ekf:jcbb").association == AssociationConfig(method="jcbb")
    with pytest.raises(ConfigError, match="djnn and jcbb contradict"):
        parse_method("ekf:djnn:jcbb")


def test_parse_method_lists_what_exists():
    with pytest.raises(ConfigError) as problem:
        parse_method("kdf")
    assert all(name in str(problem.value) for name in FILTERS)
    with pytest.raises(ConfigError, match=r"unknown suffix 'fast'.*:additive.*:sequential"):
        parse_method("ekf:fast")
    with pytest.raises(ConfigError, match="contradict"):
        parse_method("ekf:additive:invariant")
    for text in ("", ":additive", "ekf:"):
        with pytest.raises(ConfigError):
            parse_method(text)


def test_a_method_asked_for_twice_is_refused():
    with pytest.raises(ConfigError, match="twice"):
        parse_methods(["ekf", "EKF"])


def test_methods_run_on_the_same_log(log):
    told = []
    methods = parse_methods(["ekf:additive", "cr-cdkf"])
    ekf, cdkf = compare_methods(log, methods, progress=lambda name, time: told.append((name, time)))
    assert (ekf.method, cdkf.method) == ("ekf:additive", "cr-cdkf")
    assert {name for name, _ in told} == {"ekf:additive", "cr-cdkf"}
    for one in (ekf, cdkf):
        assert one.error is None and one.metrics["position_rmse_m"] > 0 and one.metrics["landmarks"] == 35
        assert one.config.sensor == log.defaults.sensor
    assert ekf.metrics["position_rmse_m"] != cdkf.metrics["position_rmse_m"]


def test_one_failing_does_not_stop_the_others(log):
    impossible = Method("impossible", FilterConfig(name="ekf", scope="full"))
    failed, fine = compare_methods(log, [impossible, Method("ekf", FilterConfig(name="ekf"))])
    assert isinstance(failed.error, ConfigError) and failed.outcome is None and failed.metrics is None
    assert fine.error is None and fine.metrics["steps"] > 0


def test_an_error_on_the_way_leaves_what_there_was(log):
    def broken(skip):
        for number, event in enumerate(log.open(skip)):
            yield msgspec.structs.replace(event, time=-1.0) if number == 500 else event

    bad = msgspec.structs.replace(log, open=broken)
    (one,) = compare_methods(bad, parse_methods(["ekf"]))
    assert one.error is not None and "late" in str(one.error)
    assert 0 < one.metrics["frames"] < 500


def test_an_interrupted_method_is_the_last(log):
    def stopped(skip):
        for number, event in enumerate(log.open(skip)):
            if number == 100:
                raise KeyboardInterrupt
            yield event

    results = compare_methods(msgspec.structs.replace(log, open=stopped), parse_methods(["ekf", "cr-cdkf"]))
    assert [one.method for one in results] == ["ekf"] and results[0].outcome.interrupted


def test_another_configuration_keeps_all_but_the_filter(log):
    config = msgspec.structs.replace(
        log.defaults, sensor=msgspec.structs.replace(log.defaults.sensor, sigma_range=0.5)
    )
    (one,) = compare_methods(log, parse_methods(["cr-ckf"]), config=config)
    assert one.config == msgspec.structs.replace(config, filter=FilterConfig(name="cr-ckf"))
