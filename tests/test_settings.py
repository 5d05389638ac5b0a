"""Settings from the frames themselves, and what can be overruled."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from gdptlab import Calibration, assessment, batch, locate
from gdptlab.pipeline.settings import choose_settings


@pytest.mark.parametrize("kind", ["fluorescent", "brightfield", "disturbed"])
def test_threshold_keeps_particles_and_leaves_noise_out(isolated, calibrations, kind) -> None:
    frames, truth = isolated[kind]
    settings = choose_settings(frames, calibrations[kind], method="correlation", looked_at=2)
    assert settings.threshold < 0.6 and not settings.inverted
    score = assessment.scores(locate(frames[3], calibrations[kind], **settings.arguments), of(truth, 3))
    assert score.recall > 0.95 and score.precision > 0.95
    assert ((settings.false["cm"] >= settings.threshold).sum()) <= 0.01 * len(settings.found)


def of(truth, frame):
    return truth[truth["frame"] == frame].drop(columns="frame").reset_index(drop=True)


def test_joint_is_chosen_where_its_model_holds(few, calibration, microscope) -> None:
    """For particles alike and of amplitudes 1 to 25, not for those of another microscope."""
    frame, particles = few
    more = pd.concat([particles, particles.assign(x_px=particles["x_px"] - 16, z_um=-particles["z_um"])])
    uneven, other = more.assign(amplitude=np.geomspace(0.2, 5, 8)), replace(microscope, cylinder_um=None)
    for seen, by, method in ((more, microscope, "joint"), (uneven, microscope, "joint"), (more, other, "correlation")):
        image = by.render(seen, frame.shape, rng=np.random.default_rng(8))
        assert choose_settings([image], calibration).arguments["method"] == method
    assert choose_settings([frame], calibration).arguments["method"] == "correlation"  # too few to tell


def test_what_is_given_is_used_and_said(few, calibration) -> None:
    settings = choose_settings([few[0]], calibration, threshold=0.7, refine=False)
    assert settings.arguments == {"method": "correlation", "threshold": 0.7, "refine": False, "min_distance_px": 15.25}
    how = {"method": "by itself", "threshold": "given", "refine": "given", "min_distance_px": "by itself"}
    assert settings.table["how"].to_dict() == how
    assert len(batch([few[0]], calibration, progress=False, **settings.arguments)) == 4


def test_opposite_contrast_is_noticed(few, calibration) -> None:
    turned = choose_settings([60_000 - few[0].astype(float)], calibration, method="correlation")
    assert turned.inverted
    assert not choose_settings([few[0]], calibration, method="correlation").inverted


def test_blank_frames_have_no_particles(calibration) -> None:
    settings = choose_settings(np.zeros((2, 80, 80)), calibration, method="correlation")
    assert settings.threshold == 0.5 and settings.found.empty


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"frames": []}, ValueError, "^frames: "),
        ({"threshold": 1.5}, ValueError, "^threshold: "),
        ({"threshold": "low"}, TypeError, "^threshold: "),
        ({"method": "guess"}, ValueError, "^method: "),
        ({"method": "joint", "threshold": 0.5}, ValueError, "^threshold: "),
        ({"false_fraction": 1}, ValueError, "^false_fraction: "),
        ({"looked_at": 0}, ValueError, "^looked_at: "),
        ({"min_distance_px": -1}, ValueError, "^min_distance_px: "),
        ({"frames": [np.full((80, 80), np.nan)]}, ValueError, "^image: "),
    ],
)
def test_refuses(calibration, changes, error, message) -> None:
    with pytest.raises(error, match=message):
        choose_settings(**{"frames": np.zeros((1, 80, 80)), "calibration": calibration} | changes)


def test_parts_of_a_particle_are_no_particles() -> None:
    """In focus a particle is a spot, far from it four of them: what looks like a particle in each is a side-lobe."""
    z_um, (y, x) = np.arange(12.0), np.indices((41, 41)) - 20
    reach = np.repeat([0, 8], 6)
    stack = np.array(
        [sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / 8) for a in (-r, r) for b in (-r, r)) / 4 for r in reach]
    )
    calibration = Calibration.from_stack(1000 * stack + np.random.default_rng(1).normal(0, 2, stack.shape), z_um)
    frame = np.random.default_rng(2).normal(0, 2, (200, 200))
    for row, column, k in ((50, 50, 2), (140, 60, 9), (60, 150, 10), (140, 140, 3)):
        frame[row - 20 : row + 21, column - 20 : column + 21] += 1000 * stack[k]
    settings = choose_settings([frame], calibration, method="correlation")
    assert len(settings.side_lobes) >= 4 and settings.threshold > settings.side_lobes["cm"].max()
    assert len(locate(frame, calibration, **settings.arguments)) == 4


def test_frames_of_the_whole_film_are_looked_at(few, calibration) -> None:
    """A film whose first frames are blank, as while the light is switched on."""
    film = [np.zeros_like(few[0])] * 4 + [few[0]] * 9
    settings = choose_settings(film, calibration, method="correlation")
    assert set(settings.found.query("cm > 0.5")["frame"]) == {1, 2}
    assert choose_settings(iter(film), calibration, method="correlation").found.empty
