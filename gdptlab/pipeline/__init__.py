"""From files to tables: reading images, finding beads, choosing settings, judging them, writing results."""

import lazy_loader

# Each module is imported when one of its names is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "images": ["Images", "mean_image", "open_images", "open_scan"],
        "beads": ["ScanReport", "find_beads"],
        "errors": ["with_errors"],
        "quality": ["depth_quality", "report"],
        "settings": ["Settings", "choose_settings"],
        "measuring": ["Measured", "measure"],
        "stream": ["batch_to_parquet"],
        "surface": ["flattened"],
        "without_stage": ["FilmReport"],
        "tables": ["in_um", "save_points", "save_table"],
    },
)
