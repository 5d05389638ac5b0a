"""General Defocusing Particle Tracking: x, y and z of particles from one camera (see the README)."""

from gdptlab.assess import match
from gdptlab.calibration import Calibration
from gdptlab.locate import batch, locate
from gdptlab.optics import Microscope
from gdptlab.versions import versions

__all__ = ["Calibration", "Microscope", "batch", "locate", "match", "versions"]
