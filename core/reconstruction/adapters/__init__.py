"""Adapters of the projector to the operators of other packages, whose algorithms so run on this scanner.

A package is imported when its adapter is called. The adapted operators compute with `Projector` alone: the same numbers,
kernels and exact adjoint.

To add a package, write a module here that imports it, and a function below that imports the module when it is called.
"""

import importlib
import warnings
from typing import Any

from ...errors import needing
from ...projector import Projector
from ...rays.linear_operator import LinearOperator
from ...validation import instance
from .parallelproj_operator import ParallelprojOperator


def scipy_operator(A: LinearOperator) -> Any:
    """Return `A` as a ``scipy.sparse.linalg.LinearOperator`` on flat arrays, for scipy's ``lsqr``, ``lsmr`` or ``svds``.

    Parameters
    ----------
    A : Projector or its adjoint
        Operator from arrays of ``A.shape_in`` to arrays of ``A.shape_out``.

    Returns
    -------
    scipy.sparse.linalg.LinearOperator
        Operator of shape (pixels, voxels), in C order. Several columns go through `A` as one batch.

    Raises
    ------
    InputError
        scipy is missing, or `A` is no projector.

    Examples
    --------
    >>> from scipy.sparse.linalg import lsqr
    >>> volume = lsqr(scipy_operator(A), images.ravel(), iter_lim=20)[0].reshape(A.shape_in)  # doctest: +SKIP
    """
    instance(A, LinearOperator, "scipy_operator: A")
    return _module("scipy_operator", "scipy").ScipyOperator(A)


def deepinv_physics(A: Projector, **options: Any) -> Any:
    """Return `A` as a ``deepinv.physics.LinearPhysics``, for deepinv's algorithms and networks.

    Parameters
    ----------
    A : Projector
        Projector from volumes to images.
    options
        Options of ``LinearPhysics``, such as ``noise_model=deepinv.physics.PoissonNoise()``.

    Returns
    -------
    deepinv.physics.LinearPhysics
        Operator from volumes (B, C, n_x, n_y, n_z) to images (B, C, M, n_v, n_u), float32 or float64, on any device. If the
        model has a background, the attribute ``background`` holds it, which deepinv's MLEM and OSEM add to the expected
        counts. ``split_physics(n)`` and ``split_measurements(y, n)`` return the balanced subsets for deepinv's OSEM, in the
        order of `osem`.

    Raises
    ------
    InputError
        deepinv is missing, or `A` is no projector.

    References
    ----------
    J. Tachella et al., "DeepInverse: A Python package for solving imaging inverse problems with deep learning",
    Journal of Open Source Software 10 (2025) 8923.

    Examples
    --------
    >>> physics = deepinv_physics(A)
    >>> volume = deepinv.optim.MLEM(max_iter=50)(counts[None, None], physics)[0, 0]  # doctest: +SKIP
    """
    instance(A, Projector, "deepinv_physics: A")
    return _module("deepinv_physics", "deepinv").ProjectorPhysics(A, **options)


def pytomography_matrix(A: Projector) -> Any:
    """Return `A` as a PyTomography ``SystemMatrix``, for PyTomography's OSEM, BSREM and other algorithms.

    Parameters
    ----------
    A : Projector
        Projector from volumes to images.

    Returns
    -------
    pytomography.projectors.SystemMatrix
        Operator from objects (n_x, n_y, n_z) to projections (M, n_v, n_u); lengths are in cm, as in PyTomography. Its
        subsets are balanced over rings and angles, in the order of `osem`. A background is an argument of the likelihood:
        ``additive_term=torch.tensor(A.background)``.

    Raises
    ------
    InputError
        PyTomography is missing, or `A` is no projector.

    References
    ----------
    L. Polson et al., "PyTomography: A Python library for medical image reconstruction", SoftwareX 29 (2025) 102020.

    Examples
    --------
    >>> likelihood = PoissonLogLikelihood(pytomography_matrix(A), counts)  # doctest: +SKIP
    >>> volume = OSEM(likelihood)(n_iters=4, n_subsets=16)  # doctest: +SKIP
    """
    instance(A, Projector, "pytomography_matrix: A")
    with warnings.catch_warnings():  # PyTomography silences all warnings when it is imported
        return _module("pytomography_matrix", "pytomography").ProjectorMatrix(A)


def parallelproj_operator(A: LinearOperator) -> ParallelprojOperator:
    """Return `A` with the methods of a ``parallelproj`` linear operator, for algorithms that use these methods.

    Parameters
    ----------
    A : Projector or its adjoint
        Operator from arrays of ``A.shape_in`` to arrays of ``A.shape_out``.

    Returns
    -------
    ParallelprojOperator
        Operator that can be combined with the operators of `parallelproj`, which need not be installed.

    Raises
    ------
    InputError
        `A` is no projector.

    References
    ----------
    G. Schramm, K. Thielemans, "PARALLELPROJ: an open-source framework for fast calculation of projections in tomography",
    Frontiers in Nuclear Medicine 3 (2024) 1324562.
    """
    instance(A, LinearOperator, "parallelproj_operator: A")
    return ParallelprojOperator(A)


def _module(name: str, package: str) -> Any:
    """Import a module of this folder, which needs `package`; raise `InputError` if a package is missing."""
    with needing(feature=package):
        return importlib.import_module(f".{name}", __package__)
