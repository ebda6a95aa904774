"""A running mixture on disk: every explanation's filter, weight and history, exact to the last bit."""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from kalmap.gaussian import Belief
from kalmap.slam.archive import opened, read_header, write_archive
from kalmap.slam.checkpoint import FilterState, rebuilt, state_of
from kalmap.slam.landmark import LandmarkSlam

if TYPE_CHECKING:
    from kalmap.perception import Detector
    from kalmap.slam.mixture import MixtureSlam, Told

FORMAT = "kalmap-mixture/1"


class _Explanation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One explanation. past: which of the frames that are told it tells, one for each frame."""

    filter: FilterState
    belief: Belief
    log_weight: str
    past: list[int]


class _State(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything that the mixture knows. told: labels of frames; what explanations share stands once."""

    format: str = FORMAT
    most: int
    begun: int
    told: list[list[int]]
    explanations: list[_Explanation]


def save_mixture(slam: MixtureSlam, path: str | os.PathLike[str]) -> None:
    """Write atomically. Raises ConfigError if a filter holds a part that kalmap cannot name."""
    numbers: dict[int, int] = {}
    told: list[list[int]] = []
    explanations = []
    for hypothesis in slam._hypotheses:
        for entry in hypothesis.past:
            if numbers.setdefault(id(entry), len(told)) == len(told):
                told.append(entry[0].tolist())
        explanations.append(
            _Explanation(
                state_of(hypothesis.slam),
                hypothesis.slam._belief,
                float(hypothesis.log_weight).hex(),
                [numbers[id(entry)] for entry in hypothesis.past],
            )
        )
    write_archive(path, _State(most=slam.most, begun=slam._begun, told=told, explanations=explanations))


def load_mixture(
    kind: type[MixtureSlam], path: str | os.PathLike[str], detector: Detector | None
) -> MixtureSlam:
    """Read what `save_mixture` wrote. Raises LogError if the file is not one of these or is damaged."""
    with opened(path) as stored:
        state = read_header(stored, _State, FORMAT)
        slams = [rebuilt(LandmarkSlam, each.filter, each.belief, detector) for each in state.explanations]
        logs = [float.fromhex(each.log_weight) for each in state.explanations]
        _check(state, slams, logs)
        told: list[Told] = [(np.array(labels, dtype=np.int64), None) for labels in state.told]
        mixture = kind(slams[0], state.most)
        pasts = [[told[number] for number in each.past] for each in state.explanations]
        mixture.resume(state.begun, slams, logs, pasts)
        return mixture


def _check(state: _State, slams: list[LandmarkSlam], logs: list[float]) -> None:
    """Raise ValueError unless the explanations are of the same run, the likeliest first."""
    if not 1 <= len(slams) <= state.most:
        raise ValueError(f"{len(slams)} explanations where 1 to {state.most} are kept")
    if not all(map(math.isfinite, logs)) or sorted(logs, reverse=True) != logs:
        raise ValueError("the weights of its explanations are none")
    first = slams[0]
    for slam, each in zip(slams, state.explanations, strict=True):
        same = (slam.time, slam.frames_taken, slam.association) == (
            first.time,
            first.frames_taken,
            first.association,
        )
        if not same or state.begun < 0 or len(each.past) != slam.frames_taken - state.begun:
            raise ValueError("its explanations are not of the same frames")
        if not all(0 <= number < len(state.told) for number in each.past):
            raise ValueError("an explanation tells frames that are not there")
