"""The reproduction of Sun et al. 2010: its cases, judgement, claims, files, and that it goes on where it was."""

from __future__ import annotations

import json

import msgspec
import numpy as np
import pytest
from click.testing import CliRunner

from kalmap.cli import reproduce
from kalmap.geometry.se2 import compose
from kalmap.records import ConfigError, Reference
from kalmap.simulate import floor_115
from kalmap.slam.contours.join import join_contours
from kalmap.study import reproduce_slasem, slasem_cases
from kalmap.study.slasem import slasem_claims
from kalmap.study.slasem_cases import FloorRecord, amortised, judged, make_plan
from kalmap.study.slasem_drive import Driven, frames_of, marked
from wall_maps import room_pair

SHORT = {"waypoints": np.array([(2.0, 0.0), (5.0, 0.0)]), "areas": np.zeros((0, 5))}


def fabricate(plan, **changed):
    """Records that bear every claim out, but for what is changed of the divided ones."""
    records = []
    for case in plan.cases:
        divided = case.method.name.startswith("dc-")
        metrics = {"total_s": 1.0 if divided else 11.0, "live_ms_max": 20.0, "position_rmse_m": 0.3}
        metrics |= {"maps": 1.0, "revisit_worst_m": 0.1} | (changed if divided else {})
        records.append(FloorRecord(case.world.name, case.method.name, case.seed, metrics))
    return records


def test_both_ways_on_both_floors():
    plan = make_plan(2, ("ekf", "invariant"))
    assert [world.name for world in plan.worlds] == ["floor-115", "floor-170"]
    assert len(plan.cases) == 2 * 2 * 2 * 2 and not plan.altered
    names = [case.method.name for case in plan.cases[:4]]
    assert names == ["slasem", "dc-slasem", "slasem, invariant", "dc-slasem, invariant"]
    assert {case.config().filter.coordinates for case in plan.cases} == {"additive", "invariant"}
    for wrong in ({"runs": 0}, {"runs": 1, "filters": ["ukf"]}, {"runs": 1, "filters": ["ekf", "ekf"]}):
        with pytest.raises(ConfigError):
            make_plan(**wrong)


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"total_s": 2.0},
        {"live_ms_max": 300.0},
        {"position_rmse_m": 0.4},
        {"maps": 2.0},
        {"revisit_worst_m": 0.5},
    ],
)
def test_every_target_is_a_claim(changed):
    plan = make_plan(1)
    claims = slasem_claims(plan, fabricate(plan, **changed))
    verdicts = [claim.verdict for claim in claims]
    assert len(claims) == 10 and verdicts.count("fails") == 2 * len(changed)


def test_a_run_that_gave_up_fails_a_claim():
    plan = make_plan(1)
    records = fabricate(plan)
    records[0] = FloorRecord(records[0].world, records[0].method, 1, error="lost")
    claims = slasem_claims(plan, records)
    assert claims[-1].verdict == "fails" and "lost" in claims[-1].got


def test_joins_are_spread_and_none_of_their_time_is_lost():
    live, join = np.full(50, 0.01), np.zeros(50)
    join[[9, 29, 49]] = 1.0, 2.0, 0.5
    spread = amortised(live, join)
    assert spread.sum() == pytest.approx(live.sum() + join.sum())
    np.testing.assert_allclose(spread[10:29], 0.01 + 1.0 / 19)
    assert spread[:9].max() == pytest.approx(0.01)


def test_a_place_seen_again_is_judged_by_both_scans():
    """A ring that is driven twice; the second round is off by 40 cm to the left of where the first one was."""
    angle = np.linspace(0.0, 4.0 * np.pi, 400)
    true = np.column_stack([5.0 * np.cos(angle), 5.0 * np.sin(angle), angle + 0.5 * np.pi])
    said = true.copy()
    said[200:, 0] += 0.4
    walls = np.array([[0.0, 0.0, 1.0, 0.0]])
    reference = Reference(times=angle, positions=true[:, :2], headings=true[:, 2], walls=walls)
    zeros = np.zeros(400)
    driven = Driven(angle, true, said, zeros + 0.01, zeros, zeros, [], [np.array([[0.5, 0.2]])], 0)
    metrics = judged(driven, reference)
    assert metrics["revisits"] > 50 and metrics["revisit_worst_m"] == pytest.approx(0.4, abs=1e-9)
    assert metrics["position_rmse_m"] == 0.0 and metrics["wall_m"] == pytest.approx(0.2)
    assert metrics["final_position_rmse_m"] == pytest.approx(0.4 * np.sqrt(0.5))


def test_marks_go_where_a_join_moves_their_maps():
    first, second = room_pair(np.random.default_rng(3))
    joined = join_contours(marked(first), marked(second))
    frames = frames_of(joined)
    assert frames.shape == (2, 3)
    np.testing.assert_allclose(frames[0], 0.0, atol=1e-9)
    plain = join_contours(first, second)
    np.testing.assert_allclose(joined.end, plain.end, atol=1e-6)
    assert len(joined.samples) == len(plain.samples) + 4
    # the second frame and the second's own end lead to the joined end, but for what the join corrected inside
    assert np.hypot(*(compose(frames[1], second.end) - joined.end)[:2]) < 0.15


def test_it_writes_everything_and_goes_on_where_it_was(tmp_path, monkeypatch):
    world = floor_115(**SHORT)
    done = reproduce_slasem(tmp_path, runs=1, worlds=[world])
    for name in ("slasem.md", "slasem.csv", "runs.csv", "claims.json", "manifest.json", "report.html"):
        assert (tmp_path / name).stat().st_size > 100
    for name in ("maps-floor-115", "times-floor-115"):
        assert (tmp_path / "figures" / f"{name}.png").stat().st_size > 10_000
    assert {claim["verdict"] for claim in json.loads((tmp_path / "claims.json").read_text())["claims"]} == {
        "not comparable"
    }
    records = [msgspec.json.decode(path.read_bytes()) for path in sorted((tmp_path / "runs").iterdir())]
    assert len(records) == 2 and all(r["metrics"]["position_rmse_m"] < 0.2 for r in records)

    def never(_):
        raise AssertionError("a run that was there was made again")

    monkeypatch.setattr("kalmap.study.slasem.run_floor", never)
    again = reproduce_slasem(tmp_path, runs=1, worlds=[world])
    assert again.claims == done.claims and slasem_cases.FLOORS[0] == "floor-115"


def test_the_command_hands_its_options_on(tmp_path, monkeypatch):
    seen = {}

    def record(folder, **given):
        seen.update(given)
        return type("Done", (), {"claims": []})()

    monkeypatch.setattr("kalmap.study.reproduce_slasem", record)
    words = ["slasem", "--runs", "2", "--methods", "ekf, invariant", "--quiet", "--out", str(tmp_path)]
    assert CliRunner().invoke(reproduce.command, words).exit_code == 0
    assert seen["runs"] == 2 and seen["methods"] == ["ekf", "invariant"]
    refused = CliRunner().invoke(reproduce.command, ["djnn", "--methods", "ekf"])
    assert refused.exit_code == 2 and "slasem" in refused.output
