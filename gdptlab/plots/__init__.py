"""Pictures too long for a notebook's cell, in one style."""

import lazy_loader

# Each module is imported when one of its names is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "calibration_map": [
            "calibration_quality",
            "correlation_maps",
            "correlation_peak",
            "expected_profiles",
            "fig2_calibration_map",
            "profile_match",
            "self_similarity",
        ],
        "errors": ["score_curves", "z_errors"],
        "experiment": [
            "error_against_tau",
            "fig4_acoustophoresis",
            "fig5",
            "focusing_in_time",
            "forces_and_flow",
            "instants",
            "monitor_in_time",
            "replay_view",
            "scrub",
            "templates_and_densities",
        ],
        "frames": [
            "compared_images",
            "contact_sheet",
            "fig3_image_types",
            "frame_with_particles",
            "particles_3d",
            "width_and_peak",
        ],
        "knobs": ["Knobs", "panel"],
        "limits": ["biases", "errors_against_bound", "expected_errors"],
        "live": ["latencies", "live_panel", "loop_and_timer", "one_loop", "watch_live"],
        "notebook": ["end_notebook"],
        "overlap": ["REACH", "error_ratios", "film_followed", "found_and_left", "laid_bare"],
        "quality": ["calibration_page", "depth_against_truth", "measured_page", "symptoms"],
        "speed": ["breakdown", "frame_times", "real_time", "scaling"],
        "style": ["FIGURES", "save"],
        "tracks": [
            "collapsed_paths",
            "energy_intervals",
            "links_in_time",
            "one_track",
            "tracks_in_space",
            "velocity_profiles",
        ],
    },
)
