"""The model of a frame, fitted: a smooth background plus a sum of particles, all at once."""
