"""A Poisson multi-Bernoulli mixture: several explanations of the whole run at once, each with a joint Gaussian.

Where a frame leaves a pair in doubt that would move the robot, at a loop's closing above all, every likely answer is
followed by a filter of its own, and the frames that come weigh them; a wrong closing dies when it foresees what is
not there. Most frames are not in doubt and cost one filter's update.
"""

from __future__ import annotations

import math
import os
import time

import msgspec
import numpy as np

from kalmap.association import Pmb
from kalmap.association.pmb import Option
from kalmap.gaussian import NotPositiveError
from kalmap.geometry.angles import wrap
from kalmap.models import MotionModel, SensorModel
from kalmap.perception import Detector
from kalmap.records import ConfigError, Estimate, EstimationError, Event, Fix, Frame, Odometry, Sightings
from kalmap.slam.checks import check_time, sighted
from kalmap.slam.landmark import LandmarkSlam
from kalmap.slam.mixture_checkpoint import load_mixture, save_mixture
from kalmap.slam.window import Revisions

_LIGHT = 1e-3  # share of the whole below which a hypothesis is given up
_SPARE = 2  # times the hypotheses that are kept are carried out first: some become one
_ALIKE = 0.3  # squared distance of two poses within which hypotheses with as many landmarks are one
_NARROW = 1.5  # by how much the larger of two variances may be so


Told = tuple[np.ndarray, Frame | None]


class Hypothesis(msgspec.Struct):
    """One explanation of the run: a filter and ln of its weight.

    past: labels and decision of each frame since there was one explanation alone.
    """

    slam: LandmarkSlam
    log_weight: float
    past: list[Told]


class MixtureSlam:
    """Landmark SLAM that keeps up to `most` explanations of what it has seen. slam: the filter that each begins as,
    with `Pmb` for its association.

    What it says is what its likeliest explanation says; when that changes, frame_revisions tells the labels of the
    frames that are seen otherwise now. weights: of the explanations, the likeliest first.
    """

    numbers_per_sighting = 2  # range and bearing

    def __init__(self, slam: LandmarkSlam, most: int = 10) -> None:
        if not isinstance(slam.association, Pmb):
            raise ConfigError("finite_set.method: pmbm takes the association pmb")
        if most < 1:
            raise ConfigError(f"finite_set.particles: at least 1 is needed, not {most}")
        self.most = most
        self._hypotheses = [Hypothesis(slam, 0.0, [])]
        self.labels = True
        self.explain = False
        self.frame_revisions: Revisions = {}
        self.association_seconds = 0.0
        self._begun = slam.frames_taken

    # --- the filter -------------------------------------------------------------------------------------------

    def step(self, event: Event) -> None:
        """Take one event. One that cannot be used raises EventError and changes nothing."""
        if isinstance(event, (Odometry, Fix)):
            for hypothesis in self._hypotheses:
                hypothesis.slam.step(event)
            return
        first = self._first.slam
        check_time(event, first.time)
        try:
            frame = sighted(event, first.detector)
            self._observe(frame, first.noises_of(frame))
        except NotPositiveError as problem:
            raise EstimationError(f"step {first.step_number}, t = {event.time:.6g} s: {problem}") from problem

    def _observe(self, frame: Sightings, noises: np.ndarray) -> None:
        before = self._first.past
        grown: list[Hypothesis] = []
        for hypothesis, options in self._answers(frame, noises):
            grown += _carried_out(hypothesis, options, frame, noises)
        self._hypotheses = _pruned(_sorted(_joined(_sorted(grown))), self.most)
        self.frame_revisions = _revisions(before, self._first.past, self._begun)
        if len(self._hypotheses) == 1:  # nothing that was told will be told otherwise any more
            self._first.past, self._begun = [], self.frames_taken

    def _answers(self, frame: Sightings, noises: np.ndarray) -> list[tuple[Hypothesis, list[Option]]]:
        """Each explanation with its answers to a frame that are worth carrying out, over all of them."""
        begin = time.perf_counter()
        whole = []
        for hypothesis in self._hypotheses:
            slam = hypothesis.slam
            slam.explain = self.explain
            assert isinstance(slam.association, Pmb)
            predicted = slam.predicted(frame, noises)
            whole.append((hypothesis, slam.association.options(slam.memory, frame, predicted, self.most)))
        logs = [each.log_weight + option.log_likelihood for each, options in whole for option in options]
        least = max(logs) + math.log(_LIGHT)
        if len(logs) > _SPARE * self.most:
            least = max(least, sorted(logs, reverse=True)[_SPARE * self.most - 1])
        answers = []
        for hypothesis, options in whole:
            kept = [option for option in options if hypothesis.log_weight + option.log_likelihood >= least]
            if kept:
                answers.append((hypothesis, kept))
        self.association_seconds += time.perf_counter() - begin
        return answers

    def twin(self) -> MixtureSlam:
        """A fresh estimator with the same settings, at the origin."""
        return MixtureSlam(self._first.slam.twin(), self.most)

    # --- saving -----------------------------------------------------------------------------------------------

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything that it knows, so that `load` goes on bit for bit; of past frames the labels, without
        reasons. Built-in parts only."""
        save_mixture(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, detector: Detector | None = None) -> MixtureSlam:
        """The mixture that `save` wrote. Raises LogError if the file is not one of these or is damaged."""
        return load_mixture(cls, path, detector)

    def resume(
        self, begun: int, slams: list[LandmarkSlam], logs: list[float], pasts: list[list[Told]]
    ) -> None:
        """Go on from these explanations; begun: how many frames had been taken before the first that pasts tell."""
        whole = zip(slams, logs, pasts, strict=True)
        self._hypotheses = [Hypothesis(slam, log, past) for slam, log, past in whole]
        self._begun = begun

    # --- what it says -----------------------------------------------------------------------------------------

    @property
    def _first(self) -> Hypothesis:
        return self._hypotheses[0]

    @property
    def weights(self) -> np.ndarray:
        """(H,) of the explanations, the likeliest first."""
        logs = np.array([hypothesis.log_weight for hypothesis in self._hypotheses])
        weights = np.exp(logs - logs.max())
        return np.asarray(weights / weights.sum())

    @property
    def motion(self) -> MotionModel:
        return self._first.slam.motion

    @property
    def sensor(self) -> SensorModel:
        return self._first.slam.sensor

    @property
    def attribute_names(self) -> tuple[str, ...]:
        """Which attributes of sightings its association reads."""
        return self._first.slam.attribute_names

    @property
    def time(self) -> float:
        """Time of the last event, s; -inf before the first."""
        return self._first.slam.time

    @property
    def pose(self) -> np.ndarray:
        """(3,) of the likeliest explanation."""
        return self._first.slam.pose

    @property
    def pose_covariance(self) -> np.ndarray:
        """(3, 3) about the likeliest explanation's pose: its own, and by how much more the others differ from it.

        Never less than its own, so that it fits the map's: what others are surer of is left out.
        """
        own = self._first.slam.pose_covariance
        if len(self._hypotheses) == 1:
            return own
        off = np.array([hypothesis.slam.pose for hypothesis in self._hypotheses]) - self.pose
        off[:, 2] = wrap(off[:, 2])
        spreads = np.array([hypothesis.slam.pose_covariance for hypothesis in self._hypotheses])
        values, axes = np.linalg.eigh(spreads + off[:, :, None] * off[:, None] - own)
        more = (axes * np.maximum(values, 0.0)[:, None]) @ axes.transpose(0, 2, 1)
        return np.asarray(own + np.einsum("h,hij->ij", self.weights, more))

    @property
    def landmark_count(self) -> int:
        """How many landmarks the likeliest explanation holds."""
        return self._first.slam.landmark_count

    @property
    def frames_taken(self) -> int:
        """How many frames of sightings were taken."""
        return self._first.slam.frames_taken

    @property
    def frame_nis(self) -> float:
        """Of the likeliest explanation."""
        return self._first.slam.frame_nis

    @property
    def frame_used(self) -> int:
        """Of the likeliest explanation."""
        return self._first.slam.frame_used

    @property
    def frame_sightings(self) -> Sightings | None:
        """The last frame."""
        return self._first.slam.frame_sightings

    @property
    def frame_labels(self) -> np.ndarray:
        """(M,) of the last frame, by the likeliest explanation."""
        return self._first.slam.frame_labels

    @property
    def frame_decision(self) -> Frame | None:
        """Why, if it was asked for."""
        return self._first.slam.frame_decision

    def settled_labels(self, labels: np.ndarray) -> np.ndarray:
        """Labels as the likeliest explanation has them now."""
        return self._first.slam.settled_labels(labels)

    def estimate(self) -> Estimate:
        """A snapshot of the likeliest explanation; the pose's covariance holds what the others differ by."""
        return msgspec.structs.replace(self._first.slam.estimate(), covariance=self.pose_covariance)


def _carried_out(
    hypothesis: Hypothesis, options: list[Option], frame: Sightings, noises: np.ndarray
) -> list[Hypothesis]:
    """What becomes of one explanation: itself with the likeliest answer, and a copy for each other."""
    slams = [hypothesis.slam, *(hypothesis.slam.copy() for _ in options[1:])]
    pasts = [hypothesis.past, *(hypothesis.past.copy() for _ in options[1:])]
    if len(options) > 1:
        pasts[0] = hypothesis.past.copy()  # what was told before the frame is still asked for
    grown = []
    for slam, past, option in zip(slams, pasts, options, strict=True):
        slam.take_decided(frame, noises, option.association)
        slam.took(frame.time)
        past.append((slam.frame_labels, slam.frame_decision))
        grown.append(Hypothesis(slam, hypothesis.log_weight + option.log_likelihood, past))
    return grown


def _sorted(hypotheses: list[Hypothesis]) -> list[Hypothesis]:
    """The likeliest first, their logs relative to it."""
    best = max(hypothesis.log_weight for hypothesis in hypotheses)
    for hypothesis in hypotheses:
        hypothesis.log_weight -= best
    return sorted(hypotheses, key=lambda hypothesis: -hypothesis.log_weight)


def _joined(hypotheses: list[Hypothesis]) -> list[Hypothesis]:
    """One for those that have come to say the same: the heavier takes the lighter one's weight."""
    kept: list[Hypothesis] = []
    for hypothesis in hypotheses:
        for other in kept:
            if _alike(other.slam, hypothesis.slam):
                other.log_weight = float(np.logaddexp(other.log_weight, hypothesis.log_weight))
                break
        else:
            kept.append(hypothesis)
    return kept


def _alike(first: LandmarkSlam, second: LandmarkSlam) -> bool:
    """Whether two explanations hold as many landmarks and the same pose, equally sure of it."""
    if first.landmark_count != second.landmark_count:
        return False
    one, two = first.pose_covariance, second.pose_covariance
    wide, narrow = np.maximum(np.diag(one), np.diag(two)), np.minimum(np.diag(one), np.diag(two))
    if (wide > _NARROW * narrow + 1e-12).any():
        return False
    off = first.pose - second.pose
    off[2] = wrap(off[2])
    return bool(off @ np.linalg.pinv(one, hermitian=True) @ off < _ALIKE)


def _pruned(hypotheses: list[Hypothesis], most: int) -> list[Hypothesis]:
    """The likeliest, without those that hardly count."""
    least = hypotheses[0].log_weight + math.log(_LIGHT)
    return [hypothesis for hypothesis in hypotheses[:most] if hypothesis.log_weight >= least]


def _revisions(before: list[Told], now: list[Told], begun: int) -> Revisions:
    """What is told otherwise now of frames before the last; begun: the number of the first that is kept."""
    revised: Revisions = {}
    for k in range(len(now) - 2, -1, -1):
        if now[k] is before[k]:
            break
        revised[begun + k] = now[k]
    return revised
