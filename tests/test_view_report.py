"""Pages: whole, escaped, and without anything that would have to be fetched."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import msgspec
import numpy as np
import pytest

from kalmap.view import StudyCurve, StudyRow, StudyTable, render_comparison, render_report, render_study
from kalmap.view.reading import flat, metric_of, number, numbers, reading
from kalmap.view.summary import summary_cards
from test_view_samples import empty_run, loop_run, manifest

EVIL = "<script>alert('x')</script>&\""
VOID = {"meta", "img", "br"}


class Checker(HTMLParser):
    """Checks that tags close in order and collects what a page would load or run."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.links: list[str] = []
        self.words = ""

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.links += [value for name, value in attrs if name in ("src", "href", "srcset", "action", "data")]
        assert not any(name.startswith("on") for name, _ in attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words += data


def check(html: str) -> Checker:
    checker = Checker()
    checker.feed(html)
    checker.close()
    assert not checker.open
    assert "script" not in checker.tags
    assert "link" not in checker.tags
    assert all(link.startswith(("data:image/png;base64,", "#")) for link in checker.links)
    anchors = set(re.findall(r'id="([^"]*)"', html))
    assert {link[1:] for link in checker.links if link.startswith("#")} <= anchors
    assert not re.search(r"url\(|@import|https?:", html)
    assert not re.search(r"\bnan\b", checker.words)
    return checker


def test_report_of_a_run_tells_all():
    run = loop_run(70)
    biases = {"steering_offset": (np.radians(0.5), np.radians(0.1)), "speed_scale": (0.01, 0.002)}
    run = msgspec.structs.replace(run, estimate=msgspec.structs.replace(run.estimate, biases=biases))
    skipped = [{"file": "a.csv", "record": 3, "field": "range", "problem": "not finite"}]
    html = render_report(
        run,
        metrics={"position_rmse_m": 0.5, "ate_m": None, "nees": {"mean": 9.0}},
        manifest=manifest(skipped=skipped, skipped_total=7),
        warnings=["look out"],
    )
    page = check(html)
    assert html.count("<img") == 4
    for words in (
        "look out",
        "70 in the map; the first 50 are listed",
        "steering offset0.5000.100deg",
        "Too sure of itself",
        "Records passed over: 7; the first 1 are listed",
        "a.csv3rangenot finite",
        "ab" * 32,
        '"wheelbase": 4.0',
        "kalmap 0.1.0",
        "Not known for this run: ATE (m).",
    ):
        assert words in page.words, words
    assert "149" in page.words
    assert ">150<" not in html


def test_everything_from_outside_is_escaped():
    run = msgspec.structs.replace(loop_run(3), log=EVIL, method=EVIL)
    biases = {EVIL: (0.0, 1.0)}
    run = msgspec.structs.replace(run, estimate=msgspec.structs.replace(run.estimate, biases=biases))
    told = manifest(
        log=EVIL,
        source=EVIL,
        command=EVIL,
        error=EVIL,
        kalmap=EVIL,
        packages={EVIL: EVIL},
        data_sha256={EVIL: EVIL},
        config={EVIL: EVIL},
        skipped=[dict.fromkeys(("file", "record", "field", "problem"), EVIL)],
        skipped_total=1,
    )
    check(render_report(run, metrics={EVIL: EVIL, "x": {EVIL: 1.0}}, manifest=told, warnings=[EVIL]))
    check(render_comparison([run], {EVIL: {EVIL: 1.0}}, manifests={EVIL: told}, warnings=[EVIL]))
    table = StudyTable(EVIL, (EVIL,), (StudyRow(EVIL, (1.0,), (2.0,)),), EVIL)
    check(render_study(EVIL, [table], manifest=told, lead=EVIL, warnings=[EVIL]))


@pytest.mark.parametrize("frames", [0, 1, 4])
def test_report_of_nothing(frames):
    page = check(render_report(empty_run(frames), metrics={}, manifest=manifest(data_sha256={})))
    assert "The map holds no landmarks." in page.words
    assert "No metrics" in page.words
    assert "no reference path" in page.words


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"completed": False, "error": "P is not positive definite at step 7"}, "at step 7"),
        ({"completed": False, "interrupted": True}, "was interrupted"),
        ({"completed": False}, "did not reach the end"),
    ],
)
def test_a_run_that_failed_says_so(changes, words):
    assert (
        words in check(render_report(empty_run(), metrics={}, manifest=manifest(**changes), figures={})).words
    )


def test_comparison_sets_off_the_best():
    metrics = {
        "a": {"position_rmse_m": 1.0, "nees_mean": 1.5, "recall": 0.5, "landmarks_count": 3, "same": 1.0},
        "b": {"position_rmse_m": 2.0, "nees_mean": 3.3, "recall": 0.9, "landmarks_count": 4, "same": 1.0},
        "c": {"position_rmse_m": None, "nees_mean": 0.0},
    }
    html = render_comparison([], metrics, figures={})
    check(html)
    assert re.findall(r'n best">([^<]*)<', html) == ["1.00", "3.30", "90.0"]
    assert html.count("unknown") == 4


def test_comparison_of_nothing():
    assert "No metrics" in check(render_comparison([], {})).words


def test_study_sets_the_papers_numbers_beside_ours():
    table = StudyTable(
        "Errors", ("m", "deg"), (StudyRow("ekf", (4.3, None), (4.1, 2.0)), StudyRow("ukf", (1.0, 2.0)))
    )
    curves = [StudyCurve("ekf", np.arange(3.0), np.ones(3), np.ones(3))]
    html = render_study("Study", [table], curves=curves)
    page = check(html)
    assert re.findall(r'class="paper">([^<]*)<', html) == ["4.10", "2.00"]
    assert "what the paper reports" in page.words
    assert html.count("<img") == 1


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (3.14159, "3.14"),
        (0.0312, "0.0312"),
        (304.4, "304"),
        (-2.5, "-2.50"),
        (1234567.0, "1.23e+06"),
    ]
    + [(1e-9, "1.00e-09"), (float("nan"), "unknown"), (float("inf"), "unknown")],
)
def test_numbers_are_short(value, text):
    assert number(value) == text


@pytest.mark.parametrize(
    ("key", "title", "right"),
    [
        ("position_rmse_m", "Position RMSE (m)", None),
        ("heading.rmse_rad", "Heading RMSE (deg)", None),
        ("nees_mean", "NEES mean", 3.0),
        ("nees_share_inside", "NEES share inside (%)", 0.95),
        ("nis_per_dof", "NIS per dof", 1.0),
        ("nis_mean", "NIS mean", 1.0),
        ("step_ms_p99", "Step 99th percentile (ms)", None),
        ("rpe_10m_deg", "RPE 10m (deg)", None),
        ("nees_band_lower", "NEES band lower", None),
        ("nis_dof", "NIS dof", None),
        ("m", "M", None),
    ],
)
def test_metrics_are_known_by_their_words(key, title, right):
    metric = metric_of(key)
    assert (metric.title, metric.right) == (title, right)


def test_readings():
    assert metric_of("heading_rad").format(np.pi) == "180"
    assert metric_of("flag").format(True) == "yes"
    assert metric_of("name").format("text") == "text"
    assert "honest" in reading("nees_mean", 3.2)
    assert "cautious" in reading("nees_mean", 0.3)
    assert "Too sure" in reading("nees_mean", 30.0)
    assert "noise set too small" in reading("nis_per_dof", 2.0)
    assert "95 % is right" in reading("nees_inside", 0.5)
    assert reading("landmarks_count", 3) == ""
    assert reading("whatever", None) == ""


def test_nested_metrics_are_flattened():
    nested = {
        "a": {"b": np.float64(1.0), "c": [1.0, 2.0]},
        "d": np.int64(3),
        "e": list(range(9)),
        "f": True,
        "g": None,
    }
    assert dict(flat(nested)) == {"a.b": 1.0, "a.c": "1.00, 2.00", "d": 3, "f": True, "g": None}
    assert numbers(nested) == {"a.b": 1.0, "d": 3, "g": None}
    assert isinstance(numbers(nested)["d"], int)


def test_summary_reads_the_numbers():
    cards = {label: (value, says) for label, value, _, says in summary_cards(loop_run())}
    assert {
        "Path",
        "Landmarks",
        "NEES",
        "NIS / dof",
        "Time per step",
        "Position error",
        "Heading error",
    } <= set(cards)
    assert "3 is right for a pose" in cards["NEES"][1]
    assert "0.216 to 9.35" in cards["NEES"][1]
    assert cards["Landmarks"][0] == "35"
