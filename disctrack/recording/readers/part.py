"""A part of every image as the images of a camera: of one sensor behind mirrors, or of two images stored in one."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disctrack.errors import RecordingError
from disctrack.recording.readers.base import Changed, FrameReader


@dataclass(frozen=True)
class ImagePart:
    """Columns x to x + width - 1 and rows y to y + height - 1 [px] of an image."""

    x: int
    y: int
    width: int
    height: int

    def of(self, image: NDArray) -> NDArray:
        """The part of an image (h, w) or (h, w, channels); an image of the part's own size is that part already."""
        if image.shape[:2] == (self.height, self.width):
            return image
        return np.ascontiguousarray(image[self.y : self.y + self.height, self.x : self.x + self.width])

    def lies_in(self, width: int, height: int) -> bool:
        """Whether an image of this size [px] has the whole part."""
        return self.x + self.width <= width and self.y + self.height <= height

    def __str__(self) -> str:
        return f"[{self.x}, {self.y}, {self.width}, {self.height}]"


ImageParts = tuple[ImagePart | None, ...]  # of the left and of the right camera


def frames_in_parts(readers: Sequence[FrameReader], parts: ImageParts, where: str) -> list[FrameReader]:
    """Both cameras' readers, of the declared parts. Raises RecordingError, which begins with `where`, if one is cut."""
    found: list[FrameReader] = []
    for reader, part in zip(readers, parts, strict=True):
        if part is None:
            found.append(reader)
            continue
        width, height = reader.image_size
        if not part.lies_in(width, height):
            raise RecordingError(
                f"{where}: [cameras] {reader.camera}_part is {part}, columns {part.x} to {part.x + part.width - 1} and "
                f"rows {part.y} to {part.y + part.height - 1}, but {reader.describe(0)} has {width} x {height} px. It "
                "is [x, y, width, height] in pixels, from the upper left corner."
            )
        found.append(Changed(reader, part.of, str(part), image_size=(part.width, part.height)))
    return found
