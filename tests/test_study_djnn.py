"""The reproduction of Zhou, Zhao & Zhang 2010: its cases, claims, files, and that it goes on where it was."""

from __future__ import annotations

import json
import os

import msgspec
import numpy as np
import pytest
from click.testing import CliRunner

from kalmap.cli import reproduce
from kalmap.records import AssociationConfig, ConfigError
from kalmap.simulate import world_by_name
from kalmap.study import Case, Method, RunRecord, StudyResult, reproduce_djnn, run_cases
from kalmap.study.cases import METRICS, run_case
from kalmap.study.claims import Claim, above, times_less
from kalmap.study.djnn import djnn_claims
from kalmap.study.djnn_cases import FEW, GROUPS, MANY, OWN, PAPER, PARTS, djnn_case, make_plan
from kalmap.study.djnn_report import djnn_figures, djnn_report
from kalmap.study.store import case_key
from test_study_crcdkf import fabricate

# few frames, far apart, with better odometry
TINY = {"observe_every": 200, "sigma_speed": 0.05, "sigma_steering_deg": 0.5}
QUICK = ["nn", "jcbb", "djnn"]


def as_hoped(world, method, seed, metric):
    """What the paper says and hopes, in our sizes, a little different in each run."""
    wobble, few = 1.0 + 0.001 * seed, world == "djnn-10"
    name, _, part = method.partition(" + ")
    accuracy = {"nn": 0.800, "jcbb": 0.805, "mda": 0.806, "djnn": 0.82, "djnn, own gates": 0.85}.get(
        name, 0.9
    )
    if few:
        accuracy = {"nn": 0.930, "djnn": 0.934, "jcbb": 0.937}.get(name, 0.95)
    accuracy += 0.01 * (part in ("interference", "tentative"))
    time = {"nn": 2.0, "jcbb": 3.0, "mda": 60.0}.get(name, 0.2)
    few_features = name.startswith("djnn") or part == "tentative"
    return {
        "association_accuracy": accuracy * wobble,
        "association_accuracy_at_once": (accuracy - 0.001) * wobble,
        "association_ms": (0.2 if part == "local" else time) * wobble,
        "landmarks": (280.0 if few_features else 1800.0) + seed,
    }.get(metric, 1.0)


def records(values):
    """One record a (method, seed, accuracy) in a world w; the time is ten times the accuracy."""
    return StudyResult(
        tuple(
            RunRecord(
                "w", m, s, dict.fromkeys(METRICS, a) | {"association_ms": 10.0 * a}, [0.0], [1.0], [1.0]
            )
            for m, s, a in values
        )
    )


def test_claims_hold_on_numbers_like_the_papers():
    plan = make_plan(8)
    claims = djnn_claims(plan, fabricate(plan, as_hoped))
    assert {claim.claim: claim.verdict for claim in claims if claim.verdict != "holds"} == {}
    whose = [claim.claim.rpartition("[")[2].rstrip("]") for claim in claims]
    assert whose.count("asked") == 6 and set(whose) > {"paper, table 1", "paper, table 2", "paper, in words"}


def test_claims_fail_on_numbers_that_are_the_other_way_round():
    plan = make_plan(8)

    def opposite(world, method, seed, metric):
        value = as_hoped(world, method, seed, metric)
        if metric == "landmarks":
            return 2100.0 - value if method in ("nn", "jcbb", "djnn", "nn + tentative") else 1500.0
        if metric == "association_ms":
            return 100.0 / value if method != "djnn" else 1e4
        return 1.0 - value + 0.1 * (method == "jcbb") + 0.01 * seed * (method == "nn + local")

    claims = djnn_claims(plan, fabricate(plan, opposite))
    # jcbb is above the others here, and believes less than 400 features
    kept = [claim.claim for claim in claims if claim.verdict != "fails"]
    assert {name.partition(" [")[0] for name in kept} == {
        "djnn-10: jcbb above djnn in accuracy",
        "djnn-10: jcbb above nn in accuracy",
        "djnn-50: jcbb above nn in accuracy",
    }


def test_what_was_not_run_is_not_measured():
    plan = make_plan(3, methods=["nn", "djnn"])
    claims = djnn_claims(plan, fabricate(plan, as_hoped))
    missing = [
        claim for claim in claims if "jcbb" in claim.claim or "mda" in claim.claim or " + " in claim.claim
    ]
    assert {claim.verdict for claim in missing} == {"not measured"}
    assert next(c for c in claims if c.claim.startswith("djnn-50: djnn above nn")).runs == 3


def test_above_is_below_the_other_way_round():
    """Oracle: differences by hand; five of six seeds higher, Wilcoxon's exact p of the ranks by hand (2 x 2/64)."""
    ours = [("a", s, 0.5 + d) for s, d in enumerate((0.06, 0.05, 0.04, 0.03, 0.02, -0.01), 1)]
    result = records([*ours, *(("b", s, 0.5) for s in range(1, 7))])
    claim = above(result, "w", "a", "b", "association_accuracy")
    assert claim.value == pytest.approx(0.19 / 6) and claim.p_value == pytest.approx(4 / 64)
    assert claim.verdict == "undecided" and "higher in 5 of 6" in claim.got and claim.asked.endswith("> 0")
    assert above(result, "w", "b", "a", "association_accuracy").verdict == "fails"
    assert above(result, "w", "a", "c", "association_accuracy").verdict == "not measured"


def test_a_factor_is_the_ratio_of_the_medians():
    """Oracle: medians by hand. One disturbed run moves neither the ratio nor the verdict."""
    slow = [10.0, 11.0, 12.0, 13.0, 14.0, 15.0, 900.0]
    result = records(
        [("fast", s, 2.0) for s in range(1, 8)] + [("slow", s, v) for s, v in enumerate(slow, 1)]
    )
    claim = times_less(result, "w", "fast", "slow", "association_ms", 5.0)
    assert (claim.value, claim.verdict, claim.runs) == (6.5, "holds", 7)
    assert claim.got == "6.50 (seed by seed 5.00 to 450.00)"
    assert times_less(result, "w", "fast", "slow", "association_ms", 6.6).verdict == "fails"
    few = StudyResult(tuple(r for r in result.records if r.seed < 4))
    assert times_less(few, "w", "fast", "slow", "association_ms", 5.0).verdict == "undecided"
    assert times_less(result, "w", "fast", "nobody", "association_ms", 5.0).verdict == "not measured"
    stopped = records([("fast", 1, 0.0), ("slow", 1, 1.0)])
    assert times_less(stopped, "w", "fast", "slow", "association_ms", 5.0).verdict == "not measured"


def test_methods_differ_in_their_association_alone_and_the_slowest_come_first():
    plan = make_plan(7)
    count = {}
    for case in plan.cases:
        key = (case.world.movers, case.method.name)
        count[key] = count.get(key, 0) + 1
        assert case.config() == msgspec.structs.replace(
            case.world.defaults(), association=case.method.association, seed=case.seed
        )
    assert count[MANY, "mda"] == count[FEW, "mda"] == 6 and count[MANY, "mda, local"] == 7
    assert set(count.values()) == {6, 7} and len(count) == 2 * sum(map(len, GROUPS.values()))
    assert plan.cases[0].method.name == "mda" and plan.cases[0].world.movers == MANY
    assert len({case_key(case) for case in plan.cases}) == len(plan.cases)
    assert sum(case.method.name == "mda" for case in make_plan(7, 1).cases) == 2
    assert all(len(world.landmarks) == 252 for world in plan.worlds.values()) and not plan.altered


def test_the_papers_methods_have_its_gate_and_each_part_one_thing_more_than_nn():
    """Oracle: section 3 of the paper. NN is what DJNN is with all three parts off."""
    for association in [*GROUPS[PAPER].values(), *GROUPS[PARTS].values()]:
        assert association.gate == association.new_gate == association.joint_gate == 0.95
        assert not association.merge
    assert all(association.gate > 0.99 and association.merge for association in GROUPS[OWN].values())

    def parts(association):
        inside = association.method == "djnn" and association.interference
        return inside, association.management == "counter", association.local

    assert parts(GROUPS[PAPER]["djnn"]) == (True, True, True)
    assert parts(GROUPS[PAPER]["nn"]) == parts(GROUPS[PAPER]["jcbb"]) == (False, False, False)
    assert [parts(a) for a in GROUPS[PARTS].values()] == [
        (True, False, False),
        (False, True, False),
        (False, False, True),
    ]
    for association in GROUPS[PARTS].values():
        assert (association.widen > 0.0) == association.interference


@pytest.mark.parametrize(
    "settings",
    [{"runs": 0}, {"runs": 2, "mda_runs": 3}, {"runs": 2, "mda_runs": -1}, {"runs": 2, "methods": ["knn"]}],
)
def test_settings_that_make_no_sense_are_refused(settings):
    with pytest.raises(ConfigError):
        make_plan(**settings)


def test_a_method_brings_its_own_association_or_takes_the_worlds():
    grove = world_by_name("grove")
    plain, own = Method("a", make_plan(1).cases[0].method.filter), AssociationConfig(method="djnn")
    cases = [
        Case(grove, plain, 1),
        Case(grove, plain, 1, AssociationConfig(method="nearest")),
        Case(grove, msgspec.structs.replace(plain, association=own), 1),
        Case(grove, msgspec.structs.replace(plain, association=own), 1, AssociationConfig(method="nearest")),
    ]
    methods = [case.config().association.method for case in cases]
    assert methods == ["likelihood", "nearest", "djnn", "djnn"]
    assert len({case_key(case) for case in cases}) == 3  # the last two are the same run


def test_what_is_kept_of_a_run():
    """Oracle: the time of a call is the association's time over the frames; with ids given there is none."""
    plan = make_plan(1, methods=["djnn"], world=TINY)
    case = djnn_case(plan.worlds[FEW], "djnn", 1)
    kept = run_case(case).metrics
    assert set(kept) == set(METRICS)
    of_sets = {"ospa_course_m", "cardinality_course_error"}
    assert {name for name, value in kept.items() if value is None} == of_sets
    assert kept["association_ms"] == pytest.approx(1e3 * kept["association_s"] / kept["frames"])
    both = kept["association_precision"], kept["association_recall"]
    assert kept["association_f1"] == pytest.approx(2.0 / sum(1.0 / share for share in both))
    given = run_case(Case(plan.worlds[FEW], Method("ids", case.method.filter), 1)).metrics
    assert given["association_ms"] is given["association_s"] is given["association_accuracy"] is None
    assert 200 < given["landmarks"] <= 252


def test_the_tables_have_the_papers_numbers_beside_ours():
    plan = make_plan(8)
    text = djnn_report(plan, fabricate(plan, as_hoped), []).markdown()
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if "| " in line
    ]
    few, many = (row for row in rows if row[0] == "jcbb")
    assert few[:9] == ["jcbb", "8", "0.9412", "0.9372", "0.9402", "3.013", "185.300", "1804.5", ""]
    assert many[1:4] == ["8", "0.8086", "0.9051"] and many[7:9] == ["1804.5", "456.0"]
    assert next(row for row in rows if row[0] == "mda")[:4] == ["mda", "6", "0.9533", ""]
    assert "in their order, not in their size" in text and "mda has 6 of them" in text
    assert "defines no accuracy" in text and "NOT THE STUDY" not in text


def test_the_figures_have_a_row_a_method_and_a_dot_a_seed():
    plan = make_plan(4, 2, methods=["nn", "mda", "djnn"], world=TINY)
    figures = djnn_figures(plan, fabricate(plan, as_hoped))
    assert list(figures) == ["maps", "accuracy", "features", "time"]
    figure, caption = figures["features"]
    few, many = figure.axes
    assert [label.get_text() for label in few.get_yticklabels()] == ["nn", "mda", "djnn"]
    lines = [line for line in many.get_lines() if line.get_marker() == "o"]
    assert [len(line.get_xdata()) for line in lines] == [4, 2, 4]
    np.testing.assert_array_equal(lines[2].get_xdata(), [281.0, 282.0, 283.0, 284.0])
    assert [252.0, 252.0] in [list(line.get_xdata()) for line in many.get_lines()]
    assert [text.get_text() for text in many.texts] == ["1802", "1802", "282"] and "twice" in caption
    maps, caption = figures["maps"]
    assert [axes.get_title(loc="left").partition(":")[0] for axes in maps.axes] == ["nn", "djnn"]
    assert "nn and djnn with seed 1 and 50 movers" in caption
    alone = make_plan(1, methods=["nn"], world=TINY)
    assert "maps" not in djnn_figures(alone, fabricate(alone, as_hoped))


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory):
    out = tmp_path_factory.mktemp("djnn")
    told = []
    done = reproduce_djnn(
        out, runs=2, workers=1, methods=QUICK, world=TINY, progress=lambda *p: told.append(p)
    )
    return out, done, told


def test_every_file_is_written_and_says_what_it_must(reproduced):
    out, done, told = reproduced
    assert told[-1] == (12, 12) and not done.result.failures()
    wanted = {"djnn.md", "djnn.csv", "runs.csv", "claims.json", "manifest.json", "report.html"}
    assert wanted | {f"figures/{name}.png" for name in ("maps", "accuracy", "features", "time")} == set(
        done.files
    )
    assert all(path.is_file() for path in done.files.values())
    text, page = (out / "djnn.md").read_text(), (out / "report.html").read_text()
    for said in (text, page):
        assert (
            "in their order, not in their size" in said and "NOT THE STUDY" in said and "0.9304" not in said
        )
        assert "--workers 1" in said and "1.4 m/s" in said
    assert page.count("<img ") == 4 and "http" not in page.replace("http://www.w3.org", "")
    claims = msgspec.json.decode((out / "claims.json").read_bytes(), type=dict)
    assert [msgspec.convert(each, Claim) for each in claims["claims"]] == done.claims
    assert len((out / "runs.csv").read_text().splitlines()) == 13
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["config"]["seeds"] == [1, 2] and manifest["log"] == "djnn-50 and djnn-10"
    assert manifest["config"]["methods"]["jcbb"]["association"]["joint_gate"] == 0.95
    assert manifest["config"]["worlds"]["djnn-50"]["movers"] == 50


def test_it_goes_on_where_it_was(reproduced, monkeypatch):
    out, done, _ = reproduced
    ran = []
    monkeypatch.setattr(
        "kalmap.study.montecarlo.run_case", lambda case: (ran.append(case), run_case(case))[1]
    )
    again = reproduce_djnn(out, runs=2, workers=1, methods=QUICK, world=TINY)
    assert not ran and again.result == done.result and again.claims == done.claims
    more = reproduce_djnn(out, runs=3, workers=1, methods=["djnn"], world=TINY)
    assert [(case.world.name, case.seed) for case in ran] == [("djnn-50", 3), ("djnn-10", 3)]
    assert len(more.result.records) == 6


@pytest.mark.parametrize(
    ("words", "paper", "settings"),
    [
        (["djnn"], "djnn", {"runs": 20, "workers": None}),
        (["djnn", "--runs", "3", "--mda-runs", "0", "--workers", "1"], "djnn", {"runs": 3, "mda_runs": 0}),
        (["crcdkf"], "crcdkf", {"runs": 50}),
        (
            ["crcdkf", "--use", "sequential", "--full-runs", "2"],
            "crcdkf",
            {"use": "sequential", "full_runs": 2},
        ),
    ],
)
def test_each_paper_has_its_own_options(tmp_path, monkeypatch, words, paper, settings):
    """The command hands on what was said, and its code is 1 if and only if a claim fails."""
    asked = {}

    def make(verdict):
        def reproduce_it(folder, **given):
            asked.update(given)
            return msgspec.defstruct("Done", ["claims"])([Claim("x", "", "", verdict)])

        return reproduce_it

    for verdict, code in (("holds", 0), ("undecided", 0), ("fails", 1)):
        monkeypatch.setattr(f"kalmap.study.reproduce_{paper}", make(verdict))
        answer = CliRunner().invoke(reproduce.command, [*words, "--quiet", "--out", str(tmp_path)])
        assert answer.exit_code == code, answer.output
    assert asked.items() >= settings.items()


@pytest.mark.parametrize(
    "words", [["djnn", "--use", "joint"], ["djnn", "--full-runs", "2"], ["crcdkf", "--mda-runs", "2"]]
)
def test_an_option_of_another_paper_is_refused(words):
    answer = CliRunner().invoke(reproduce.command, words)
    assert answer.exit_code == 2 and f"{words[1]} is for" in answer.output


@pytest.mark.slow
def test_what_was_asked_of_djnn_holds():
    """Oracle: the truth of the simulated world. KALMAP_SLOW_SEEDS seeds (default 20); fewer than six cannot be
    significant in a signed-rank test, and are held to the right sign.

    Of what was asked one thing is missed and not held here: with the paper's gate DJNN's map has 300.35 features
    in the mean of 20 seeds, where 300 was asked. With kalmap's own gates it holds, and is held, with the counter as
    with existence probabilities.
    """
    seeds = int(os.environ.get("KALMAP_SLOW_SEEDS", "20"))
    own = ("djnn, own gates", "djnn, existence")
    plan = make_plan(seeds, methods=[*QUICK, *own])
    many = [case for case in plan.cases if case.world is plan.worlds[MANY]]  # of ten movers nothing was asked
    claims = djnn_claims(plan, run_cases(many, workers=1))
    missed = "djnn-50: djnn, mean map features [asked]"
    held = [c for c in claims if c.claim.endswith("[asked]") and c.claim != missed]
    bounded = tuple(f"djnn-50: {name}, mean map features" for name in own)
    held += [c for c in claims if c.claim.startswith(bounded)]
    good = ("holds",) if seeds > 5 else ("holds", "undecided")
    assert len(held) == 7 and [claim for claim in held if claim.verdict not in good] == []
