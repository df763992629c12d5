"""Everything that decides what the breathing liver is, besides the shape's own numbers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class BreathingSpec:
    """Settings of one breathing liver. Lengths in metres; axes LPS: x to the left, y to the back, z to the head.

    Attributes
    ----------
    seed
        Of every random choice: shape, vessels, errors of the segmentation.
    organ_spacing, vessel_spacing
        Edge lengths of the surfaces that a scan yields.
    element_size
        Edge length of the finite elements.
    portal_ends, hepatic_ends
        Ends of the two vessel trees.
    youngs_modulus_pa, poisson_ratio, stiffening
        Of the tissue, the first two at small strain.
    gravity
        Share of the weight that the neighbours do not carry, which are about as dense as the liver.
    breath_m
        How far the diaphragm moves to the feet where it moves most.
    diaphragm_pa_m, bed_pa_m, ligament_pa_m
        Stiffness of what the surface rests on: pressure for a displacement, Pa/m. The diaphragm holds only across
        itself and lets the liver slide along it; the bed of the other organs and the falciform ligament hold in
        every direction.
    organ_error, vessel_error
        Standard deviation of where a segmentation puts the surface; it changes smoothly over `error_length`.
    pose_degrees, pose_m
        Rotation vector and translation from the first scan's frame to the second's: the patient lies differently.
    inner_points
        Points inside the organ whose true displacement is written.
    """

    seed: int = 2
    organ_spacing: float = 0.0055
    vessel_spacing: float = 0.0021
    element_size: float = 0.0125
    portal_ends: int = 22
    hepatic_ends: int = 16
    youngs_modulus_pa: float = 2500.0
    poisson_ratio: float = 0.48
    stiffening: float = 3.0
    gravity: float = 0.12
    breath_m: float = 0.020
    diaphragm_pa_m: float = 300e3
    bed_pa_m: float = 10e3
    ligament_pa_m: float = 40e3
    organ_error: float = 0.0005
    vessel_error: float = 0.0003
    error_length: float = 0.008
    pose_degrees: tuple[float, float, float] = (3.0, -2.0, 4.0)
    pose_m: tuple[float, float, float] = (0.012, -0.008, 0.025)
    inner_points: int = 2000
