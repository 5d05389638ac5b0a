"""The model of a frame, fitted: a smooth background plus a sum of particles, all at once."""

from gdptlab.fit.joint import Explained, Joint
from gdptlab.fit.model import PatternModel

__all__ = ["Explained", "Joint", "PatternModel"]
