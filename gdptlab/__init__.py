"""General Defocusing Particle Tracking: x, y and z of particles from one camera (see the README)."""

from gdptlab._versions import versions
from gdptlab.assessment import match, scores, scores_by_z, standard_assessment
from gdptlab.calibration import Calibration
from gdptlab.locate import batch, locate
from gdptlab.preparation import Preparation

__all__ = [
    "Calibration",
    "Preparation",
    "batch",
    "locate",
    "match",
    "scores",
    "scores_by_z",
    "standard_assessment",
    "versions",
]
