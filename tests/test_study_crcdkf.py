import json

import numpy as np
import pytest

from kalmap.records import ConfigError
from kalmap.simulate import world_by_name
from kalmap.study import RunRecord, StudyResult, bailey_maps, reproduce_crcdkf
from kalmap.study.cases import METRICS, Joint
from kalmap.study.claims import better, bounded, claims_markdown, not_comparable, tally
from kalmap.study.crcdkf import crcdkf_claims
from kalmap.study.crcdkf_cases import Agreement, agreement, make_plan
from kalmap.study.crcdkf_report import crcdkf_report


def fake_maps(name):
    world = world_by_name("course-35")
    return world.landmarks, world.waypoints


def fabricate(plan, value, joint=lambda case: None):
    """Records of a plan's cases; value(world, method, seed, metric) -> number."""
    records = []
    for case in plan.cases:
        key = (case.world.name, case.method.name, case.seed)
        metrics = {metric: value(*key, metric) for metric in METRICS}
        records.append(RunRecord(*key, metrics, [0.0], [1.0], [1.0], joint=joint(case)))
    return StudyResult(tuple(records))


def as_published(world, method, seed, metric):
    """What the paper and the prototype say, a little different in each run."""
    invariant, wobble = "invariant" in method, 1.0 + 0.01 * seed
    ekf = method.startswith("ekf")
    if metric == "steps":
        return 17381.0
    if metric == "nees_mean":
        return (3.4 if invariant else 9.0) * wobble
    worse = (1.06 if ekf else 1.0 if "cdkf" in method else 1.01) * wobble
    return (
        {"position_rmse_m": 3.6, "feature_rmse_m": 2.6}.get(metric, 1.0) * worse * (0.5 if invariant else 1)
    )


def test_claims_hold_on_numbers_like_the_papers():
    plan = make_plan(fake_maps, runs=8, full_runs=None, use="joint", full_b=False)
    claims = crcdkf_claims(plan, fabricate(plan, as_published), Agreement(1e-13, 1e-12, 73))
    assert {claim.verdict for claim in claims} == {"holds"}
    assert tally(claims) == f"{len(claims)} claims: {len(claims)} hold"


def test_claims_fail_on_numbers_that_are_not():
    def opposite(world, method, seed, metric):
        if metric == "steps":
            return 17000.0
        return 30.0 - as_published(world, method, seed, metric)

    plan = make_plan(fake_maps, runs=8, full_runs=None, use="joint", full_b=False)
    claims = crcdkf_claims(plan, fabricate(plan, opposite), Agreement(1e-13, 1e-3, 73))
    assert {claim.verdict for claim in claims} == {"fails"}
    text = claims_markdown(claims)
    assert text.count("**fails**") == len(claims) and "| holds |" not in text


def test_bounds_include_their_ends_and_nothing_measured_is_said():
    assert bounded("x", 1.0, low=1.0, high=2.0).verdict == "holds"
    assert bounded("x", 2.0000001, low=1.0, high=2.0).verdict == "fails"
    assert bounded("x", None, high=2.0).verdict == "not measured"


def test_a_difference_that_may_be_chance_is_undecided():
    plan = make_plan(fake_maps, runs=4, full_runs=0, use="joint", full_b=False)

    def chance(world, method, seed, metric):
        return (-2.0 if seed == 1 else 0.5) * (method == "cr-cdkf:additive") + 10.0

    claim = better(
        fabricate(plan, chance), "bailey-35", "cr-cdkf:additive", "ekf:additive", "position_rmse_m"
    )
    assert claim.verdict == "undecided" and claim.p_value > 0.05 and claim.runs == 4
    assert "lower in 1 of 4" in claim.got and not_comparable(claim).verdict == "not comparable"


def test_agreement_is_the_largest_relative_difference():
    plan = make_plan(fake_maps, runs=1, full_runs=1, use="joint", full_b=False)

    def joint(case):
        off = 1e-6 if case.method.name == "cdkf:additive" else 0.0
        return Joint([10.0 + off, 1.0], [[4.0, 0.0], [0.0, 1.0 + off]]) if case.keep_joint else None

    found = agreement(plan, fabricate(plan, as_published, joint))
    assert found.mean == pytest.approx(1e-7, rel=1e-3) and found.covariance == pytest.approx(1e-6, rel=1e-3)
    assert found.worst == found.covariance and found.size == 2
    assert agreement(plan, fabricate(plan, as_published)) is None


def test_the_full_filter_has_its_own_number_of_runs_and_stands_in_the_table():
    plan = make_plan(fake_maps, runs=3, full_runs=2, use="sequential", full_b=False)
    count = {}
    for case in plan.cases:
        key = (case.world.name, case.method.name)
        count[key] = count.get(key, 0) + 1
        assert case.method.filter.use == "sequential"
    assert count["bailey-35", "cdkf:additive"] == 2 and count["bailey-35", "ekf:additive"] == 3
    assert ("bailey-70", "cdkf:additive") not in count and ("bailey-70", "cr-ckf:invariant") in count
    result = fabricate(plan, as_published)
    text = crcdkf_report(plan, result, []).markdown()
    rows = [line for line in text.splitlines() if line.startswith("| cdkf:additive")]
    (row,) = rows
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[:5] == ["cdkf:additive", "2", "3.654", "3.819", "0.957"]
    assert "one after the other, as in the paper" in text
    assert "bailey-70, 70 features, 0.6 m/s, 6 deg" in text


@pytest.mark.parametrize(
    "settings", [{"runs": 0}, {"runs": 2, "full_runs": 3}, {"use": "both"}, {"full_runs": -1}]
)
def test_settings_that_make_no_sense_are_refused(settings):
    wanted = {"runs": 2, "full_runs": None, "use": "joint", "full_b": False} | settings
    with pytest.raises(ConfigError):
        make_plan(None, **wanted)


def test_without_the_map_the_own_course_is_driven_and_every_page_says_so(tmp_path):
    assert bailey_maps(tmp_path) is None
    told = []
    done = reproduce_crcdkf(
        tmp_path,
        runs=1,
        workers=1,
        maps=None,
        progress=lambda *p: told.append(p),
        full_runs=0,
        laps=1,
    )
    assert not done.comparable and told[-1] == (16, 16)
    assert {r.world for r in done.result.records} == {"course-35", "course-70"}
    text = (tmp_path / "crcdkf.md").read_text()
    assert "THE PAPER'S MAP IS MISSING" in text and "4.007" not in text
    page = (tmp_path / "report.html").read_text()
    assert "PAPER&#x27;S MAP IS MISSING" in page or "PAPER&#39;S MAP IS MISSING" in page
    claims = json.loads((tmp_path / "claims.json").read_text())
    assert claims["comparable"] is False
    verdicts = [claim["verdict"] for claim in claims["claims"]]
    assert verdicts[0] == "not comparable" and verdicts[1] == "not measured"
    methods = json.loads((tmp_path / "manifest.json").read_text())["config"]["methods"]
    assert {each["association"]["method"] for each in methods.values()} == {"known"}  # the world's own
    assert set(done.files) >= {"crcdkf.md", "crcdkf.csv", "runs.csv", "claims.json", "report.html"}
    assert all(path.is_file() for path in done.files.values())
    assert len(list((tmp_path / "figures").glob("*.png"))) == 4
    assert len(list((tmp_path / "runs").glob("*.json"))) == 16


def test_a_shorter_drive_on_the_papers_map_is_not_comparable_either():
    plan = make_plan(fake_maps, runs=1, full_runs=0, use="joint", full_b=False, laps=1)
    assert not plan.comparable
    claims = crcdkf_claims(plan, fabricate(plan, as_published), None)
    assert claims[0].verdict == "not comparable" and claims[1].verdict == "not measured"
    assert np.unique([c.verdict for c in claims[2:9]]).tolist() == ["not comparable"]
