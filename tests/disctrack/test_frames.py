"""Rotations: three routes to each, laws that hold for any rotation, and the neighbourhood of theta = 0."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from disctrack import frames

ROUND_OFF = 1e-13


@pytest.fixture
def euler(rng):
    return rng.uniform([-7, 1e-3, -7], [7, np.pi - 1e-3, 7], (500, 3))


def test_euler_angles_agree_with_scipys_zxz_sequence(euler):
    expected = Rotation.from_euler("ZXZ", euler).as_matrix()
    assert_allclose(frames.rotation_from_euler(*euler.T), expected, atol=ROUND_OFF)


def test_euler_angles_return_from_the_rotation_up_to_full_turns(euler):
    back = frames.euler_from_rotation(frames.rotation_from_euler(*euler.T))
    # arctan2 of sines near 1e-3 loses three digits
    assert_allclose(np.exp(1j * back), np.exp(1j * euler), atol=1e-12)


def test_flat_disc_gives_the_whole_turn_to_phi():
    R = frames.rotation_z(0.7)
    assert_allclose(frames.euler_from_rotation(R), [0, 0, 0.7], atol=ROUND_OFF)


def test_quaternions_and_rotation_vectors_agree_with_scipy():
    reference = Rotation.random(500, random_state=3)
    R = reference.as_matrix()
    assert_allclose(frames.rotation_from_quaternion(np.roll(reference.as_quat(), 1, axis=1)), R, atol=ROUND_OFF)
    assert_allclose(frames.rotation_from_quaternion(frames.quaternion_from_rotation(R)), R, atol=ROUND_OFF)
    assert_allclose(frames.rotation_from_vector(reference.as_rotvec()), R, atol=ROUND_OFF)
    assert_allclose(frames.rotation_from_vector(frames.vector_from_rotation(R)), R, atol=ROUND_OFF)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-9, 1e-6, 1e-4, 1e-2, 3.1])
def test_rotation_vectors_survive_the_round_trip_at_every_size(size, rng):
    axis = rng.normal(size=(50, 3))
    v = size * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    assert_allclose(frames.vector_from_rotation(frames.rotation_from_vector(v)), v, atol=1e-13, rtol=1e-9)


def test_nodal_axes_are_those_of_the_paper(euler):
    e1, e2, e3 = frames.nodal_axes_world(euler[:, 0], euler[:, 1])
    R = frames.rotation_from_euler(euler[:, 0], euler[:, 1], np.zeros(len(euler)))
    assert_allclose(np.stack([e1, e2, e3], axis=-1), R, atol=ROUND_OFF)
    assert_allclose(e1[:, 2], 0, atol=0)  # e1 is horizontal


def test_euler_jacobian_agrees_with_differences_of_turned_bodies(euler, rng):
    step = 1e-6
    for axis in range(3):
        v = np.zeros(3)
        v[axis] = step
        R = frames.rotation_from_euler(*euler.T)
        ahead = frames.euler_from_rotation(frames.rotation_from_vector(v) @ R)
        behind = frames.euler_from_rotation(frames.rotation_from_vector(-v) @ R)
        difference = np.angle(np.exp(1j * (ahead - behind))) / (2 * step)
        exact = frames.euler_jacobian(euler[:, 0], euler[:, 1])[..., axis]
        # truncation grows with the cube of 1 / sin theta
        bound = 1e-9 + step**2 / np.sin(euler[:, 1]) ** 3
        assert np.all(np.abs(difference - exact) < 20 * bound[:, None])


def test_euler_jacobian_is_the_inverse_of_the_rate_axes(euler):
    product = frames.euler_jacobian(euler[:, 0], euler[:, 1]) @ frames.euler_rate_axes_world(euler[:, 0], euler[:, 1])
    assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-9)


def test_euler_jacobian_has_no_answer_for_a_flat_disc():
    assert np.isnan(frames.euler_jacobian(0.3, 0.0)).all()


def test_unwrapped_angles_follow_many_turns_and_a_gap():
    time = np.linspace(0, 1, 1001)
    psi, phi = 200 * time, 0.4 - 199 * time
    R = frames.rotation_from_euler(psi, np.full_like(time, 0.01), phi)
    wrapped = frames.euler_from_rotation(R)
    wrapped[400:405] = np.nan
    unwrapped = frames.unwrap_euler(wrapped)
    good = np.isfinite(unwrapped[:, 0])
    assert good.sum() == 996
    assert_allclose(unwrapped[good, 0] - psi[good], unwrapped[0, 0] - psi[0], atol=1e-9)
    assert_allclose((unwrapped[:, 0] + unwrapped[:, 2])[good] - (psi + phi)[good], 0, atol=1e-9)


def test_quaternion_signs_are_continuous():
    q = frames.quaternion_from_rotation(frames.rotation_z(np.linspace(0, 20, 400)))
    flips = np.flatnonzero(np.sum(q[1:] * q[:-1], axis=1) < 0)
    assert len(flips) > 1
    q[flips[0] + 1] = np.nan  # the sign changes across a frame without an answer
    q[0] *= -1
    q = frames.continuous_quaternions(q)
    good = np.isfinite(q[:, 0])
    assert good.sum() == 399
    assert np.all(np.sum(q[good][1:] * q[good][:-1], axis=1) > 0.9)
    assert q[0, 0] > 0
