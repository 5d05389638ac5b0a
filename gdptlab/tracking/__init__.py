"""From tables to tracks, velocities and the energy of the sound."""

import lazy_loader

# Each module is imported when one of its names is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "tracks": ["identify", "link", "link_scores", "velocities"],
        "acoustic_energy": ["fit_energy", "imitate"],
    },
)
