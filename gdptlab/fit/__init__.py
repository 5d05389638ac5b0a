"""The model of a frame, fitted: a smooth background plus a sum of particles, all at once."""

from gdptlab.fit.joint import Explained, Joint
from gdptlab.fit.model import PatternModel
from gdptlab.fit.plane import decided_by_plane

__all__ = ["Explained", "Joint", "PatternModel", "decided_by_plane"]
