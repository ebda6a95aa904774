"""Multidimensional assignment over a window of frames (Wijesoma, Perera & Adams 2006).

Decisions wait for the window: a frame is decided for good when `window - 1` later ones have been seen, and
until then by what looks best so far. The filter carries revised decisions out by going back to before the frame
(`slam.window`).
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import msgspec
import numpy as np

from kalmap.association.ambiguity import ambiguous
from kalmap.association.assignment import Assigned, solve_assignment
from kalmap.association.associator import Predicted
from kalmap.association.attributes import unknown
from kalmap.association.checks import check
from kalmap.association.gated import Gated, Matching, Table
from kalmap.association.management import BuiltInManagement, Trial
from kalmap.kernels import nearest as kernel
from kalmap.records import NEW, Association, Reason, Sightings

_MOST_TUPLES = 200_000  # beyond it the least likely pairs of each landmark are left out
Key = tuple[int, int]
"""A landmark within the window: (-1, lasting number), or (frame, sighting) of a track that began in the window."""

UNUSED: Key = (-2, 0)

_Options = list[list[tuple[int, float]]]
"""For each frame what a landmark can be there, (sighting, cost) each; the first is none, -1."""

_Tuple = tuple[int, tuple[int, ...], float]
"""Place among the known landmarks or -1, sighting in each frame or -1, cost."""


class Glance(msgspec.Struct, frozen=True):
    """What a frame of the window looked like before it was taken, given the frames before it as they are decided.

    numbers: (C,) lasting numbers of the candidates. squared, log_volume: (M, C). trial: (C,) bool. missed: (C,)
    what it costs that a candidate was not seen. founded: how many landmarks had ever been founded before the
    frame. gate, new_gate: squared distances. links: for each earlier frame of the window, the oldest first,
    (M_earlier, M) squared distance and ln det S of a sighting here from a landmark that stands where a sighting
    there saw one.
    """

    numbers: np.ndarray
    squared: np.ndarray
    log_volume: np.ndarray
    trial: np.ndarray
    missed: np.ndarray
    founded: int
    gate: float
    new_gate: float
    links: tuple[tuple[np.ndarray, np.ndarray], ...]

    @property
    def count(self) -> int:
        """How many sightings the frame has."""
        return len(self.squared)


class Mda(Gated, frozen=True, kw_only=True, tag=True):
    """The cheapest explanation of several frames at once, by landmarks, new landmarks, misses and false alarms.

    An explanation is a set of tuples (landmark of the map or new, sighting or none in each frame) that uses
    nothing twice. It costs its negative log-likelihood ratio against all sightings being false: a sighting of a
    landmark ln(lambda_F / (P_D N(nu; 0, S))), a frame in which a landmark of the map should have been seen and was
    not -ln(1 - P_D), whether or not it is seen in another. A new landmark costs ln(lambda_F / lambda_N) for its
    first sighting, and every later frame that of a sighting or -ln(1 - P_D); one that is seen only once in the
    window is no explanation. What no tuple takes is a false alarm and costs nothing.

    window: frames decided together, 2 or more. detection: P_D. false_rate, new_rate: false sightings and new
    landmarks to be expected in a frame, spread evenly over range and bearing. work: relaxation steps at most.
    management: here `Trial`, in a configuration what that says.
    """

    window: int = 2
    detection: float = 0.9
    false_rate: float = 0.5
    new_rate: float = 0.2
    work: int = 300
    management: BuiltInManagement = Trial(confirm=2)

    def __post_init__(self) -> None:
        Gated.__post_init__(self)
        check(self.window >= 2, "window", "2 frames or more", self.window)
        check(0.0 < self.detection < 1.0, "detection", "a probability between 0 and 1", self.detection)
        check(0.0 < self.false_rate < math.inf, "false_rate", "more than 0", self.false_rate)
        check(0.0 < self.new_rate < math.inf, "new_rate", "more than 0", self.new_rate)
        check(self.work >= 1, "work", "1 or more", self.work)

    def glance(
        self,
        memory: Any,
        sightings: Sightings,
        predicted: Predicted,
        links: tuple[tuple[np.ndarray, np.ndarray], ...],
    ) -> Glance:
        """Look at a frame before anything is decided."""
        table = self._table(memory, sightings, predicted)
        hidden = predicted.hidden(table.expected)
        miss = -math.log(1.0 - self.detection)
        return Glance(
            numbers=np.array([memory["serial"][i] for i in table.expected.indices.tolist()], dtype=np.int64),
            squared=table.squared,
            log_volume=table.normalised - table.squared,
            trial=table.trial,
            missed=np.where(table.in_view & ~hidden, miss, 0.0),
            founded=memory["founded"],
            gate=table.gate,
            new_gate=table.new_gate,
            links=links,
        )

    def told_apart(self, earlier: Sightings, later: Sightings) -> np.ndarray:
        """(M_earlier, M_later): what attributes add to the squared distance of sightings from each other."""
        extra = np.zeros((len(later.values), len(earlier.values)))
        for attribute in self.attributes:
            first = attribute.values(earlier).tolist()
            known = [[1.0, value] if math.isfinite(value) else unknown() for value in first]
            extra += attribute.cost(known, np.arange(len(known)), attribute.values(later))
        return extra.T

    def explain_window(self, glances: list[Glance], predicted: Predicted) -> tuple[list[list[Key]], Assigned]:
        """The landmark of every sighting of every frame, and how well the assignment is known.

        glances: of the frames of the window, the oldest first. Landmarks that began within the window are keys
        of their own; what no tuple takes is `UNUSED`, in the newest frame too. The cost is what the explanation
        costs less than that of no landmark seen and every sighting false.
        """
        density = self.false_rate / (predicted.max_range * 2.0 * predicted.half_view)
        numbers = sorted({number for glance in glances for number in glance.numbers.tolist()})
        known = [number for number in numbers if number < glances[0].founded]
        tuples = [*self._seen(glances, known, density), *self._new(glances, density)]
        counts = [len(known), *(glance.count for glance in glances)]
        landmark = np.array([t[0] for t in tuples], dtype=np.int64)
        sightings = np.array([t[1] for t in tuples], dtype=np.int64).reshape(-1, len(glances))
        costs = np.array([t[2] for t in tuples], dtype=float)
        assigned = solve_assignment(landmark, sightings, costs, counts, work=self.work)
        keys = [[UNUSED] * glance.count for glance in glances]
        for row in assigned.chosen.tolist():
            members = sightings[row].tolist()
            first = next(f for f, i in enumerate(members) if i >= 0)
            key = (-1, known[landmark[row]]) if landmark[row] >= 0 else (first, members[first])
            for f, i in enumerate(members):
                if i >= 0:
                    keys[f][i] = key
        return keys, assigned

    def _pair_costs(self, squared: np.ndarray, log_volume: np.ndarray, density: float) -> np.ndarray:
        """(M, C): ln(lambda_F / (P_D N(nu; 0, S)))."""
        return 0.5 * (squared + log_volume) + math.log(2.0 * math.pi * density / self.detection)

    def _seen(self, glances: list[Glance], known: list[int], density: float) -> list[_Tuple]:
        """Tuples of landmarks that stood in the map before the window, each less the cost of seeing nothing of it.

        A sighting that costs more than a miss is left out: without it the tuple would be cheaper.
        """
        place = {number: at for at, number in enumerate(known)}
        options: list[_Options] = [[[(-1, 0.0)] for _ in glances] for _ in known]
        for f, glance in enumerate(glances):
            costs = self._pair_costs(glance.squared, glance.log_volume, density) - glance.missed
            rows, columns = np.nonzero((glance.squared <= glance.gate) & (costs < 0.0))
            for i, number, cost in zip(
                rows.tolist(), glance.numbers[columns].tolist(), costs[rows, columns].tolist()
            ):
                if number in place:
                    options[place[number]][f].append((i, cost))
        return _combined([(at, (), each, 0.0) for at, each in enumerate(options)])

    def _new(self, glances: list[Glance], density: float) -> list[_Tuple]:
        """Tuples of landmarks that began within the window, near none believed in, and were seen at least twice."""
        start = math.log(self.false_rate / self.new_rate)
        miss = -math.log(1.0 - self.detection)
        begun: list[tuple[int, tuple[int, ...], _Options, float]] = []
        for first, glance in enumerate(glances[:-1]):
            believed = (glance.numbers < glances[0].founded) & ~glance.trial
            near = np.any(glance.squared[:, believed] < glance.new_gate, axis=1).tolist()
            options: list[_Options] = [[[(-1, miss)] for _ in glances[first + 1 :]] for _ in near]
            for ahead, later in enumerate(glances[first + 1 :]):
                squared, log_volume = later.links[first]
                costs = self._pair_costs(squared, log_volume, density)
                rows, columns = np.nonzero(squared <= later.gate)
                for i, m, cost in zip(rows.tolist(), columns.tolist(), costs[rows, columns].tolist()):
                    options[i][ahead].append((m, cost))
            begun += [(-1, (-1,) * first + (i,), options[i], start) for i, no in enumerate(near) if not no]
        return _combined(begun)

    def conclude(
        self,
        memory: Any,
        sightings: Sightings,
        predicted: Predicted,
        wanted: list[int],
        newest: bool,
        notes: tuple[str, ...] = (),
    ) -> Association:
        """Carry a decision through: wanted holds an index of the map, NEW or SPURIOUS for each sighting.

        In the newest frame a sighting that nobody wanted may still go to a landmark on trial that nothing else
        went to, or found one if it lies near none.
        """
        table = self._table(memory, sightings, predicted)
        place = {index: column for column, index in enumerate(table.expected.indices.tolist())}
        columns = np.array([place.get(index, kernel.FREE) for index in wanted], dtype=np.int64)
        fate, free = np.empty(len(columns), dtype=np.int64), table.trial.copy()
        free[columns[columns >= 0]] = False
        decided = columns.copy()
        kernel.finish(table.squared, table.normalised, free, table.gate, table.new_gate, columns, fate)
        if not newest:
            fate[(decided < 0) & ((fate == kernel.NEW) | (fate == kernel.TRIAL))] = kernel.LOST
        fate[(decided < 0) & (np.array(wanted, dtype=np.int64) == NEW)] = kernel.NEW
        if self.ambiguity > 0.0:
            fate[ambiguous(predicted, table, decided, self.ambiguity)] = kernel.DOUBTFUL
        matching = Matching(columns, Reason.WINDOW, Reason.FALSE_ALARM, notes)
        return self._conclude(memory, table, matching, columns, fate, predicted)

    def _match(self, table: Table, predicted: Predicted) -> Matching:
        """A frame by itself: the window of one."""
        columns = np.full(len(table.squared), kernel.FREE, dtype=np.int64)
        everyone = np.ones(len(columns), dtype=np.bool_)
        kernel.nearest(table.squared, table.normalised, table.gate, everyone, ~table.trial, columns)
        contested = np.empty(len(columns), dtype=np.bool_)
        kernel.settle(table.squared, table.normalised, table.gate, ~table.trial, columns, contested)
        return Matching(columns)


def _combined(begun: list[tuple[int, tuple[int, ...], _Options, float]]) -> list[_Tuple]:
    """All tuples of what began as (place, sightings so far, options in the frames to come, cost so far)."""
    begun = [each for each in begun if any(len(options) > 1 for options in each[2])]
    budget = _MOST_TUPLES // max(1, len(begun))
    tuples = []
    for place, members, options, start in begun:
        if math.prod(map(len, options)) > budget:
            most = max(1, int(budget ** (1.0 / len(options))) - 1)
            options = [[none, *sorted(some, key=lambda pair: pair[1])[:most]] for none, *some in options]
        for combination in itertools.product(*options):
            chosen = tuple(i for i, _ in combination)
            if max(chosen) >= 0:
                tuples.append((place, members + chosen, start + sum(cost for _, cost in combination)))
    return tuples
