"""`kalmap run` and `kalmap compare` with methods of random finite sets: what they take, refuse and leave behind."""

from __future__ import annotations

import csv
import json

import msgspec
import pytest

from command import kalmap_all_inside, kalmap_inside, manifest
from kalmap.records import FiniteSetConfig
from kalmap.simulate import simulate, world_by_name
from kalmap.slam import run, slam_from_config
from kalmap.study import parse_method

METHODS = ("rb-phd", "srckf-phd", "pmb")
# a look a second: 145 of them
SHORT = ["--set", "world.observe_every=40"]
PICTURES = {"map.png", "errors.png", "set.png", "intensity.png", "consistency.png", "timing.png"}

REFUSED = {
    "filter": (["--method", "rb-phd", "--filter", "ekf"], "--filter ekf means nothing to rb-phd"),
    "two filters": (["--method", "ekf", "--filter", "cdkf"], "--method ekf and --filter cdkf contradict"),
    "association": (["--method", "pmb", "--association", "jcbb"], "--association jcbb means nothing to pmb"),
    "coordinates": (["--method", "pmb", "--coordinates", "additive"], "--coordinates additive means nothing"),
    "particles": (["--method", "ekf", "--particles", "5"], "--particles 5 means nothing to ekf"),
    "particles alone": (["--particles", "5"], "--particles 5 means nothing to a Kalman filter"),
    "proposal": (["--filter", "ekf", "--proposal", "motion"], "--proposal motion means nothing to ekf"),
    "weighting": (["--method", "pmb", "--weighting", "empty"], "pmb weighs its particles in one way only"),
    "from settings": (
        ["--set", "finite_set.method=pmb", "--use", "joint"],
        "--use joint means nothing to pmb",
    ),
    "association of a mixture": (["--method", "pmbm", "--association", "jcbb"], "means nothing to pmbm"),
    "no particles": (["--method", "pmb", "--particles", "0"], "--particles"),
    "no method": (["--method", "phd"], "'phd' is not one of"),
}


def no_nan(folder):
    """Whether no file of numbers holds what is none."""
    for path in folder.rglob("*"):
        if path.suffix in (".json", ".csv", ".tum", ".geojson"):
            text = path.read_text().lower()
            assert "nan" not in text.replace("nanosecond", "") and "inf," not in text, path
    return True


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """One short run a method: (answers, folder of each)."""
    root = tmp_path_factory.mktemp("sets")
    folders = {name: root / name for name in METHODS}
    calls = {
        name: ["run", "phd-1", *SHORT, "--method", name, "--particles", 3, "--out", folder]
        for name, folder in folders.items()
    }
    return kalmap_all_inside(calls), folders


def least_known(name: str, feature: float) -> float:
    """The least existence of a landmark that was sighted three times, after the same run in this program: a PHD
    forgives one miss, by the largest probability of detection that it has learnt."""
    log = simulate(msgspec.structs.replace(world_by_name("phd-1"), observe_every=40), 1)
    settings = msgspec.structs.replace(log.defaults.finite_set, particles=3)
    slam = slam_from_config(parse_method(name, finite_set=settings).on(log.defaults), log)
    assert run(slam, log).error is None
    detection = slam.rates.profile.max()
    assert 0.95 < detection < 0.98 and slam.config.forgive == 1
    return feature if name == "pmb" else feature * (1.0 - detection)


@pytest.mark.parametrize("name", METHODS)
def test_a_run_leaves_a_whole_result(runs, name):
    answers, folders = runs
    answer, folder = answers[name], folders[name]
    assert (answer.code, answer.err) == (0, "") and f"phd-1, {name}, 3 particles: " in answer.out
    assert {path.name for path in (folder / "figures").iterdir()} == PICTURES and no_nan(folder)
    config = manifest(folder)["config"]
    assert config["finite_set"]["method"] == name and config["finite_set"]["particles"] == 3
    assert (config["finite_set"]["detection"], config["finite_set"]["clutter"]) == (0.95, 1.0)
    metrics = json.loads((folder / "metrics.json").read_text())
    for key in ("position_rmse_m", "ospa_m", "gospa_m", "ospa_course_m", "cardinality_course_error"):
        assert metrics[key] > 0.0, key
    assert metrics["cardinality_error"] == metrics["landmarks"] - 39
    assert metrics["nis_mean"] is metrics["association_accuracy"] is metrics["association_s"] is None
    with (folder / "landmarks.csv").open() as stream:
        landmarks = [(float(row["existence"]), int(row["sightings"])) for row in csv.DictReader(stream)]
    feature = FiniteSetConfig().feature
    assert len(landmarks) == metrics["landmarks"] and max(landmarks)[0] <= 1.0
    low = [(existence, sightings) for existence, sightings in landmarks if existence < feature == 0.6]
    assert bool(low) == (name != "pmb")
    least = least_known(name, feature)
    assert all(existence >= least and sightings >= 3 for existence, sightings in low)
    page = (folder / "report.html").read_text()
    assert f"{name}, 3 particles on world:phd-1" in page and page.count("<img ") == len(PICTURES)
    assert ">OSPA<" in page and "coordinates on world" not in page and 'id="association"' not in page


def test_a_kalman_run_in_the_same_folder_leaves_no_picture_of_a_set(tmp_path):
    line = ["run", "phd-1", *SHORT, "--set", "world.observe_every=160", "--out", tmp_path]
    assert kalmap_inside(*line, "--method", "pmb", "--particles", 1).code == 0
    assert (tmp_path / "figures" / "set.png").is_file()
    assert kalmap_inside(*line, "--method", "ekf").code == 0
    assert not any((tmp_path / "figures" / f"{name}.png").exists() for name in ("set", "intensity"))
    config = manifest(tmp_path)["config"]
    assert config["filter"]["name"] == "ekf" and config["finite_set"]["method"] is None


def test_a_mixture_begins_with_a_filter_and_associates(tmp_path):
    """It keeps an audit trail and is judged by its association, as filters are."""
    line = ["run", "phd-1", "--set", "world.observe_every=160", "--method", "pmbm", "--particles", 2]
    answer = kalmap_inside(*line, "--filter", "ekf", "--out", tmp_path)
    assert (answer.code, answer.err) == (0, "") and "phd-1, pmbm of 2, ekf, invariant: " in answer.out
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["association_accuracy"] > 0.0 and metrics["ospa_m"] > 0.0
    assert (tmp_path / "association.sqlite").is_file() and no_nan(tmp_path)


def test_contradictions_are_refused(tmp_path):
    answers = kalmap_all_inside(
        {name: ["run", "phd-1", *words, "--out", tmp_path / "x"] for name, (words, _) in REFUSED.items()}
    )
    for name, (_, said) in REFUSED.items():
        assert answers[name].code == 2 and said in answers[name].error, (name, answers[name])
    assert not (tmp_path / "x").exists()


def test_compare_sets_both_families_side_by_side(tmp_path):
    methods = "cr-cdkf:jcbb,rb-phd,srckf-phd:motion:single-feature"
    line = ["compare", "phd-1", *SHORT, "--methods", methods, "--particles", 3, "--out", tmp_path]
    answer = kalmap_inside(*line)
    assert (answer.code, answer.err) == (0, "") and "ospa_m" in answer.out and no_nan(tmp_path)
    assert (tmp_path / "figures" / "set.png").is_file()
    config = manifest(tmp_path)["config"]
    assert config["cr-cdkf:jcbb"]["finite_set"]["method"] is None
    assert config["cr-cdkf:jcbb"]["association"]["method"] == "jcbb"
    published = config["srckf-phd:motion:single-feature"]["finite_set"]
    assert (published["proposal"], published["weighting"], published["particles"]) == (
        "motion",
        "single-feature",
        3,
    )
    assert config["rb-phd"]["finite_set"]["proposal"] == "sightings"
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert all(metrics[name]["ospa_m"] > 0.0 for name in methods.split(","))


def test_compare_over_seeds_pairs_both_families(tmp_path):
    line = ["compare", "phd-1", "--set", "world.observe_every=80", "--methods", "cr-cdkf,pmb,rb-phd:motion"]
    answer = kalmap_inside(*line, "--particles", 2, "--runs", 2, "--workers", 1, "--out", tmp_path)
    assert (answer.code, answer.err) == (0, "") and "ospa_m: mean over the seeds" in answer.out
    with (tmp_path / "runs.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["method"], row["seed"]) for row in rows] == [
        (name, seed) for name in ("cr-cdkf", "pmb", "rb-phd:motion") for seed in ("1", "2")
    ]
    assert (
        all(float(row["ospa_m"]) > 0 for row in rows)
        and rows[0]["ospa_course_m"] == "" != rows[2]["ospa_course_m"]
    )
    assert no_nan(tmp_path)


def test_options_of_sets_need_a_method_of_sets(tmp_path):
    words = ["compare", "phd-1", "--methods", "ekf,cr-cdkf", "--particles", 4, "--out", tmp_path]
    answer = kalmap_inside(*words)
    assert answer.code == 2 and "--particles 4 means nothing to ekf,cr-cdkf" in answer.error
