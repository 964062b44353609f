"""The calibration views of a recording, or of two file patterns."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

from calibration import BoardTolerances, StereoCalibration, calibrate_stereo
from calibration.board.search import Progress
from calibration.board.target import Target
from calibration.kit.brief import Brief
from calibration.kit.types import AnyArray, Thickness, checked
from disctrack.errors import RecordingError
from disctrack.frames import CAMERAS
from disctrack.recording.declaration import CalibrationViews, Recording
from disctrack.recording.readers import open_frames
from disctrack.recording.readers.base import FrameReader, Part, Parts, cut_out
from disctrack.recording.readers.decoding import decode
from disctrack.recording.readers.files import IMAGES, content_of, file_number, match_files, split_member
from disctrack.recording.readers.flat_field import FlatField, FlatFields, flat_fields

MOST_VIEWS = 500  # ten times as many as a calibration needs; the time is proportional to the number


@dataclass(frozen=True)
class FrameView:
    """A view that is one frame of a file with many."""

    file: Path
    reader: FrameReader
    index: int

    def __str__(self) -> str:
        return self.reader.describe(self.index)

    @property
    def name(self) -> str:
        """The frame, for messages that already name the file."""
        return f"frame {self.index}"


View = Path | FrameView


@dataclass(frozen=True, repr=False)
class TargetImages(Brief):
    """Synchronised views; views i of left and right show the board in the same pose."""

    left: tuple[View, ...]
    right: tuple[View, ...]
    fields: FlatFields = (None, None)  # corrections of grey views of the size of the frames
    parts: Parts = (None, None)  # of the images that are used

    def __len__(self) -> int:
        return len(self.left)

    @property
    def place(self) -> Path:
        """Location of the left views, for messages."""
        first = self.left[0]
        return first.file if isinstance(first, FrameView) else first.parent

    def sha256(self) -> str:
        """SHA-256 (hex) of all views' content, in order."""
        digest = hashlib.sha256()
        for side, flat, part in zip((self.left, self.right), self.fields, self.parts, strict=True):
            if flat is not None:
                digest.update(flat.sha256.encode())
            if part is not None:
                digest.update(str(list(part)).encode())
            for view in side:
                if not isinstance(view, FrameView):
                    digest.update(hashlib.sha256(content_of(view, str(view))).digest())
                elif view.index == 0:
                    digest.update(view.reader.content_sha256(0, len(side)).encode())
        return digest.hexdigest()


@checked
def find_views(
    left: str, right: str, folder: str | Path, fields: FlatFields = (None, None), parts: Parts = (None, None)
) -> TargetImages:
    """Views that the two patterns match, paired by their order: a file each, or all frames of one file each.

    fields : of both cameras, if their views are to be corrected for gains and offsets of the pixels
    parts : of the images that belong to each camera; images of the size of their part are used whole
    Raises RecordingError if they do not pair up.

        >>> len(find_views("calibration/left/*.png", "calibration/right/*.png", "clip"))
        18
    """
    sides = [views_of(pattern, Path(folder), camera) for pattern, camera in zip((left, right), CAMERAS, strict=True)]
    numbers = [[view.index if isinstance(view, FrameView) else file_number(view) for view in side] for side in sides]
    alone = [
        [view.name for view, number in zip(side, own, strict=True) if number not in other]
        for side, own, other in zip(sides, numbers, reversed(numbers), strict=True)
    ]
    views = TargetImages(sides[0], sides[1], fields, parts)
    # without common numbers, the cameras count from different starts
    if len(sides[0]) != len(sides[1]) or 0 < len(alone[0]) < len(sides[0]):
        odd = [f"{camera} {', '.join(names[:3])}" for camera, names in zip(CAMERAS, alone, strict=True) if names]
        raise RecordingError(
            f"{views.place}: {len(sides[0])} left and {len(sides[1])} right calibration views do not pair up"
            + (f": without a partner are {' and '.join(odd)}" if odd else "")
            + ". Views are pairs, one image of each camera: add the missing ones, or move these away."
        )
    return views


def declared_views(recording: Recording, declared: CalibrationViews) -> TargetImages:
    """The calibration views of a recording. Raises RecordingError if they do not pair up."""
    fields = flat_fields(recording.folder, recording.sensors)
    return find_views(declared.left, declared.right, recording.folder, fields, recording.parts)


def views_of(pattern: str, folder: Path, camera: str, most: float = MOST_VIEWS) -> tuple[View, ...]:
    """Views of one camera, a file each or all frames of one file. Raises RecordingError, also if there are too many."""
    files = match_files(split_member(pattern)[0], folder, camera)
    suffix = files[0].suffix.lower()
    if suffix in IMAGES and not (len(files) == 1 and suffix in (".tif", ".tiff")):
        return tuple(files)
    reader = open_frames(pattern, folder, camera)
    if suffix in IMAGES and len(reader) == 1:
        return tuple(files)
    if len(reader) > most:
        raise RecordingError(
            f"{files[0]}: {len(reader)} frames for the {camera} camera, and every frame is a view of the chessboard. "
            f"Export at most {most} of them; 15 to 40 in different places are enough."
        )
    return tuple(FrameView(files[0], reader, index) for index in range(len(reader)))


@checked
def calibrate_views(
    views: TargetImages,
    target: Target,
    table_view: int | None = None,
    board_thickness: Thickness = 0.0,
    tolerances: BoardTolerances | None = None,
    progress: Progress | None = None,
) -> tuple[StereoCalibration, tuple[str, ...]]:
    """Calibrate from files; unreadable views are skipped, and named in the second item.

    table_view : index among all views; board_thickness [m]
    Raises RecordingError if the table view cannot be read, CalibrationError if the views do not allow a calibration.

        >>> views = find_views("calibration/left/*.png", "calibration/right/*.png", "clip")
        >>> board = read_recording("clip").chessboard
        >>> found, problems = calibrate_views(views, board, table_view=0, board_thickness=3e-3)
        >>> round(found.rig.baseline, 4), problems
        (0.2955, ())
    """
    if table_view is not None and not 0 <= table_view < len(views):
        raise RecordingError(
            f"{views.place}: [table] view = {table_view}, but there are {len(views)} calibration views, "
            "counted from 0. Name the view whose board lies flat on the table."
        )
    read: dict[int, tuple[AnyArray, ...]] = {}
    problems = []
    for i, pair in enumerate(zip(views.left, views.right, strict=True)):
        try:
            read[i] = tuple(map(_pixels, pair, views.fields, views.parts))
        except RecordingError as error:
            if i == table_view:
                raise RecordingError(f"{error} It is the table view: without it there is no lab frame.") from error
            problems.append(f"left out: {error}")
    names = [(str(views.left[i]), str(views.right[i])) for i in read]
    position = None if table_view is None else list(read).index(table_view)
    left, right = ([pair[side] for pair in read.values()] for side in (0, 1))
    found = calibrate_stereo(left, right, target, tolerances, position, board_thickness, names, progress)
    return found, tuple(problems)


def pixels_of(view: View) -> AnyArray:
    """Grey values or colours of a view as stored. Raises RecordingError."""
    if isinstance(view, FrameView):
        return view.reader.read(view.index)
    return decode(content_of(view, str(view)), str(view))


def _pixels(view: View, flat: FlatField | None, part: Part | None) -> AnyArray:
    """Corrected grey values or colours of a view. Raises RecordingError, which names the file or frame."""
    image = pixels_of(view)
    whole = flat.corrected(image) if flat is not None and flat.fits(image) else image
    return whole if part is None else cut_out(whole, part, str(view))
