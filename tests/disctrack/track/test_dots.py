"""The circle template against rendered truth (which shares no code with it), against noise, and against bad dots."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter

from calibration.cameras.camera import normalised_maps
from disctrack import MarkerStatus, frames
from disctrack.synthetic.cameras import rig_of
from disctrack.synthetic.description import Scene
from disctrack.track.dots.template import NoiseModel, residual_noise, rough_noise
from tests.disctrack.conftest import RenderedPairs, disc_on_table
from tests.oracles.flat_dots import locate_on_disc, locate_on_plane
from tests.rendering import expected_disc, render_disc

SENSOR_NOISE = NoiseModel(0.64 + 1 / 12, 0.02)  # of the default scene: read noise, rounding, 50 electrons per grey


def poses_in_camera(pairs, index, camera, turned=0.0, moved=0.0, rng=None):
    R_cw, t_cw = pairs.rig.camera_poses()[camera]
    R, t = pairs.R[index], pairs.q[index, :3]
    if rng is not None:
        R, t = frames.rotation_from_vector(rng.normal(scale=turned, size=3)) @ R, t + rng.normal(scale=moved, size=3)
    return R_cw @ R, R_cw @ t + t_cw


def locate_all(pairs, images, noise, rng=None, turned=0.0, moved=0.0, disc=None, **known):
    maps = [normalised_maps(camera) for camera in pairs.rig.cameras]
    found = []
    for index, camera in np.ndindex(len(images), 2):
        R, t = poses_in_camera(pairs, index, camera, turned, moved, rng)
        image, view = images[index, camera], pairs.rig.cameras[camera]
        found.append(locate_on_disc(image, view, R, t, disc or pairs.disc, maps=maps[camera], noise=noise, **known))
    centres = np.stack([dots.pixels for dots in found]).reshape(len(images), 2, -1, 2)
    covariance = np.stack([dots.covariance_px2 for dots in found]).reshape(*centres.shape, 2)
    return centres, covariance, found


def some(pairs, index):
    """Those pairs of the recording."""
    return replace(pairs, images=pairs.images[index], q=pairs.q[index], R=pairs.R[index])


def test_centres_have_no_bias_where_there_is_no_noise(rendered_pairs):
    pairs = some(rendered_pairs, slice(0, 24, 3))
    images = (256 * expected_disc(pairs.q, pairs.rig, pairs.disc, pairs.scene)).astype(np.uint16)
    centres, _, _ = locate_all(pairs, images, NoiseModel(0.64 * 256**2, 0.02 * 256))
    error = centres - pairs.true_pixels
    # the renderer's own edges have converged to 1e-3 px; the ellipse's centre would be off by 0.02-0.13 px
    assert np.nanmax(np.abs(error)) < 1.5e-3
    assert np.abs(np.nanmean(error, axis=(0, 1, 2))).max() < 5e-4


def test_the_centre_of_the_ellipse_would_have_been_biased(rendered_pairs):
    """Negative control: the bias that the template avoids is twenty times what the test above allows."""
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    ring = 0.5 * rendered_pairs.disc.marker_diameter * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    offsets = []
    for R, q, true in zip(rendered_pairs.R, rendered_pairs.q, rendered_pairs.true_pixels, strict=True):
        for dot, centre in enumerate(rendered_pairs.disc.marker_centres_body):
            outline = rendered_pairs.rig.project((centre + ring) @ R.T + q[:3])
            found = cv2.moments(outline[0].astype(np.float32))
            centroid = np.array([found["m10"], found["m01"]]) / found["m00"]
            offsets.append(np.linalg.norm(centroid - true[0, dot]))
    assert 0.01 < np.median(offsets) < 0.13


@pytest.mark.parametrize(
    ("mm_per_px", "blur_px", "thinnest"),
    [(0.8, 0.6, 1.0), (1.1, 0.3, 1.0), (0.4, 2.5, 2.5)],
    ids=["dots of 9 px", "dots of 6 px", "2.5 px of blur"],
)
def test_dots_that_are_all_edge_have_no_bias(mm_per_px, blur_px, thinnest):
    """Half axes down to that of the blur (with the pixel): the whole blurred ellipse is the template."""
    size = int(110 / mm_per_px)
    cameras, soft = {"image_size": (size, size), "exposure_s": 0.0}, {"blur_px": (blur_px, blur_px)}
    scene = Scene().changed(cameras=cameras, rig={"mm_per_px": mm_per_px}, optics=soft)
    disc, rig = scene.declared_disc, rig_of(scene)
    q = disc_on_table(np.radians([3.0, 20.0, 30.0, 40.0]), np.random.default_rng(4), disc)
    q[:, :2] = [0.032, 0.02]
    R = frames.rotation_from_euler(*q[:, 3:].T)
    pairs = RenderedPairs(expected_disc(q, rig, disc, scene), q, R, rig, disc, scene)
    sensor = NoiseModel(0.64 * 256**2, 0.02 * 256)
    centres, covariance, found = locate_all(pairs, (256 * pairs.images).astype(np.uint16), sensor, blur_px=blur_px)
    status = np.stack([dots.status for dots in found]).reshape(len(q), 2, -1)
    half_axes = _shortest_half_axes(pairs)
    assert np.all(status[half_axes > 1.3 * thinnest] == MarkerStatus.MEASURED)
    assert np.any(half_axes < 2 * thinnest)
    assert np.all((status == MarkerStatus.MEASURED) | (status == MarkerStatus.BLURRED))
    seen = status == MarkerStatus.MEASURED
    error, sigma = (centres - pairs.true_pixels)[seen], np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))[seen]
    assert np.sqrt(np.mean(error**2)) < 4e-3  # largest where the half axis is the blur itself; sigma is 0.01 to 0.02
    assert np.sqrt(np.mean((error / sigma) ** 2)) < 0.5  # a sharp image of 6 px shows the pixels as squares


def _shortest_half_axes(pairs):
    """(n, 2, m) [px] of the dots' images, by the homography of their neighbourhood."""
    centres = pairs.disc.marker_centres_body @ np.swapaxes(pairs.R, 1, 2) + pairs.q[:, None, :3]
    by_point = pairs.rig.project_with_jacobians(centres)[1]
    axes = 0.5 * pairs.disc.marker_diameter * by_point @ pairs.R[:, None, None, :, :2]
    return np.linalg.svd(axes, compute_uv=False)[..., 1]


def test_scatter_equals_the_predicted_covariance(rendered_pairs, rng):
    centres, covariance, _ = locate_all(rendered_pairs, rendered_pairs.images, SENSOR_NOISE, rng, 5e-4, 5e-5)
    error = centres - rendered_pairs.true_pixels
    seen = np.isfinite(error).all(-1)
    assert seen.mean() > 0.9  # the steepest poses turn their face away from a camera
    squared = np.einsum("...i,...ij,...j->...", error[seen], np.linalg.inv(covariance[seen]), error[seen])
    # 2 x 280 degrees of freedom: the mean of chi-square / 2 scatters by 0.06; the covariance is enlarged by the
    # misfit of each dot where that exceeds 1, on average by 3 %
    assert 0.8 < squared.mean() / 2 < 1.2
    assert np.abs(error[seen].mean(axis=0)).max() < 4 * 0.004 / np.sqrt(seen.sum())
    assert np.sqrt(np.median(covariance[seen][:, 0, 0])) < 0.006  # [px]


def test_a_dot_of_another_size_moves_no_centre(rendered_pairs, rng):
    """Printed 3 % too large, or bloomed: the radius is free and does not couple with the centre."""
    pairs = some(rendered_pairs, [10, 16])
    declared, _, _ = locate_all(pairs, pairs.images, SENSOR_NOISE)
    wrong_size = replace(pairs.disc, marker_diameter=1.03 * pairs.disc.marker_diameter)
    found, _, dots = locate_all(pairs, pairs.images, SENSOR_NOISE, disc=wrong_size)
    # a third of a sigma: the band of pixels starts 0.4 px farther out, so other noise enters
    assert np.sqrt(np.nanmean((found - declared) ** 2)) < 1.3e-3
    radii = np.concatenate([d.dots["radius"] for d in dots])
    # a radius is an edge found all round: 0.004 px of 14 px, plus the renderer's exactness
    assert_allclose(np.nanmean(radii), 0.5 * pairs.disc.marker_diameter, rtol=3e-4)


@pytest.mark.parametrize("grey_scale", [1, 16])
def test_light_dots_on_dark_are_found_as_well_as_dark_on_light(rendered_pairs, grey_scale):
    pairs = some(rendered_pairs, [12])
    image = pairs.images.astype(np.uint16) * grey_scale
    negative = (220 * grey_scale - image).astype(np.uint16)
    noise = NoiseModel(2.0 * grey_scale**2, 0.0)
    for picture in (image, negative):
        centres, covariance, dots = locate_all(pairs, picture, noise)
        assert np.isfinite(centres).all()
        sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
        assert sigma.max() < 0.008
        assert np.abs((centres - pairs.true_pixels) / sigma).max() < 4  # 24 numbers: 4 sigma once in 600 runs
    assert all((d.dots["contrast"][np.isfinite(d.dots["contrast"])] < 0).all() for d in dots)


def test_uneven_light_and_hot_pixels_move_no_centre(rendered_pairs, rng):
    pairs = some(rendered_pairs, [8])
    clean, _, _ = locate_all(pairs, pairs.images, SENSOR_NOISE)
    y, x = np.mgrid[:512, :512]
    shade = 1.0 - 0.4 * x / 512 - 0.2 * y / 512  # 40 % darker at the right: 1.5 % across a dot
    dim = np.round(pairs.images * shade).astype(np.uint8)
    shaded, covariance, _ = locate_all(pairs, dim, SENSOR_NOISE)
    sigma = np.sqrt(covariance[..., 0, 0])
    assert np.nanmax(np.abs(shaded - clean) / sigma[..., None]) < 3
    hot = pairs.images.copy()
    for camera in (0, 1):  # one hot pixel on the edge of every dot
        for centre in pairs.true_pixels[0, camera]:
            u, v = np.round(centre).astype(int)
            hot[0, camera, v, u + 9] = 255
            hot[0, camera, v + 2, u] = 255
    struck, _, _ = locate_all(pairs, hot, SENSOR_NOISE)
    assert np.nanmax(np.abs(struck - clean)) < 0.02


def test_a_half_hidden_dot_is_refused(rendered_pairs):
    pairs = some(rendered_pairs, [9])
    image = pairs.images.copy()
    u, v = np.round(pairs.true_pixels[0, 0, 2]).astype(int)
    image[0, 0, v - 30 : v + 30, u + 3 : u + 30] = 118  # a grey rod across the dot
    _, _, found = locate_all(pairs, image, SENSOR_NOISE)
    assert found[0].status[2] in (MarkerStatus.OCCLUDED, MarkerStatus.NOT_CONVERGED, MarkerStatus.LOW_CONTRAST)
    assert (np.delete(found[0].status, 2) == MarkerStatus.MEASURED).all()
    assert np.isnan(found[0].pixels[2]).all()


def test_a_missing_dot_and_a_dot_at_the_border_are_refused(rendered_pairs, rng):
    pairs = some(rendered_pairs, [5])
    visible = np.ones((1, 2, 6), bool)
    visible[0, :, 4] = False
    image = render_disc(pairs.q, pairs.rig, pairs.disc, pairs.scene, rng, visible=visible)
    _, _, found = locate_all(pairs, image, SENSOR_NOISE)
    assert found[0].status[4] == MarkerStatus.LOW_CONTRAST
    u = int(pairs.true_pixels[0, 0, 0, 0])
    shifted = np.zeros_like(image)
    shifted[..., : 512 - u + 4] = image[..., u - 4 :]  # the first dot now leaves the image on the left
    camera = replace(pairs.rig.left, cx=pairs.rig.left.cx - (u - 4))
    R, t = poses_in_camera(pairs, 0, 0)
    moved = locate_on_disc(shifted[0, 0], camera, R, t, pairs.disc, noise=SENSOR_NOISE)
    assert moved.status[0] == MarkerStatus.OUTSIDE


def test_the_other_face_shows_no_dots(rendered_pairs):
    R, t = poses_in_camera(rendered_pairs, 0, 0)
    turned = R @ np.diag([1.0, -1.0, -1.0])
    found = locate_on_disc(rendered_pairs.images[0, 0], rendered_pairs.rig.left, turned, t, rendered_pairs.disc)
    assert (found.status == MarkerStatus.OCCLUDED).all()


def test_what_dots_leave_is_the_sensors_law(rendered_pairs):
    pairs, law = some(rendered_pairs, slice(0, 24, 2)), rough_noise(rendered_pairs.images[0, 0])
    for _ in range(2):
        dots = np.concatenate([each.dots for each in locate_all(pairs, pairs.images, law)[2]])
        law = residual_noise(law, dots[np.isfinite(dots["u"])])
    # the median of some hundred dots of 700 pixels, half of which lie in the edge
    assert_allclose(law.variance(np.array([25.0, 185.0])), SENSOR_NOISE.variance(np.array([25.0, 185.0])), rtol=0.1)


def test_a_dot_wider_than_the_rows_kept_for_it_loses_no_pixel():
    v, u = np.mgrid[:300, :300].astype(float)
    centre, radius, blur = np.array([148.3, 151.6]), 90.0, 12.0
    ink = np.clip(0.5 + radius - np.hypot(u - centre[0], v - centre[1]), 0, 1)
    image = np.round(256 * 200 * (1 - 0.8 * gaussian_filter(ink, blur))).astype(np.uint16)
    start = np.array([148.0, 152.0])
    homography = np.eye(3)
    homography[:2, 2] = start
    found = locate_on_plane(image, homography, np.zeros((1, 2)), radius, noise=NoiseModel(1e4, 0), blur_px=blur)
    assert found.status[0] == MarkerStatus.MEASURED
    # the band of pixels reaches from 3 blurs and 2 px inside the edge to 3 and 1 px outside
    outer, inner = radius + 3 * blur + 1, radius - 3 * blur - 2
    assert_allclose(found.dots["n_pixels"][0], np.pi * (outer**2 - inner**2), rtol=0.01)
    # a curved edge's blur is modelled to first order in blur over radius: an error of their ratio squared
    # of the 0.3 px by which the band of pixels is not centred
    assert_allclose(found.pixels[0], centre, atol=0.3 * (blur / radius) ** 2)
