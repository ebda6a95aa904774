"""Which runs the reproduction of Yan et al. 2014 is made of."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from kalmap.data import open_log
from kalmap.records import ConfigError, FiniteSetConfig, RunConfig
from kalmap.simulate import World, phd_world
from kalmap.study.cases import Case, Method
from kalmap.study.recorded import Recorded, recorded

CLUTTER = (1, 2, 3)
PARTICLES, CAR_PARTICLES = 5, 10
CAR_PARK = "car-park"

SRCKF, RB = "srckf-phd", "rb-phd"
OWN_SRCKF, OWN_RB = f"{SRCKF}, sightings", f"{RB}, sightings"
_AS_PUBLISHED: dict[str, Any] = {
    "proposal": "motion",
    "weighting": "single-feature",
    "prune": 1e-5,
    "feature": 0.6,
    "forgive": 0,
}
_OWN: dict[str, Any] = {"proposal": "sightings", "weighting": "multi-feature"}
METHODS: dict[str, dict[str, Any]] = {
    SRCKF: {"method": SRCKF, **_AS_PUBLISHED},
    RB: {"method": RB, **_AS_PUBLISHED},
    OWN_SRCKF: {"method": SRCKF, **_OWN},
    OWN_RB: {"method": RB, **_OWN},
}
"""As published: particles drawn from odometry, weighed by a single feature; and what kalmap does by itself."""


class Plan(msgspec.Struct, frozen=True):
    """Worlds by their clutter, the car park where its data is there, and all cases. altered: not the study's worlds."""

    worlds: dict[int, World]
    car_park: Recorded | None
    cases: list[Case]
    altered: bool = False

    @property
    def places(self) -> list[str]:
        """The names of the worlds, and of the car park."""
        return list(dict.fromkeys(case.world.name for case in self.cases))


def set_case(world: World | Recorded, method: str, particles: int, seed: int) -> Case:
    """A method of `METHODS`. In a simulated world it knows P_D and clutter, in a recorded log it learns them."""
    sets = msgspec.structs.replace(
        world.defaults().finite_set,
        particles=particles,
        threads=1,
        estimate=isinstance(world, Recorded),
        **METHODS[method],
    )
    return Case(world, Method(method, finite_set=sets), seed)


def make_plan(runs: int, car_park: Path | None = None, world: Mapping[str, Any] | None = None) -> Plan:
    """Every method with seeds 1 to `runs` in the three worlds, and on the car park's log if its folder is given.

    world: fields of `World` other than the study's, for a quick look. Raises `ConfigError` for no runs.
    """
    if runs < 1:
        raise ConfigError(f"runs must be 1 or more, got {runs}")
    worlds = {clutter: phd_world(clutter, **(world or {})) for clutter in CLUTTER}
    car = None if car_park is None else recorded(CAR_PARK, car_park, _car_config(car_park))
    places: list[tuple[World | Recorded, int]] = [(each, PARTICLES) for each in worlds.values()]
    places += [(car, CAR_PARTICLES)] if car is not None else []
    cases = [
        set_case(place, method, particles, seed)
        for place, particles in places
        for seed in range(1, runs + 1)
        for method in METHODS
    ]
    return Plan(worlds, car, cases, bool(world))


def _car_config(folder: Path) -> RunConfig:
    """The car's own settings with the paper's noise, and without the constant errors that it does not speak of."""
    own = open_log(str(folder)).defaults
    return msgspec.structs.replace(
        own,
        motion=msgspec.structs.replace(own.motion, sigma_speed=0.7, sigma_steering_deg=5.5, biases=()),
        sensor=msgspec.structs.replace(own.sensor, sigma_range=1.0, sigma_bearing_deg=1.0),
        finite_set=FiniteSetConfig(),
    )
