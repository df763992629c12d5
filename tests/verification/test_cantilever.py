"""A slender cantilever bent far by a force at its end, against the exact solution of the elastica.

Bisshopp and Drucker (1945) solved it; Mattiasson (1981) tabulates it: a horizontal beam of length L and bending
stiffness EI under a vertical dead force P at its end.
"""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from softtissue_training.physics.material import LAWS, Material
from softtissue_training.physics.solver import solve
from verification.blocks import lattice

# P L^2 / EI: slope, deflection w / L and shortening u / L of the end.
MATTIASSON = {
    1.0: (0.46135, 0.30172, 0.05643),
    2.0: (0.78175, 0.49346, 0.16064),
    5.0: (1.21537, 0.71379, 0.38763),
    10.0: (1.43029, 0.81061, 0.55500),
}


def _elastica(load):
    """Slope, deflection and shortening of the end by quadrature of theta'^2 = 2 P / EI (sin theta_end - sin theta)."""

    def integral(function, end):
        def integrand(t):
            theta = end - t * t  # keeps the integrand finite at the end
            return function(theta) * 2.0 * t / np.sqrt(2.0 * load * (np.sin(end) - np.sin(theta)))

        return quad(integrand, 0.0, np.sqrt(end))[0]

    end = brentq(lambda slope: integral(np.ones_like, slope) - 1.0, 0.05, 1.5)
    return end, integral(np.sin, end), 1.0 - integral(np.cos, end)


def _end(load, cells, law):
    """Deflection and shortening of the end over the length, for a strip of a beam 20 times as long as high."""
    length, height = 1.0, 0.05
    width = height / cells
    vertices, tets = lattice((20 * cells, 1, cells), (length, width, height))
    material = Material(law, 1700.0, 0.0)
    held = np.zeros(vertices.shape, dtype=bool)
    held[:, 1] = True  # without lateral strain a strip is the beam; it must not tip over
    held[vertices[:, 0] == 0.0] = True
    end = np.isclose(vertices[:, 0], length)
    share = np.where(np.isin(vertices[:, 2], (0.0, height)), 0.5, 1.0) * end
    force = np.zeros_like(vertices)
    force[:, 2] = share / share.sum() * load * 1700.0 * width * height**3 / 12.0 / length**2
    moved = solve(vertices, tets, held, force, material).displacement[end].mean(axis=0)
    return np.array([moved[2], -moved[0]]) / length


@pytest.mark.parametrize(("law", "load"), [(LAWS[0], 2.0), (LAWS[1], 2.0), (LAWS[0], 10.0)])
def test_large_deflection_of_a_cantilever(law, load):
    np.testing.assert_allclose(MATTIASSON[load], _elastica(load), atol=1e-5)  # the table is typed correctly
    coarse, fine = _end(load, 4, law), _end(load, 8, law)
    extrapolated = fine + (fine - coarse) / 3.0
    np.testing.assert_allclose(extrapolated, MATTIASSON[load][1:], rtol=0.01)
