"""Another detector than the log's own begins with its own settings, however it is asked for."""

from __future__ import annotations

import pytest

from kalmap.cli.options import gather
from kalmap.cli.settings import resolve
from kalmap.records import PerceptionConfig, RunConfig

TREES = RunConfig(perception=PerceptionConfig(detector="trees", max_range=40.0, clearance=1.5))
NOTHING = dict.fromkeys(
    (
        *("scope", "coordinates", "use", "association", "management", "detector", "config_file", "seed"),
        *("method", "particles", "proposal", "weighting", "divide"),
    )
)


def asked(detector=None, *pairs: str) -> PerceptionConfig:
    """What the command line makes of a log of trees."""
    settings, _ = gather({**NOTHING, "detector": detector, "pairs": pairs, "tolerant": False})
    return resolve(TREES, settings).perception


@pytest.mark.parametrize(
    ("detector", "pairs"), [("reflectors", ()), (None, ("perception.detector=reflectors",))]
)
def test_another_detector_forgets_the_settings_of_the_first(detector, pairs):
    assert asked(detector, *pairs) == PerceptionConfig(detector="reflectors")
    far = asked(detector, *pairs, "perception.max_range=12")
    assert far == PerceptionConfig(detector="reflectors", max_range=12.0)


@pytest.mark.parametrize(
    ("detector", "pairs"), [("trees", ()), (None, ("perception.detector=trees",)), (None, ())]
)
def test_the_same_detector_keeps_its_settings(detector, pairs):
    assert asked(detector, *pairs) == TREES.perception
    assert asked(detector, *pairs, "perception.clearance=2").max_range == 40.0
