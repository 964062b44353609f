"""Dark and flat images: the sensor's pattern, laid over images by another code, is removed to the noise."""

import cv2
import numpy as np
import pytest

from disctrack import find_views, open_frames, open_pairs, read_recording
from disctrack.errors import RecordingError
from disctrack.recording.readers.flat_field import flat_fields
from tests.disctrack.recording.readers.written import write_sequence
from tests.disctrack.recording.test_recording import REFERENCE

SIZE, FRAMES, FLATS = 64, 64, 40
DEAD = (20, 33)
ALL = "\n".join(f'{side}_{kind} = "{kind}/{side}"' for side in ("left", "right") for kind in ("flat", "dark"))


def scene():
    """Grey values of a smooth scene between ink and paper."""
    y, x = np.mgrid[:SIZE, :SIZE]
    return 110 + 70 * np.sin(0.11 * x) * np.cos(0.07 * y)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A recording whose left sensor has gains of 3 %, columns of one grey value, and a dead pixel."""
    folder, rng = tmp_path_factory.mktemp("flat"), np.random.default_rng(5)
    gain, offset = 1 + 0.03 * rng.normal(size=(SIZE, SIZE)), 6.0 + rng.normal(size=SIZE)  # with a black level
    gain[DEAD] = 0.02

    def expose(radiance):
        grey = radiance * gain + offset
        grey = grey + rng.normal(size=grey.shape) * np.sqrt(0.64 + np.maximum(grey, 0) / 50)
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)

    level = np.ones((SIZE, SIZE))
    for side in ("left", "right"):
        for kind, radiance, n in (("flat", 140 * level, FLATS), ("dark", 0 * level, FLATS), ("", scene(), FRAMES)):
            write_sequence(folder / kind / side, [expose(radiance) for _ in range(n)])
    for side in ("left", "right"):
        views = expose(scene()), np.zeros((SIZE // 2, SIZE, 3), np.uint8)
        write_sequence(folder / "views", views, names=[f"{side}0", f"{side}1"])
    return folder


def declared(folder, flats):
    (folder / "recording.toml").write_text(REFERENCE.replace("[cameras]\n", f"[cameras]\n{flats}\n"))
    return read_recording(folder)


def departure(reader):
    """Of the mean of all frames from the scene, up to one factor and one level, without the dead pixel [grey]."""
    mean = np.mean([reader.read(i) / (257.0 if reader.bit_depth == 16 else 1.0) for i in range(FRAMES)], axis=0)
    good = np.ones(mean.shape, bool)
    good[DEAD] = False
    terms = np.column_stack([np.ones(good.sum()), scene()[good]])
    left = np.full(mean.shape, np.nan)
    left[good] = mean[good] - terms @ np.linalg.lstsq(terms, mean[good], rcond=None)[0]
    return left, mean


def test_the_pattern_is_removed_to_the_noise_and_a_dead_pixel_is_filled(folder):
    plain, corrected = (open_pairs(declared(folder, flats)).left for flats in ("", ALL))
    before, after = (departure(reader)[0] for reader in (plain, corrected))
    # sigma of a pixel is 1.8 grey values; the mean of 64, and a gain from 40 flats and 40 darks at 0.8 of their light
    noise = np.sqrt(0.64 + scene() / 50)
    floor = np.sqrt(
        np.mean(noise**2) / FRAMES + np.mean((scene() / 140) ** 2) * (0.64 + 140 / 50) / FLATS + 0.64 / FLATS
    )
    assert np.sqrt(np.nanmean(before**2)) > 8 * floor
    assert np.sqrt(np.nanmean(after**2)) < 1.15 * floor
    assert abs(departure(plain)[1][DEAD] - scene()[DEAD]) > 50
    assert abs(departure(corrected)[1][DEAD] - scene()[DEAD]) < 5
    assert any("1 dead pixel" in note for note in corrected.notes)


def test_results_depend_on_the_flats_and_views_of_the_same_size_are_corrected(folder):
    plain, corrected = (declared(folder, flats) for flats in ("", ALL))
    assert open_pairs(plain).inputs() != open_pairs(corrected).inputs()
    fields = (None, None), flat_fields(folder, corrected.sensors)
    views = [find_views("views/left*.png", "views/right*.png", folder, of_both) for of_both in fields]
    assert views[0].sha256() != views[1].sha256()
    one, other = (v.fields[0] for v in views)
    assert one is None
    image = cv2.imread(str(views[0].left[0]), cv2.IMREAD_UNCHANGED)
    assert other.fits(image)
    assert not other.fits(np.zeros((SIZE // 2, SIZE, 3), np.uint8))
    assert flat_fields(folder, plain.sensors) == (None, None)
    raw = open_frames("left/*.png", folder, "left")
    assert type(open_pairs(plain).left) is type(raw)  # nothing stands between where nothing is declared


def test_clipped_pixels_stay_clipped(folder):
    field = flat_fields(folder, declared(folder, ALL).sensors)[0]
    image = np.full((SIZE, SIZE), 255, np.uint8)
    assert np.all(field.corrected(image) == 65535)
    dark = field.corrected(np.zeros((SIZE, SIZE), np.uint8))
    assert dark.max() == 0


@pytest.mark.parametrize(
    ("flat", "dark", "said"),
    [
        (None, None, "no image matched for the left camera's flat"),
        (np.full((SIZE, SIZE), 255, np.uint8), None, "saturated"),
        (np.full((SIZE, SIZE), 20, np.uint8), np.full((SIZE, SIZE), 130, np.uint8), "exchanged"),
        (np.full((SIZE, SIZE), 12, np.uint8), None, "too dark"),
        (np.full((SIZE, SIZE + 8), 120, np.uint8), None, "left frames are 64 x 64 px of 8 bit"),
        (np.full((SIZE, SIZE), 30000, np.uint16), None, "of 16 bit"),
        (np.full((SIZE, SIZE), 120, np.uint8), np.full((SIZE, SIZE + 8), 5, np.uint8), "Take both"),
    ],
)
def test_flats_that_cannot_serve_stop_the_run_with_what_to_do(folder, tmp_path, flat, dark, said):
    lines = [f'left_flat = "{tmp_path}/f"']
    if flat is not None:
        write_sequence(tmp_path / "f", [flat])
    if dark is not None:
        write_sequence(tmp_path / "d", [dark])
        lines.append(f'left_dark = "{tmp_path}/d"')
    with pytest.raises(RecordingError, match=said):
        open_pairs(declared(folder, "\n".join(lines)))


def test_one_noisy_flat_is_used_and_said(folder):
    reader = open_pairs(declared(folder, 'left_flat = "flat/left/000000.png"')).left
    assert any("mean of 1 image" in note for note in reader.notes)
