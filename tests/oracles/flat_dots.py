"""Dots of a single image located by their template: on a disc, and on a plane that is seen by a homography."""

from types import SimpleNamespace

import numpy as np
from scipy.ndimage import gaussian_filter

from calibration.cameras.camera import Camera, normalised_maps
from calibration.kit.compiled import RULES, njit
from disctrack.track.dots import _kernels as kernels
from disctrack.track.dots.template import dot_centres, face_of, rough_noise


@njit(cache=True, **RULES)
def look(images, views, face, expected, R, t, results, status):
    """Compiled as what it calls."""
    pixels, work = np.empty((16, 4096), np.float32), (np.empty((8, 8)), np.empty(8), np.empty(8))
    (maps, cameras), (sigma, noise, limits), seen = views, expected, np.ones(len(images), np.bool_)
    kernels._look(images, seen, maps, cameras, face, sigma, noise, limits, R, t, pixels, work, results, status)


def locate_on_disc(image, camera, R, t, disc, *, maps=None, noise=None, blur_px=0.8):
    """The disc's dots in an image (height, width); R (3, 3), t (3,), body -> camera, is its pose within a few px."""
    map_x, map_y = maps if maps is not None else normalised_maps(camera)
    parameters = np.array(noise or rough_noise(image))
    results, status = np.full((1, disc.n_markers), np.nan, kernels.DOT), np.zeros((1, disc.n_markers), np.uint8)
    views = (map_x[None], map_y[None]), (camera.parameters[None], np.eye(3)[None], np.zeros((1, 3)))
    expected = np.array([blur_px]), parameters[None], kernels.Limits()
    pose = np.ascontiguousarray(R, float), np.ascontiguousarray(t, float)
    image = np.ascontiguousarray(image)[None]
    look(image, views, face_of(disc), expected, *pose, results, status)
    dots, pixels, covariance = dot_centres(results[0], status[0])
    return SimpleNamespace(pixels=pixels, covariance_px2=covariance, status=status[0], dots=dots)


def locate_on_plane(image, image_from_plane, centres, radius, **known):
    """As `locate_on_disc`: image_from_plane (3, 3), plane -> pixel; centres (m, 2) and radius in plane units.

    A camera whose rays are the pixels themselves sees the plane at R e1, R e2, t: the columns of the homography.
    """
    height, width = image.shape
    camera = Camera(1.0, 1.0, 0.0, 0.0, (0.0,) * 5, (width, height))
    places = np.column_stack([np.atleast_2d(centres), np.zeros(len(centres))])
    # no disc, whose lengths are metres: dots on a face without an end
    dots = SimpleNamespace(n_markers=len(places), marker_centres_body=places, marker_diameter=2 * radius, radius=np.inf)
    R = np.column_stack([image_from_plane[:, :2], [0.0, 0.0, -1.0]])
    return locate_on_disc(image, camera, R, image_from_plane[:, 2], dots, **known)


def covered(centres, affine, blur_px, weights=(1.0,)):
    """(64, 64) share of each pixel that a dot covers, rays 1/6 px apart, blurred: the weighted mean over its outlines.

    centres (k, 2) [px], affine (k, 2, 2) unit circle -> px
    """
    fine, total = 6, 0.0
    axis = (np.arange(64 * fine) + 0.5) / fine - 0.5
    pixels = np.stack(np.meshgrid(axis, axis), axis=-1)
    for weight, centre, A in zip(weights, centres, affine, strict=True):
        u = (pixels - centre) @ np.linalg.inv(A).T
        distance = (1 - np.hypot(*np.moveaxis(u, -1, 0))) * np.sqrt(abs(np.linalg.det(A))) * fine
        total = total + weight * np.clip(distance + 0.5, 0, 1)
    return gaussian_filter(total, blur_px * fine).reshape(64, fine, 64, fine).mean((1, 3))


def locate_in_window(image, centre, affine, **known):
    """A dot, unit circle -> px by affine (2, 2), in an image (64, 64) whose first pixel is round(centre) - 31."""
    homography = np.eye(3)
    homography[:2, :2], homography[:2, 2] = affine, centre - np.round(centre) + 31
    return locate_on_plane(np.rint(image).astype(np.uint16), homography, np.zeros((1, 2)), 1.0, **known)
