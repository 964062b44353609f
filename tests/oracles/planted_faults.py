"""Faults of a recording, planted into its images: what cameras, recorders, hands and lamps do to a measurement.

Each takes images (n, 2, height, width) uint8, which it changes, where the disc is seen (n, 2, 2) [px] (x, y), and a
generator. It returns the numbers of the frames that are kept; None: all of them.
"""

import cv2
import numpy as np


def repeat(images, places, rng):
    """A camera, or both, deliver an earlier image once more."""
    i, back = int(rng.integers(6, len(images))), int(rng.integers(1, 4))
    cameras = [[0], [1], [0, 1]][rng.integers(3)]
    images[i, cameras] = images[i - back, cameras]


def drop(images, places, rng):
    """A camera leaves out a frame: from there on it is one frame ahead of the other."""
    i, camera = int(rng.integers(2, len(images) - 2)), int(rng.integers(2))
    images[i:-1, camera] = images[i + 1 :, camera].copy()
    return np.arange(len(images) - 1)


def lose(images, places, rng):
    """Both cameras lose frames, and nobody tells: time shifts."""
    i, gone = int(rng.integers(8, len(images) - 12)), int(rng.integers(1, 5))
    return np.r_[0:i, i + gone : len(images)]


def reorder(images, places, rng):
    """Two frames change places, in one camera or in both."""
    i, apart = int(rng.integers(4, len(images) - 8)), int(rng.integers(1, 4))
    cameras = [[0], [1], [0, 1]][rng.integers(3)]
    images[np.ix_([i, i + apart], cameras)] = images[np.ix_([i + apart, i], cameras)]


def swap(images, places, rng):
    """Left and right are exchanged for some frames."""
    i, length = int(rng.integers(4, len(images) - 8)), int(rng.integers(1, 6))
    images[i : i + length] = images[i : i + length, ::-1].copy()


def mirror(images, places, rng):
    """A camera's images come mirrored for some frames."""
    i, length, camera = int(rng.integers(4, len(images) - 8)), int(rng.integers(1, 6)), int(rng.integers(2))
    images[i : i + length, camera] = images[i : i + length, camera, :, ::-1].copy()


def rescale(images, places, rng):
    """An export program scales some images about their centre by up to a per cent."""
    i, length, camera = int(rng.integers(4, len(images) - 8)), int(rng.integers(1, 6)), int(rng.integers(2))
    scale = 1.0 + float(rng.choice([-1, 1])) * 10 ** rng.uniform(-3.5, -2)
    height, width = images.shape[-2:]
    matrix = cv2.getRotationMatrix2D((0.5 * (width - 1), 0.5 * (height - 1)), 0.0, scale)
    for k in range(i, i + length):
        images[k, camera] = cv2.warpAffine(
            images[k, camera], matrix, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        )


def truncate(images, places, rng):
    """The lower part of an image never reached the disk."""
    i, camera = int(rng.integers(4, len(images))), int(rng.integers(2))
    images[i, camera, int(places[i, camera, 1] + rng.uniform(-40, 40)) :] = int(rng.choice([0, 128, 255]))


def glare(images, places, rng):
    """A lamp's reflection over part of an image, for some frames."""
    _over(images, places, rng, _glare)


def shadow(images, places, rng):
    """A shadow with its penumbra."""
    _over(images, places, rng, _shadow)


def smear(images, places, rng):
    """A finger's mark, or dirt on the disc: some dark spots."""
    _over(images, places, rng, _spots)


def hide(images, places, rng):
    """A hand before part of the disc, or all of it, in both cameras."""
    height, width = images.shape[-2:]
    y, x = np.mgrid[:height, :width]
    i, length, angle = int(rng.integers(4, len(images) - 10)), int(rng.integers(1, 9)), rng.uniform(0, 2 * np.pi)
    texture = cv2.GaussianBlur(rng.normal(0, 1, (height, width)).astype(np.float32), (0, 0), 4)
    texture = rng.uniform(60, 160) + 20 * texture / texture.std()
    offset = rng.uniform(-80, 60)
    for k in range(i, i + length):
        for camera in (0, 1):
            u = (x - places[k, camera, 0]) * np.cos(angle) + (y - places[k, camera, 1]) * np.sin(angle) - offset
            hidden = np.clip(0.5 + u / 2.0, 0, 1)
            grey = images[k, camera] * (1 - hidden) + (texture + rng.normal(0, 1.5, u.shape)) * hidden
            images[k, camera] = np.clip(np.rint(grey), 0, 255)


def dim(images, places, rng):
    """Little light: some 40 grey values between ink and paper."""
    images[:] = np.rint(110 + 0.24 * (images - 110.0))


def blur(images, places, rng):
    """A lens out of focus by a pixel and a half."""
    for image in images.reshape(-1, *images.shape[2:]):
        image[:] = cv2.GaussianBlur(image, (0, 0), 1.5)


def flicker(images, places, rng):
    """A lamp at 100 Hz, of 1000 pairs a second."""
    light = 0.8 + 0.2 * np.sin(2 * np.pi * 0.1 * np.arange(len(images)) + rng.uniform(0, 6))
    images[:] = np.rint(images * light[:, None, None, None])


def stick(images, places, rng):
    """Pixels of both sensors show full scale, as many nothing."""
    for camera in (0, 1):
        pixels = images[:, camera].reshape(len(images), -1)
        where = rng.permutation(pixels.shape[1])[:500]
        pixels[:, where[::2]], pixels[:, where[1::2]] = 255, 0
        images[:, camera] = pixels.reshape(images[:, camera].shape)


FAULTS = (repeat, drop, lose, reorder, swap, mirror, rescale, truncate, glare, shadow, smear, hide, dim, blur, flicker)
FAULTS += (stick,)


def _over(images, places, rng, change):
    height, width = images.shape[-2:]
    y, x = np.mgrid[:height, :width].astype(float)
    i, length, camera = int(rng.integers(4, len(images) - 8)), int(rng.integers(1, 8)), int(rng.integers(2))
    where = rng.normal(0, 35, 2)
    paint = change(rng)
    for k in range(i, i + length):
        u, v = x - places[k, camera, 0] - where[0], y - places[k, camera, 1] - where[1]
        images[k, camera] = np.clip(np.rint(paint(images[k, camera].astype(float), u, v)), 0, 255)


def _glare(rng):
    width, height = rng.uniform(4, 60), rng.uniform(3, 150)
    return lambda grey, u, v: grey + height * np.exp(-0.5 * (u * u + v * v) / width**2)


def _shadow(rng):
    angle, width, depth = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 30), rng.uniform(0.03, 0.5)
    edge = lambda u, v: 1 / (1 + np.exp(-(u * np.cos(angle) + v * np.sin(angle)) / width))  # noqa: E731
    return lambda grey, u, v: grey * (1 - depth + depth * edge(u, v))


def _spots(rng):
    spots = [(*rng.normal(0, 25, 2), rng.uniform(0.5, 4), rng.uniform(0.1, 0.9)) for _ in range(rng.integers(1, 8))]

    def paint(grey, u, v):
        for a, b, size, depth in spots:
            grey = grey * (1 - depth * np.exp(-0.5 * ((u - a) ** 2 + (v - b) ** 2) / size**2))
        return grey

    return paint
