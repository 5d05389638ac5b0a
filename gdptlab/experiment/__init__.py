"""The paper's experiment: microscope, image types, channel, film, and the clock of camera and monitor."""

import lazy_loader

# Each module is imported when one of its names is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "channel": ["Acoustics", "Channel", "Focusing", "Suspension", "Trajectories"],
        "film": ["Film"],
        "image_types": ["IMAGE_TYPES", "brightfield", "disturbed", "fluorescent"],
        "camera": ["Camera"],
        "microscope": ["Microscope"],
        "plain": ["locate_plainly"],
        "replay": [
            "Method",
            "durations",
            "errors",
            "evaluate",
            "evaluated_frames",
            "expected_delay",
            "grid",
            "summary",
            "sweep",
            "watch",
        ],
        "trigger": ["fractions", "in_middle_third", "trigger_time"],
        "waves": ["WaveMicroscope"],
        "samples": ["make_samples", "sample_scan"],
    },
)
