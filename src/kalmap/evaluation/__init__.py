"""How good a result is: trajectory and map errors, set distances, consistency, association, time, paired tests."""

from kalmap.evaluation.association import (
    AssociationScore,
    PairScore,
    Verdict,
    score_association,
    score_pairs,
)
from kalmap.evaluation.consistency import (
    NisSummary,
    chi2_band,
    mean_nees,
    nis_summary,
    pose_error,
    pose_nees,
    share_inside,
)
from kalmap.evaluation.crispness import Crispness, MapError, crispness, loop_error, map_error
from kalmap.evaluation.identities import sighting_identities
from kalmap.evaluation.landmarks import MapScore, pair_by_id, pair_by_nearest, score_by_id, score_by_nearest
from kalmap.evaluation.map_metrics import set_cutoffs
from kalmap.evaluation.metrics import Metrics, Options, evaluate
from kalmap.evaluation.owners import LandmarkScore, landmark_owners, score_landmarks
from kalmap.evaluation.paired import PairedTest, paired_test
from kalmap.evaluation.relations import RelationErrors, relation_errors, relation_metrics
from kalmap.evaluation.set_course import SetCourse, seen_so_far, set_errors_over_time
from kalmap.evaluation.sets import (
    CardinalityError,
    Cola,
    Gospa,
    Ospa,
    SetError,
    cardinality_error,
    cola,
    gospa,
    ospa,
)
from kalmap.evaluation.timing import StepTimes, step_times
from kalmap.evaluation.trajectory import (
    ErrorSummary,
    Matched,
    RelativeError,
    absolute_trajectory_error,
    heading_errors,
    match,
    position_errors,
    relative_errors,
    relative_pose_error,
)

__all__ = [
    "AssociationScore",
    "CardinalityError",
    "Cola",
    "Crispness",
    "ErrorSummary",
    "Gospa",
    "LandmarkScore",
    "MapError",
    "MapScore",
    "Matched",
    "Metrics",
    "NisSummary",
    "Options",
    "Ospa",
    "PairScore",
    "PairedTest",
    "RelationErrors",
    "RelativeError",
    "SetCourse",
    "SetError",
    "StepTimes",
    "Verdict",
    "absolute_trajectory_error",
    "cardinality_error",
    "chi2_band",
    "cola",
    "crispness",
    "evaluate",
    "gospa",
    "heading_errors",
    "landmark_owners",
    "loop_error",
    "map_error",
    "match",
    "mean_nees",
    "nis_summary",
    "ospa",
    "pair_by_id",
    "pair_by_nearest",
    "paired_test",
    "pose_error",
    "pose_nees",
    "position_errors",
    "relation_errors",
    "relation_metrics",
    "relative_errors",
    "relative_pose_error",
    "score_association",
    "score_by_id",
    "score_by_nearest",
    "score_landmarks",
    "score_pairs",
    "seen_so_far",
    "set_cutoffs",
    "set_errors_over_time",
    "share_inside",
    "sighting_identities",
    "step_times",
]
