"""Stages of the joint fit of both cameras: board shape, selection of pairs, motion of the board, lens field."""

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
    """Result of `fit_jointly`."""

    refinement: Refinement  # of the observations, corrected by the lens field if there is one
    lens_field: LensField | None
    candidates: tuple[TermsTried, ...]  # among which its terms were selected
    pairs: Pairs
    motion: PairMotion | None  # of the boards between the exposures


def fit_jointly(
    observations: Observations,
    start: Pairs,
    nominal: Array,
    tried: Sequence[Terms],
    table_view: int | None,
) -> JointFit:
    """Refine, test the pairs with the result, and refine again; then estimate motion of boards and the lens field.

    start : from rough cameras, which are best to detect that a camera was moved, as no pair has biased them
    tried : terms with candidate board shapes, simplest first
    table_view : determines the stereo pose if a camera was moved
    """
    # rough poses may be wrong by degrees: odd pairs are tested again with refined cameras
    used = replace(start, odd={}) if start.steps else start

    def refined(by: Pairs, motion: BoardMotion | None = None) -> tuple[Refinement, tuple[TermsTried, ...]]:
        return choose_board(observations, by.joined(observations), nominal, tried, motion)

    refinement, candidates = refined(used)
    # once is enough: images have separate poses of the board, and cameras without bad pairs give the same result
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
        # an (incomplete) lens field moves boards differently in each camera, too: use the scatter before it
        left, _ = motion_between_exposures(corrected) or found
        motion = replace(left, scatter=max(motion.scatter, left.scatter))
        likely = motion.is_seen
    if motion is not None and likely:
        refinement, candidates = refined(used, motion.as_random(nominal))
        field, corrected = fit_lens_field(refinement, nominal)
    return JointFit(corrected, field, candidates, pairs, motion)
