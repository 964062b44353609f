"""Frames in an HDF5 file: a data set (n, height, width) of 8 or 16 bit whole numbers.

recording.toml names it `frames.h5:/path`, or the file alone if it has only one such data set. Used attributes of the
data set (or of its group): `frame_rate` [Hz], `bit_depth`; and `timestamps` [s], an attribute, or a data set (n,) in
the same group. A contiguous data set is read at the speed of memory.
"""

import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import h5py
import numpy as np

from calibration.kit.types import Array, Image
from disctrack.errors import RecordingError, told_as
from disctrack.recording.readers import raw
from disctrack.recording.readers.base import FrameReader, only_file, room_for
from disctrack.recording.readers.decoding import inflated
from disctrack.recording.readers.raw import PixelLayout, RawFile, bit_depth_of, check_frame_size, raw_frames

_LARGEST_CACHE = 64 << 20  # bytes for decompressed chunks; more than a usual chunk of many frames


def open_hdf5(files: Sequence[Path], camera: str, member: str = "") -> FrameReader:
    """Reader of one data set. Raises RecordingError if there is none, or several and none is named."""
    file = only_file(files, camera)
    with told_as(RecordingError, f"{file}: not a readable HDF5 file", OSError, then="Copy it again."):
        handle = h5py.File(file, "r", rdcc_nbytes=_LARGEST_CACHE, rdcc_w0=1.0)
    try:
        with told_as(RecordingError, f"{file}: the HDF5 file is damaged", Exception, then="Copy it again."):
            return _open(handle, _stack(handle, member, file), file)
    except RecordingError:
        handle.close()
        raise


def _is_stack(item: object) -> bool:
    return isinstance(item, h5py.Dataset) and item.ndim == 3 and item.dtype.kind == "u" and item.dtype.itemsize <= 2


def _stack(handle: h5py.File, member: str, file: Path) -> h5py.Dataset:
    """The data set of this name, or the only one that may be frames. Raises RecordingError."""
    item = handle.get(member) if member else None
    if _is_stack(item):
        return item
    stacks = stacks_of(handle)
    names = ", ".join(stack.name for stack in stacks) or "none"
    if len(stacks) == 1 and not member:
        return stacks[0]
    found = f"{item.shape} of {item.dtype}" if isinstance(item, h5py.Dataset) else "nothing, or a group"
    said = f":{member} is {found}" if member else ": one of several stacks, or none, is meant"
    raise RecordingError(
        f"{file}{said}; expected frames (n, height, width) of 8 or 16 bit without sign. There are {names}. "
        f"Name one: {file.name}:/path."
    )


def stacks_of(handle: h5py.File) -> list[h5py.Dataset]:
    """Data sets that may be frames; links to other files are not followed."""
    found: list[h5py.Dataset] = []
    handle.visititems(lambda _, item: found.append(item) if _is_stack(item) else None)
    return found


def _open(handle: h5py.File, stack: h5py.Dataset, file: Path) -> FrameReader:
    (n, height, width), where = stack.shape, f"{file}:{stack.name}"
    check_frame_size(width, height, where)
    most = 4 * raw.MOST_PIXELS  # bytes: the library reads whole chunks, whatever the file's size
    if stack.chunks and np.prod(stack.chunks, dtype=float) * stack.dtype.itemsize > most:
        said = f"one chunk {stack.chunks} holds more than {most >> 20} MB, all of which is read for any frame in it"
        raise RecordingError(f"{where}: {said}. Write it again with chunks of one frame.")
    if stack.external:
        raise RecordingError(f"{where}: its pixels lie in {stack.external[0][0]}. Write them into {file}.")
    stored = _frames_stored(stack)
    # a few missing frames are allowed; the header of a damaged file may state any number
    if stored < max(raw.LEAST_PRESENT * n, 1):
        said = f"announces {n} frames, but at most {stored} were ever written: cut short"
        raise RecordingError(f"{where}: {said}. Write it again, or give the data set its true length.")
    _check_other_files(stack, file, where)
    rate, bits = _attribute(stack, "frame_rate"), _attribute(stack, "bit_depth")
    common: dict[str, Any] = {
        "bit_depth": bit_depth_of(8 * stack.dtype.itemsize, int(bits or 0)),
        "timestamps": _timestamps(stack, n, where),
        "frame_rate": rate if rate is not None and rate > 0 else None,
    }
    number = stack.id.get_type()
    # False if a pixel's bits are only a part of its bytes: then the library has to convert them
    whole = number.get_precision() == 8 * number.get_size() and number.get_offset() == 0
    offset = stack.id.get_offset() if stack.chunks is None and not stack.is_virtual else None
    if offset is not None and whole:
        layout = PixelLayout(width, height, stack.dtype)
        handle.close()
        starts = offset + layout.frame_bytes * np.arange(n)
        return raw_frames(files=[RawFile(file)] * n, offsets=starts, layout=layout, **common)
    together, n_filters = stack.chunks[0] if stack.chunks else 1, stack.id.get_create_plist().get_nfilters()
    deflated = stack.compression == "gzip" and n_filters == 1 + stack.shuffle
    slow = f"chunks of {together} frames are decompressed anew for each of them; chunks of one frame are read faster"
    apart = bool(whole and deflated and stack.chunks == (1, height, width))
    decoded = _decoding(stack, apart)
    return FrameReader(
        files=cast(Sequence[str], np.broadcast_to(where, n)),  # no list: a virtual data set may state any n
        image_size=(int(width), int(height)),
        dtype=stack.dtype.newbyteorder("="),
        decoded=decoded,
        stored=lambda index: decoded(index, None, "").data,
        random_access=apart,
        notes=(slow,) if together > max(1, _LARGEST_CACHE // (width * height * stack.dtype.itemsize)) else (),
        **common,
    )


def _frames_stored(stack: h5py.Dataset) -> int:
    """Upper limit of the number of written frames, from the storage size."""
    if stack.is_virtual:
        return int(stack.shape[0])
    if stack.chunks is None:
        return int(stack.id.get_storage_size() // max(1, int(np.prod(stack.shape[1:])) * stack.dtype.itemsize))
    return int(stack.id.get_num_chunks()) * int(stack.chunks[0])


def _check_other_files(stack: h5py.Dataset, file: Path, where: str) -> None:
    """Raise RecordingError if pixels are in other files that do not exist: the library would return zeros."""
    sources = stack.virtual_sources() if stack.is_virtual else ()
    for name in sorted({source.file_name for source in sources} - {"."}):
        if "%" not in name and not (file.parent / name).exists() and not Path(name).exists():
            raise RecordingError(f"{where}: takes frames from {name}, which is not there. Copy it beside {file}.")


def _attribute(stack: h5py.Dataset, name: str) -> float | None:
    """A number among the attributes of the data set or of its group."""
    value = np.ravel(stack.attrs.get(name, stack.parent.attrs.get(name)))
    return float(value[0]) if value.size == 1 and value.dtype.kind in "iuf" and np.isfinite(value[0]) else None


def _timestamps(stack: h5py.Dataset, n: int, where: str) -> Array | None:
    stamps = stack.attrs.get("timestamps", stack.parent.get("timestamps"))
    if stamps is None or (isinstance(stamps, h5py.Dataset) and stamps.ndim != 1):
        return None
    values = stamps if isinstance(stamps, h5py.Dataset) else np.asarray(stamps)
    if values.dtype.kind not in "iuf" or values.shape != (n,):
        found = f"{values.shape} of {values.dtype}"
        raise RecordingError(f"{where}: timestamps are {found}; expected {n} times in s, one for each frame.")
    return np.asarray(values[()], np.float64)


def _decoding(stack: h5py.Dataset, apart: bool) -> Callable[[int, Image | None, str], Image]:
    """Function that decodes a frame of a data set in chunks, with or without compression.

    The library is not parallel. If each frame is a chunk compressed by deflate (`apart`), it only reads the compressed
    bytes, and frames are inflated in parallel, with random access.
    """
    lock, dtype, (_, height, width) = threading.Lock(), stack.dtype.newbyteorder("="), stack.shape

    def decoded(index: int, out: Image | None, where: str) -> Image:
        image, content = room_for(out, (width, height), dtype), None
        with lock, told_as(RecordingError, f"{where}: cannot be read", Exception, then="Copy the file again."):
            size = _stored_size(stack, index)
            if size == 0:
                raise RecordingError(f"{where}: was never written to the file. Copy or write it again.")
            if apart and size <= 2 * image.nbytes:
                mask, content = stack.id.read_direct_chunk((index, 0, 0))
                content = None if mask else content  # if a filter was not applied, the library has to decode the chunk
            if content is None:
                stack.read_direct(image, np.s_[index])
        if content is not None:
            _inflate(stack, content, image, where)
        return image

    return decoded


def _inflate(stack: h5py.Dataset, content: bytes, image: Image, where: str) -> None:
    """Undo deflate and, before it, shuffle (all first bytes of the pixels, then all second ones)."""
    whole = inflated(content, image.nbytes)
    if whole is None:
        said = f"its {len(content)} compressed bytes do not hold the {image.nbytes} of an image"
        raise RecordingError(f"{where}: damaged ({said}). Copy the file again.")
    stored = np.frombuffer(whole, np.uint8)
    if stack.shuffle:
        stored = stored.reshape(image.itemsize, -1).T.ravel()
    image[...] = stored.view(stack.dtype).reshape(image.shape)


def _stored_size(stack: h5py.Dataset, index: int) -> int:
    """Bytes of the frame's chunks; 0 if one is missing, for which the library would return zeros without an error."""
    if stack.chunks is None:
        return 1
    (frames, rows, columns), (_, height, width) = stack.chunks, stack.shape
    corners = ((index - index % frames, y, x) for y in range(0, height, rows) for x in range(0, width, columns))
    found = [stack.id.get_chunk_info_by_coord(corner) for corner in corners]
    return 0 if any(info.byte_offset is None for info in found) else sum(int(info.size) for info in found)
