"""A monitor beside a running camera, and a simulated device to try it on."""

import lazy_loader

# Each module is imported when one of its names is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "monitor": ["Monitor", "Result", "Status"],
        "triggers": ["Fraction", "MiddleThird", "Trigger", "middle_thirds"],
        "sources": ["FillingFolder", "Frame", "MicroManagerCamera", "at_speed"],
        "actions": ["over_http", "over_serial"],
        "following": ["Follower"],
        "device": ["Device", "Switched", "closed_loop", "switched", "timed", "true_fractions"],
        "own_process": ["OwnProcess"],
        "logbook": ["Logbook", "read_log"],
    },
)
