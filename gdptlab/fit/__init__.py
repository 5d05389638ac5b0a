"""The model of a frame, fitted: all particles and the background at once."""

import lazy_loader

# Each module is imported when one of its names is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "field_calibration": ["FieldCalibration"],
        "over_field": ["decided_by_plane", "locate_over_field"],
        "field_images": ["field_terms"],
    },
)
