"""The command that computes the tables of Figure 5, with one short film, and how they are summed up."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from gdptlab.experiment import figure5, replay


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two settings of gdptlab and one frame in 25, of films of 2 s."""
    few = {name: replace(part, settings=((6, 4),), duration_s=2.0, every=25) for name, part in figure5.PARTS.items()}
    monkeypatch.setattr(figure5, "PARTS", few)
    monkeypatch.setattr(figure5, "SETTINGS", {"gdptlab": ((6, 4),), "plain": ((6, 4),)})
    monkeypatch.setattr(figure5, "EARLY_S", 1.0)
    monkeypatch.setattr(figure5, "REPEATS", 1)


def test_the_command_writes_tables_and_a_card(short: None, tmp_path) -> None:
    options = ["--films", "2", "--films-plain", "1", "--frames-timed", "1", "--folder", str(tmp_path)]
    assert figure5.main(options) == 0
    monitors, times, card = figure5.load(tmp_path)
    assert set(monitors) == set(figure5.PARTS)
    assert sorted(monitors["settings"].seed.unique()) == [1, 2] and monitors["plain"].seed.unique().tolist() == [1]
    assert (monitors["later"].t_s >= 1.0).all() and (monitors["settings"].t_s < 2.0).all()
    assert set(monitors["image types"].image_type) == {"brightfield", "disturbed"}
    table = monitors["settings"]
    assert (table.valid <= table["count"]).all() and (table.valid <= table.true_count).all() and table.valid.sum() > 0
    assert set(times.evaluator) == set(figure5.EVALUATORS) and (times.tau_s > 0).all()
    assert card["films"]["plain"] == 1 and str(tmp_path) not in json.dumps(card) and "platform" not in card["versions"]
    replay.errors(table, 0.1)  # the columns that a replay needs are there


def test_films_that_failed_are_counted_and_not_in_the_quartiles() -> None:
    errors = pd.DataFrame(
        {
            "seed": np.arange(5),
            "image_type": "fluorescent",
            "trigger": "h",
            "error_s": [0.1, 0.2, 0.3, 9.0, np.nan],
            "own_error_s": [0.0, 0.1, 0.2, 8.9, np.nan],
            "failed": [False, False, False, True, False],
            "possible": [True, True, True, True, False],
        }
    )
    (row,) = figure5.verdicts(errors, ["trigger"]).to_dict("records")
    assert (row["median"], row["own"], row["failed"], row["films"]) == pytest.approx((0.2, 0.1, 0.25, 4))
    assert row["failed_low"] < 0.25 < row["failed_high"] < 1


def test_settings_are_compared_film_by_film() -> None:
    films = np.tile(np.arange(20), 2)
    errors = pd.DataFrame({"seed": films, "n": np.repeat([51, 6], 20), "possible": True})
    errors["failed"] = (errors.n == 6) & (errors.seed < 10)
    mean, low, high = figure5.paired_difference(errors, "n == 6", "n == 51")
    assert mean == 0.5 and 0.2 < low < 0.4 < 0.6 < high < 0.8
    mean, low, high = figure5.paired_difference(errors, "n == 6", "n == 6")
    assert mean == 0 and -0.15 < low < -0.1 < 0.1 < high < 0.15  # 20 films cannot show that there is no difference


def test_a_shorter_film_shows_the_same_particles() -> None:
    long, short = figure5.film(3), figure5.film(3, duration_s=1.0)
    np.testing.assert_allclose(long[10].astype(int), short[10], atol=1)  # positions agree to 1e-5 um
    assert len(short) == 25
