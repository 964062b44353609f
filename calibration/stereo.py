"""From synchronised views of a chessboard, or its corners, to a calibrated stereo rig with its uncertainty."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike

from calibration.board.chessboard import BoardNotFound, CornerView, Located, negatives
from calibration.board.search import Progress, located
from calibration.board.target import Board, Target
from calibration.cameras.camera import CAMERA_NAMES, StereoRig
from calibration.fit.board_motion import BoardMotion
from calibration.fit.lens_field import fit_lens_field
from calibration.fit.pairing import FLOOR, MIN_VIEWS, Names, Pairs, Views, count_once
from calibration.fit.refinement import Refinement, refine_stereo
from calibration.fit.start import TooWide, start_stereo, too_wide
from calibration.fit.stereo_model import Observations
from calibration.judge.assessment import Assessment, assess, stereo_covariance
from calibration.judge.pairs import PairMotion, camera_moved, compared, judge_pairs, motion_between_exposures, zoomed
from calibration.judge.tolerances import BoardTolerances, board_shape, rig_with_covariance, with_tolerances
from calibration.kit.brief import Brief
from calibration.kit.errors import CalibrationError, told_as
from calibration.kit.stuck_pixels import repaired_views
from calibration.kit.threads import one_blas_thread
from calibration.kit.types import AnyArray, Array, Thickness, checked

LARGEST_SQUARE = 0.5  # m: above, the value was given in millimetres
UNDETERMINED = "the views do not determine all parameters: add views with the board tilted in several directions"
OVERSTATED = 0.7  # scatter of corners over the declared sigma, below which the sigma is too large

Image = tuple[str, str]  # name of an unused image, and the reason


@dataclass(frozen=True, repr=False)
class StereoCalibration(Brief):
    """A calibrated rig and all data needed to assess it, or to repeat the calibration without the images."""

    rig: StereoRig  # with covariance (30, 30)
    refinement: Refinement  # observations, residuals, which were kept
    board: Target
    tolerances: BoardTolerances
    table_view: int | None
    board_thickness: float  # [m]
    view_names: tuple[tuple[str, str], ...]  # (n_views,) left and right name
    corner_views: tuple[tuple[Located, ...], tuple[Located, ...]]
    assessment: Assessment
    warnings: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()  # reasons for which errors of the rig may exceed its sigmas
    apart: tuple[int, ...] = ()  # views whose two images are used separately

    def facts(self) -> dict[str, str]:
        """Main results (`Brief`)."""
        used = len(self.view_names) - len(self.rejected_views)
        return {
            "views": f"{used} of {len(self.view_names)}",
            "stereo misfit": f"{self.assessment.stereo_misfit_px:.4f} px in views left out",
            **self.rig.facts(),
            "verdict": self.assessment.verdict,
        }

    @property
    def rejected_views(self) -> dict[int, str]:
        """View -> why neither of its two images is used."""
        return {v: _listed(images) for v, images in _not_used(self.corner_views, self.view_names).items()}

    @property
    def reasons(self) -> dict[str, list[str]]:
        """Why views are not used -> names of their images."""
        return _by_reason(chain(*_not_used(self.corner_views, self.view_names).values()))

    @property
    def board_points(self) -> Array:
        """(n, 3) [m] as refined."""
        return self.refinement.model.points

    @property
    def rms_px(self) -> float:
        """Root mean square distance between located and predicted corners [px], both cameras."""
        return self.refinement.rms()

    @property
    def rms_per_camera_px(self) -> tuple[float, ...]:
        """The same of each camera."""
        return tuple(self.refinement.rms(self.refinement.observations.camera == c) for c in range(len(CAMERA_NAMES)))

    @property
    def rms_per_view_px(self) -> Array:
        """(n_views, 2 cameras) [px]; NaN if a view was not used."""
        image = 2 * self.refinement.observations.view + self.refinement.observations.camera
        return np.array([self.refinement.rms(image == i) for i in range(2 * len(self.view_names))]).reshape(-1, 2)

    @property
    def lens_rms_px(self) -> tuple[float, ...]:
        """Root mean square per axis of the lens field of each camera, at the used corners; () without one."""
        field, used = self.rig.lens_field, self.refinement.problem.observations
        moved = [field.displacement(used.pixels[used.camera == c], c) for c in (0, 1)] if field else []
        return tuple(float(np.sqrt(np.mean(by**2))) for by in moved)

    def rejected_corners(self) -> list[tuple[int, int, int, str]]:
        """(view, camera, corner, reason) of every corner that was found but not used."""
        rejected = []
        for camera, views in enumerate(self.corner_views):
            for v, view in enumerate(views):
                if isinstance(view, CornerView):
                    rejected += [(v, camera, i, reason) for i, reason in enumerate(view.reasons) if reason]
        r, o = self.refinement, self.refinement.observations
        for i in np.flatnonzero(~r.kept):
            distance = float(np.linalg.norm(r.residuals[i]))
            reason = f"{distance:.3f} px from where all other corners put it"
            rejected.append((int(o.view[i]), int(o.camera[i]), int(o.point[i]), reason))
        return rejected


@one_blas_thread
@checked
def calibrate_stereo(
    left_images: Sequence[AnyArray],
    right_images: Sequence[AnyArray],
    board: Target,
    tolerances: BoardTolerances | None = None,
    table_view: int | None = None,
    board_thickness: Thickness = 0.0,
    names: Sequence[tuple[str, str]] | None = None,
    progress: Progress | None = None,
) -> StereoCalibration:
    """Calibrate from images; images i of the left and of the right camera show the board in the same place.

    left_images, right_images : grey or colour images as OpenCV reads them unchanged, 8 or 16 bit
    table_view : index of the view whose board lies flat on the table; None: world axes are those of the left camera
    board_thickness : [m] from the table to the printed face
    names : (left, right) name of every view, for messages
    progress : called as progress(stage, done, total)

    Raises CalibrationError if the views do not allow a calibration; single bad views are left out with a reason.
    """
    if len(left_images) != len(right_images):
        raise CalibrationError(
            f"{len(left_images)} left and {len(right_images)} right images: views are pairs, one image of each camera"
        )
    names = names or [(f"left {i}", f"right {i}") for i in range(len(left_images))]
    check_sizes(left_images, right_images, names)
    sides, notes = zip(*map(repaired_views, (left_images, right_images), CAMERA_NAMES), strict=True)
    images, n = [*chain(*sides)], len(left_images)
    views = located(images, board, progress)
    found = calibrate_from_corners(views[:n], views[n:], board, tolerances, table_view, board_thickness, names)
    negative = negatives(images, [*chain(*found.corner_views)], board) if isinstance(board, Board) else ""
    doubts = (negative,) if negative else ()
    return replace(found, doubts=doubts, warnings=(*filter(None, notes), *found.warnings))


def check_sizes(left: Sequence[AnyArray], right: Sequence[AnyArray], names: Sequence[tuple[str, str]]) -> None:
    """Raises CalibrationError if the images of a camera are of different sizes."""
    for camera, images in enumerate((left, right)):
        for i, image in enumerate(images):
            if np.ndim(image) < 2:
                raise CalibrationError(f"{names[i][camera]}: not an image, its shape is {np.shape(image)}")
            (h, w), (h0, w0) = image.shape[:2], images[0].shape[:2]
            if (h, w) != (h0, w0):
                raise CalibrationError(
                    f"{names[i][camera]}: {CAMERA_NAMES[camera]} image is {w} x {h} px, but {names[0][camera]} is "
                    f"{w0} x {h0} px. One camera has one image size: leave this view out, or export it again."
                )


@told_as(CalibrationError, UNDETERMINED, np.linalg.LinAlgError)
@one_blas_thread
@checked
def calibrate_from_corners(
    left_views: Sequence[Located],
    right_views: Sequence[Located],
    board: Target,
    tolerances: BoardTolerances | None = None,
    table_view: int | None = None,
    board_thickness: Thickness = 0.0,
    names: Sequence[tuple[str, str]] | None = None,
) -> StereoCalibration:
    """`calibrate_stereo` from located corners."""
    tolerances = tolerances or BoardTolerances()
    names = tuple(names or [(f"left {i}", f"right {i}") for i in range(len(left_views))])
    views = (list(left_views), list(right_views))
    count_once(views, names, table_view)
    _require_views(views, names, table_view)
    start, notes = _begin(views, board, names)
    observations = _observations(views)
    wide = too_wide(observations, board.points, start.model.rig.cameras)
    start = compared(observations, start, table_view, FLOOR)
    if start.steps and (lenses := zoomed(observations, start, board.points)):
        for camera, why in lenses.items():
            for v in start.others:
                views[camera][v] = BoardNotFound(why)
        return calibrate_from_corners(*views, board, tolerances, table_view, board_thickness, names)
    refinement, pairs, motion = _fit_jointly(observations, start, board.points, table_view)
    for (v, camera), why in pairs.bad_images.items():
        views[camera][v] = BoardNotFound(why)
    apart = _warnings_of_pairs(pairs, names, table_view)
    not_used = _not_used(views, names)
    reasons = dict.fromkeys(pairs.apart, "".join(apart[:1])) | {v: _listed(images) for v, images in not_used.items()}
    _require_table(table_view, reasons)
    _require_fitted(refinement, chain(*not_used.values()), wide)
    shape = board_shape(refinement, board.points, refinement.inflation)
    common = None if refinement.problem.motion else motion_between_exposures(refinement)[1]
    covariance = stereo_covariance(refinement, common)
    rig = rig_with_covariance(refinement, table_view, board_thickness, refinement.inflation, covariance, shape.origin)
    with_board = with_tolerances(rig, board.points, board_thickness, tolerances, shape)
    assessment = assess(refinement, rig, with_board, motion, wide)
    return StereoCalibration(
        rig=with_board,
        refinement=refinement,
        board=board,
        tolerances=tolerances,
        table_view=table_view,
        board_thickness=board_thickness,
        view_names=names,
        corner_views=(tuple(views[0]), tuple(views[1])),
        apart=tuple(sorted(pairs.apart)),
        assessment=assessment,
        warnings=(*_used_alone(views, names), *notes, *apart, *assessment.warnings),
    )


@checked
def calibrate_from_points(
    left: Sequence[ArrayLike | None],
    right: Sequence[ArrayLike | None],
    board: Board,
    image_size: tuple[int, int] | tuple[tuple[int, int], tuple[int, int]],
    sigma_px: float,
    tolerances: BoardTolerances | None = None,
    table_view: int | None = None,
    board_thickness: Thickness = 0.0,
) -> StereoCalibration:
    """Calibrate a stereo pair from corners located elsewhere; items i of both lists show the board in the same place.

    left, right : per view (n, 2) [px] in the order of `Board.points`, pixel (0, 0) the centre of the top-left pixel;
        None if the camera did not see the board
    image_size : (width, height) [px] of both cameras, or of each
    sigma_px : standard deviation of a corner per axis; further noise is estimated from the residuals and added; a
        warning is given if the residuals are smaller

    Raises CalibrationError that names camera, view and corner of invalid data.
    """
    if len(left) != len(right):
        raise CalibrationError(f"{len(left)} left and {len(right)} right views: give None where a camera saw no board")
    if not (np.isfinite(sigma_px) and sigma_px > 0):
        raise CalibrationError(f"sigma_px = {sigma_px}: the standard deviation of a corner must be above 0 px")
    if board.square > LARGEST_SQUARE:
        raise CalibrationError(
            f"the board's squares are {board.square:g} m: lengths are in metres, {board.square:g} mm is "
            f"{board.square * 1e-3:g}"
        )
    sizes = np.broadcast_to(image_size, (2, 2)).tolist()
    views = [
        [_view(points, board, tuple(size), sigma_px, f"{name} view {v}") for v, points in enumerate(side)]
        for side, size, name in zip((left, right), sizes, CAMERA_NAMES, strict=True)
    ]
    found = calibrate_from_corners(views[0], views[1], board, tolerances, table_view, board_thickness)
    shown = sigma_px * float(np.sqrt(found.refinement.chi_square))
    if shown < OVERSTATED * sigma_px:
        note = f"the corners scatter by {shown:.3g} px, {sigma_px:g} px were declared: the stated sigmas are too large"
        found = replace(found, warnings=(*found.warnings, note))
    return found


def _view(points: ArrayLike | None, board: Board, image_size: tuple[int, int], sigma: float, where: str) -> Located:
    if points is None:
        return BoardNotFound("no corners were given")
    pixels, n, size = np.asarray(points, float), len(board.points), np.array(image_size)
    if pixels.shape not in ((n, 2), (n, 1, 2)):
        raise CalibrationError(
            f"{where}: corners of shape {pixels.shape}, expected ({n}, 2) for {board}; a view with a corner missing "
            "must be left out (None)"
        )
    pixels = pixels.reshape(n, 2)
    bad = np.flatnonzero(~((pixels >= -0.5) & (pixels <= size - 0.5)).all(axis=1))
    if len(bad):
        x, y = pixels[bad[0]]
        raise CalibrationError(
            f"{where}: corner {bad[0]} at ({x:.1f}, {y:.1f}) does not lie in the image of {size[0]} x {size[1]} px: "
            "leave the view out (None), or mend it; are width and height, or x and y, exchanged?"
        )
    return CornerView(image_size, pixels, np.tile(sigma**2 * np.eye(2), (n, 1, 1)), np.ones(n, bool), ("",) * n)


def _begin(views: Views, board: Target, names: Names) -> tuple[Pairs, list[str]]:
    """Rough cameras and poses, and notes about the pairs.

    For a symmetric board, the order of corners in the right views is changed, in place, to that of the left ones.
    """
    sizes = [next(v.image_size for v in side if isinstance(v, CornerView)) for side in views]
    start, orders, notes = start_stereo(_observations(views), board, sizes, names)
    if len(board.orders) == 1:
        return start, notes
    for v, order in orders.items():
        view = views[1][v]
        views[1][v] = view.reordered(order) if isinstance(view, CornerView) else view
    choice = (
        f"{board} looks the same after a turn: the two cameras were made to agree, but which corner is the lab frame's "
        "origin is a choice (i points to the right in the left image). An odd by an even count leaves no choice."
    )
    return start, [*notes, choice]


def _fit_jointly(
    observations: Observations, start: Pairs, nominal: Array, table_view: int | None
) -> tuple[Refinement, Pairs, PairMotion | None]:
    """Refine, test the pairs with the result, and refine again; then estimate motion of boards and the lens field.

    Returns also the pairs, and the motion of the boards between the exposures.

    start : from rough cameras, which are best to detect that a camera was moved, as no pair has biased them
    table_view : determines the stereo pose if a camera was moved
    """
    # rough poses may be wrong by degrees: odd pairs are tested again with refined cameras
    used = replace(start, odd={}) if start.steps else start

    def refined(by: Pairs, motion: BoardMotion | None = None) -> Refinement:
        return refine_stereo(observations, by.joined(observations), nominal, motion=motion)

    refinement = refined(used)
    # once is enough: images have separate poses of the board, and cameras without bad pairs give the same result
    pairs = judge_pairs(observations, refinement, table_view)
    if pairs.apart != used.apart or pairs.bad_images:
        for view, camera in pairs.bad_images:
            observations = observations[(observations.view != view) | (observations.camera != camera)]
        used = pairs
        refinement = refined(used)
    (motion, _), corrected = motion_between_exposures(refinement), fit_lens_field(refinement)
    if motion is None or not motion.is_likely:
        return corrected, pairs, motion
    if corrected.lens_field is not None:
        # an (incomplete) lens field moves boards differently in each camera, too: use the scatter before it
        left = motion_between_exposures(corrected)[0] or motion
        motion = replace(left, scatter=max(motion.scatter, left.scatter))
        if not motion.is_seen:
            return corrected, pairs, motion
    return fit_lens_field(refined(used, motion.as_random(nominal))), pairs, motion


def _require_table(table_view: int | None, unusable: Mapping[int, str]) -> None:
    """Raises CalibrationError if the table view is one of the `unusable`, for the reason given there."""
    if table_view is not None and table_view in unusable:
        raise CalibrationError(
            f"the table view {table_view} cannot be used ({unusable[table_view]}): without it there is no lab frame. "
            "Name another view whose board lies flat on the table, or take it again."
        )


def _require_fitted(refinement: Refinement, not_used: Iterable[Image], wide: TooWide) -> None:
    """Raises CalibrationError if too few views can be used, or if they contradict each other."""
    n_used = len(np.unique(refinement.problem.observations.view))
    if n_used < MIN_VIEWS:
        also = "".join(f"{what}: {by_what}. " for what, by_what in wide)
        listed = _listed(not_used)
        raise CalibrationError(f"{also}Only {n_used} views can be used, at least {MIN_VIEWS} are needed: {listed}")
    for name, camera in zip(CAMERA_NAMES, refinement.model.rig.cameras, strict=True):
        if not min(camera.fx, camera.fy) > 0.0:
            raise CalibrationError(
                f"{name} camera: focal lengths {camera.fx:.1f} and {camera.fy:.1f} px are those of no camera: the "
                "views contradict each other. Are they of one board, and left and right of one moment?"
            )


def _lost(views: tuple[Sequence[Located], ...], names: Names) -> Iterator[list[Image]]:
    """The images of each view that are not used."""
    for v, pair in enumerate(zip(*views, strict=True)):
        yield [(names[v][c], view.reason) for c, view in enumerate(pair) if isinstance(view, BoardNotFound)]


def _not_used(views: tuple[Sequence[Located], ...], names: Names) -> dict[int, list[Image]]:
    """Views that neither camera can use."""
    return {v: images for v, images in enumerate(_lost(views, names)) if len(images) == len(CAMERA_NAMES)}


def _used_alone(views: Views, names: Names) -> list[str]:
    """Warnings about views that only one camera can use, and notes about images."""
    alone = _by_reason(image for images in _lost(views, names) if len(images) == 1 for image in images)
    warnings = [
        f"{', '.join(which)}: left out, the other image of the pair is used for its own camera: {reason}"
        for reason, which in alone.items()
    ]
    return warnings + sorted({note for side in views for v in side if isinstance(v, CornerView) for note in v.notes})


def _require_views(views: Views, names: Names, table_view: int | None) -> None:
    if table_view is not None and not 0 <= table_view < len(names):
        raise CalibrationError(f"table view {table_view} does not exist: there are views 0 to {len(names) - 1}")
    if not views[0]:
        raise CalibrationError("no calibration views were given")
    for camera, side in enumerate(views):
        found = sum(isinstance(view, CornerView) for view in side)
        if found < MIN_VIEWS:
            lost = ((names[v][camera], view.reason) for v, view in enumerate(side) if isinstance(view, BoardNotFound))
            raise CalibrationError(
                f"the board was found in {found} of {len(side)} {CAMERA_NAMES[camera]} images, at least {MIN_VIEWS} "
                f"are needed (15 to 40 are good). {_listed(lost)}"
            )


def _by_reason(images: Iterable[Image]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for name, reason in images:
        found.setdefault(reason, []).append(name)
    return found


def _listed(images: Iterable[Image]) -> str:
    """Each reason once, with the images that have it, or the first of more than two; three reasons at most."""
    reasons = _by_reason(images)
    shown = [
        f"{' and '.join(which if len(which) < 3 else [which[0], f'{len(which) - 1} more'])}: {reason}"
        for reason, which in list(reasons.items())[:3]
    ]
    more = sum(len(which) for which in list(reasons.values())[3:])
    return "; ".join(shown) + (f"; and {more} more" if more else "")


def _observations(views: Views) -> Observations:
    parts: list[tuple[AnyArray, ...]] = []
    for camera, side in enumerate(views):
        for v, view in enumerate(side):
            if isinstance(view, CornerView):
                index = np.flatnonzero(view.accepted)
                place = (np.full(len(index), number) for number in (v, camera))
                parts.append((*place, index, view.points[index], view.covariance[index]))
    return Observations(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _warnings_of_pairs(pairs: Pairs, names: Names, table_view: int | None) -> list[str]:
    """Warnings about pairs whose images are used separately, each for its own camera."""
    warnings = [camera_moved(pairs, names, table_view)] if pairs.steps else []
    if apart := {v: why for v, why in pairs.odd.items() if v not in pairs.others}:
        shown = [f"{names[v][0]} and {names[v][1]} ({why})" for v, why in list(apart.items())[:3]]
        more = f" and {len(apart) - 3} more" if len(apart) > 3 else ""
        warnings.append(
            f"{'; '.join(shown)}{more}: the two images do not show the board in one place: it moved between the "
            "exposures, or they are not a pair. Each image is used for its own camera, none of them for how the "
            "cameras stand to each other"
        )
    return warnings
