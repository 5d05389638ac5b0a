"""Pictures too long for a notebook's cell, in one style."""

import lazy_loader

# Each module is imported when one of its names is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "calibration_map": [
            "calibration_quality",
            "correlation_peak",
            "draw_similarity",
            "expected_profiles",
            "maps_around",
            "profile_match",
        ],
        "errors": ["score_curves", "z_errors"],
        "experiment": [
            "TRIGGERS",
            "TRIGGER_COLOURS",
            "TRIGGER_TITLES",
            "draw_monitor",
            "fig4_acoustophoresis",
            "player",
            "replay_animation",
            "replay_view",
            "save_animation",
        ],
        "figure5": ["error_against_tau", "fig5_settings", "fig5_times", "three_answers"],
        "frames": ["circled", "contact_sheet", "draw_in_space", "frame_with_particles", "particles_3d", "side_by_side"],
        "knobs": ["panel", "slide"],
        "limits": ["biases", "errors_against_bound", "expected_errors"],
        "live": ["loop_and_timer", "off_times", "seen_and_true"],
        "watching": ["LivePage", "LivePanel", "live_panel", "watch_live"],
        "notebook": ["all_measured", "end_notebook", "keep_measured", "measured_lines", "quote_measured"],
        "overlap": ["RESIDUAL_END", "error_ratios", "film_followed", "found_and_left", "laid_bare"],
        "quality": ["calibration_page", "depth_against_truth", "measured_page", "symptoms"],
        "rotatable": ["Rotatable", "turn_particles", "turn_paths"],
        "speed": ["breakdown", "frame_times", "real_time", "scaling"],
        "style": ["COLOURS", "FIGURES", "bare", "depth_label", "extent", "folder", "save", "use"],
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
