"""The model of a frame, fitted: a smooth background plus a sum of particles, all at once."""

import lazy_loader

# Each module is imported when one of its names is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "bounds": ["expected_error", "own_bias_um", "own_error"],
        "frames": ["explained"],
        "joint": ["Explained", "Joint"],
        "learning": ["learned"],
        "mismatch": ["mismatch_error_um", "pattern_mismatch"],
        "model": ["PatternModel", "field_terms"],
        "pattern": ["particle_light"],
        "plane": ["decided_by_plane"],
    },
)
