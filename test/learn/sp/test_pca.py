# SPDX-License-Identifier: Apache-2.0
"""Principal spaces of meshes that were made with known components."""

import numpy as np

from flowing_puppet_ros.learn.sp.pca import MIRROR, fit_mirrored_space, fit_space


def _made(rng: np.random.Generator, n: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    mean, basis = rng.normal(size=(12, 3)), rng.normal(size=(12, 3, 2)) * [0.5, 0.1]
    return mean, basis, mean + np.einsum("kxp,np->nkx", basis, rng.normal(size=(n, 2)))


def test_low_rank_meshes_are_recovered_with_unit_variance() -> None:
    rng = np.random.default_rng(0)
    _, _, meshes = _made(rng)
    space = fit_space(meshes, rng.uniform(0.5, 2, size=12), 2)
    coefficients = space.project(meshes)
    rebuilt = space.mean + np.einsum("kxp,np->nkx", space.basis, coefficients)
    np.testing.assert_allclose(rebuilt, meshes, atol=1e-9)
    np.testing.assert_allclose(np.cov(coefficients.T), np.eye(2), atol=1e-9)
    assert space.share > 1 - 1e-9


def test_few_long_meshes_give_the_same_space_as_the_covariance() -> None:
    rng = np.random.default_rng(1)
    _, _, meshes = _made(rng, 20)
    meshes = meshes + 0.05 * rng.normal(size=meshes.shape)
    few = fit_space(meshes, np.ones(12), 2)
    centred = (meshes - meshes.mean(axis=0)).reshape(20, -1)
    _, singular, _ = np.linalg.svd(centred, full_matrices=False)
    np.testing.assert_allclose((few.basis**2).sum(axis=(0, 1)), singular[:2] ** 2 / 19)
    np.testing.assert_allclose(few.share, (singular[:2] ** 2).sum() / (singular**2).sum())


def test_weights_decide_what_is_kept() -> None:
    rng = np.random.default_rng(2)
    meshes = np.zeros((200, 2, 3))
    meshes[:, 0, 0], meshes[:, 1, 1] = rng.normal(size=200), rng.normal(size=200)
    for heavy, axis in ((0, 0), (1, 1)):
        weight = np.where(np.arange(2) == heavy, 10.0, 1.0)
        basis = fit_space(meshes, weight, 1).basis[..., 0]
        assert abs(basis[heavy, axis]) > 10 * abs(basis[1 - heavy, 1 - axis])


def test_midline_components_are_even_or_odd_and_span_both_sides() -> None:
    rng = np.random.default_rng(3)
    across = np.array([1, 0, 3, 2, 4])
    meshes = rng.normal(size=(300, 5, 3)) * rng.uniform(0.1, 1, size=(5, 3))
    meshes[:, 4, 1] = 0
    space, signs = fit_mirrored_space(meshes, across, np.ones(5), 14)
    assert set(signs) == {1.0, -1.0}
    images = meshes[:, across] * MIRROR
    np.testing.assert_allclose(space.basis[across] * MIRROR[:, None], signs * space.basis, atol=1e-12)
    np.testing.assert_allclose(space.project(images), signs * space.project(meshes), atol=1e-9)
    assert space.share > 1 - 1e-9, "14 components are all there are"
