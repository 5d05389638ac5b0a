"""From tables to tracks, velocities, mean fields and the energy of the sound; export to ParaView and napari."""

import lazy_loader

# Each module is imported when one of its names is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "tracks": ["identify", "link", "link_scores", "velocities"],
        "drifting": ["drift", "without_drift"],
        "fields": ["mean_field", "mean_squared_displacement"],
        "export": ["napari_tracks", "save_paraview_field", "save_paraview_tracks"],
        "acoustic_energy": ["fit_energy", "imitate"],
    },
)
