"""The rounds of a joint fit of both cameras: the board's shape, which images are pairs, what moved, the lenses."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from calibration.cameras.splines import LensField
from calibration.fit.board_motion import BoardMotion
from calibration.fit.lens_field import fit_lens_field
from calibration.fit.pairing import Pairs
from calibration.fit.refinement import Refinement, TermsTried, choose_board
from calibration.fit.stereo_model import Observations, Terms
from calibration.judge.pairs import PairMotion, judge_pairs, motion_between_exposures
from calibration.kit.arrays import Array


@dataclass(frozen=True)
class JointFit:
    """What `fit_jointly` arrives at."""

    refinement: Refinement  # of observations that the field of the lenses has corrected, where there is one
    lens_field: LensField | None
    candidates: tuple[TermsTried, ...]  # of which its terms were chosen
    pairs: Pairs
    motion: PairMotion | None  # of the boards between the exposures


def fit_jointly(
    observations: Observations,
    start: Pairs,
    nominal: Array,
    tried: Sequence[Terms],
    table_view: int | None,
) -> JointFit:
    """Refine, judge the pairs by what is refined, and refine again; then see whether boards moved, or lenses bend.

    start : by rough cameras: that one was moved is seen best by those that no pair has pulled yet
    tried : terms with the board's shapes to choose of, simplest first
    table_view : where a camera was moved, the cameras' places are those at it
    """
    # rough poses may be degrees off: refined cameras judge those anew that do not agree
    used = replace(start, odd={}) if start.steps else start

    def refined(by: Pairs, motion: BoardMotion | None = None) -> tuple[Refinement, tuple[TermsTried, ...]]:
        return choose_board(observations, by.joined(observations), nominal, tried, motion)

    refinement, candidates = refined(used)
    # once: it is by a place of the board for each image, and finds as many by cameras that no bad pair pulls any more
    pairs = judge_pairs(observations, refinement, table_view)
    if pairs.apart != used.apart or pairs.bad_images:
        for view, camera in pairs.bad_images:
            observations = observations[(observations.view != view) | (observations.camera != camera)]
        used = pairs
        refinement, candidates = refined(used)
    found, (field, corrected) = motion_between_exposures(refinement), fit_lens_field(refinement, nominal)
    motion = found and found[0]
    likely = motion is not None and motion.is_likely
    if found is not None and motion is not None and likely and field is not None:
        # a field puts boards elsewhere for each camera, too, and what is left of it does: by the scatter before it
        left, _ = motion_between_exposures(corrected) or found
        motion = replace(left, scatter=max(motion.scatter, left.scatter))
        likely = motion.is_seen
    if motion is not None and likely:
        refinement, candidates = refined(used, motion.as_random(nominal))
        field, corrected = fit_lens_field(refinement, nominal)
    return JointFit(corrected, field, candidates, pairs, motion)
