"""The clock against frames counted by hand; the rest with an evaluator that knows the truth."""

import pickle
from functools import partial

import numpy as np
import pandas as pd
import pytest

from gdptlab import _files
from gdptlab.calibration import Calibration
from gdptlab.experiment import replay
from gdptlab.experiment.channel import Acoustics, Channel, Focusing
from gdptlab.experiment.film import Film
from gdptlab.experiment.replay import (
    Method,
    errors,
    evaluate,
    expected_delay,
    fractions,
    summary,
    sweep,
    trigger_time,
    watch,
)
from gdptlab.locate import locate

FAST = Focusing(acoustics=Acoustics(energy_density_J_m3=30.0))  # all is over after half a second
CALLS = []


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    """The particle images from the common cache, tables from one of the test's own."""
    monkeypatch.setattr(replay, "sources_folder", lambda name: tmp_path)
    CALLS.clear()


def small_film(seed=0, **fields):
    return Film.seeded(seed, focusing=FAST, **{"mean_in_view": 8, "duration_s": 0.6, "shape": (320, 180)} | fields)


def answers(film, late=0, nothing=False):
    """What `oracle` says to each frame, by the sum of its pixels: the truth, `late` frames old."""
    truth = film.truth()
    places = {i: truth.loc[truth["frame"] == max(i - late, 0), ["x_px", "y_px", "z_um"]] for i in range(len(film))}
    return {str(film[i].sum(dtype=int)): table.to_numpy()[: 0 if nothing else None] for i, table in places.items()}


def oracle(image, calibration, *, shift_um=0.0):
    CALLS.append(image.sum(dtype=int))
    table = pd.DataFrame(calibration[str(image.sum(dtype=int))], columns=["x_px", "y_px", "z_um"])
    return table.assign(z_um=table["z_um"] + shift_um)


def perfect(film, **fields):
    return Method(evaluator=oracle, calibration=answers(film), **fields)


# -------------------- clock


def test_watch_counted_by_hand():
    times = np.arange(10) * 0.1
    used = watch(times, 0.25)  # free at 0, 0.25, 0.5, 0.75, 1.0 (the end)
    assert used["index"].tolist() == [0, 2, 5, 7]
    assert used["dropped"].tolist() == [0, 1, 2, 1]
    np.testing.assert_allclose(used["t_s"], [0, 0.2, 0.5, 0.7])
    np.testing.assert_allclose(used["decision_s"], [0.25, 0.5, 0.75, 1.0])


def test_watch_from_another_moment():
    used = watch(np.arange(10) * 0.1, 0.3, 0.17)  # free at 0.17, 0.47, 0.77, 1.07
    assert used["index"].tolist() == [1, 4, 7]
    np.testing.assert_allclose(used["decision_s"], [0.47, 0.77, 1.07])


@pytest.mark.parametrize("tau", [0.01, 0.04, 0.039999])
def test_a_fast_monitor_waits_for_every_frame(tau):
    times = np.arange(500) / 25
    used = watch(times, tau)
    assert used["index"].tolist() == list(range(500))
    assert used["dropped"].sum() == 0
    np.testing.assert_allclose(used["decision_s"], times + tau)


@pytest.mark.parametrize("frames", [2, 3, 7, 25])
def test_whole_multiples_of_the_frame_time_do_not_drift(frames):
    used = watch(np.arange(500) / 25, frames / 25)
    assert used["index"].tolist() == list(range(0, 500, frames))


def test_watch_with_a_time_for_each_frame():
    used = watch(np.arange(8) * 1.0, [0.5, 2.5, 9, 0.2, 0.2, 3.1, 1, 1])
    assert used["index"].tolist() == [0, 1, 3, 4, 5]  # free at .5 (waits), 3.5, 3.7 (waits), 4.2 (waits), 8.1
    assert used["dropped"].tolist() == [0, 0, 1, 0, 0]


def test_watch_stops_where_the_film_does():
    assert watch([0.0, 0.1], 0.15)["index"].tolist() == [0, 1]
    assert watch([0.0, 0.1], 0.25)["index"].tolist() == [0]
    assert watch([0.0, 0.1], 0.1, 7.0).empty
    assert watch([0.0], 3.0)["index"].tolist() == [0]


@pytest.mark.parametrize(("tau", "every"), [(0.01, 1), (0.04, 1), (0.06, 1), (0.33, 1), (1.0, 1), (0.1, 5), (0.33, 5)])
def test_expected_delay_is_that_of_the_clock(tau, every):
    fine = np.arange(300) / 25
    times = fine[::every]
    phases = (np.arange(100) + 0.5) / 100 * max(tau, every / 25)
    events = fine[100 : 100 + 25 * every]
    delays = []
    for phase in phases:
        used = watch(times, tau, phase)["t_s"].to_numpy()
        delays.append(used[np.searchsorted(used, events - 1e-9)] - events)
    delays = np.array(delays)
    expected = expected_delay(tau, every / 25, 1 / 25).iloc[0]
    assert delays.mean() == pytest.approx(expected["mean_s"], abs=0.01)
    assert delays.min() == pytest.approx(expected["low_s"], abs=1e-9)
    assert delays.max() == pytest.approx(expected["high_s"], abs=1e-9)


def test_expected_delay_of_known_cases():
    table = expected_delay([0.02, 0.04, 0.08, 5.0])
    np.testing.assert_allclose(table["mean_s"], [0, 0, 0.02, 2.48], atol=1e-12)
    np.testing.assert_allclose(table["high_s"], [0, 0, 0.04, 4.96], atol=1e-12)


# -------------------- fractions


def test_fractions_count_the_middle_thirds():
    channel = Channel(width_um=120, height_um=60)  # middle thirds to 20 and 10
    table = pd.DataFrame(
        {
            "frame": [3, 3, 3, 7, 9],
            "y_channel_um": [-20.0, 20.1, 0.0, 5.0, 0.0],
            "z_um": [10.0, -10.0, -10.1, 30.0, 0.0],
        }
    )
    out = fractions(table, [3, 5, 7], channel)
    assert out["count"].tolist() == [3, 0, 1]
    np.testing.assert_allclose(out["fraction_h"], [2 / 3, np.nan, 0])
    np.testing.assert_allclose(out["fraction_w"], [2 / 3, np.nan, 1])


def test_trigger_time():
    assert trigger_time([0.0, 0.1, 0.2, 0.3], [0.5, np.nan, 0.9, 0.2]) == 0.2
    assert np.isnan(trigger_time([0.0, 0.1], [0.5, np.nan]))


# -------------------- evaluation


def test_a_perfect_evaluator_makes_no_error():
    film = small_film()
    table = sweep([film], [perfect(film, label={"who": "oracle"})], progress=False)
    assert list(table)[:5] == ["seed", "image_type", "who", "frame", "t_s"]
    pd.testing.assert_series_equal(table["fraction_h"], table["true_fraction_h"], check_names=False)
    out = errors(table, [0.01, 0.1], phases=4)
    assert len(out) == 2 * 4 * 2
    assert out["fired"].all()
    assert not out["failed"].any()
    assert (out["own_error_s"] == 0).all()
    fast = out[out["tau_s"] == 0.01]
    np.testing.assert_allclose(fast["error_s"], 0)
    np.testing.assert_allclose(fast["decision_error_s"], 0.01)
    assert (fast["dropped"] == 0).all()
    slow = out[out["tau_s"] == 0.1]
    assert slow["error_s"].between(0, 0.08 + 1e-9).all()
    assert (slow["decision_error_s"] > 0.1 - 1e-9).all()


def test_times_that_are_no_numbers_are_refused():
    film = small_film()
    table = sweep([film], [perfect(film)], progress=False)
    with pytest.raises(ValueError, match=r"^table"):
        errors(table.assign(t_s=np.inf), 0.1)


def test_dropped_frames_are_those_before_the_trigger():
    film = small_film()
    table = sweep([film], [perfect(film)], progress=False)
    row = errors(table, 0.12, phases=1).query("trigger == 'w'").iloc[0]  # starts at 0.06: frames 1, 4, 7, ...
    used = round((row["true_s"] + row["error_s"]) * 25)
    assert used % 3 == 1
    assert row["dropped"] == (used - 1) // 3 * 2


def test_a_late_evaluator_is_late_by_as_much():
    film = small_film()
    late = Method(evaluator=oracle, calibration=answers(film, late=2))
    out = errors(sweep([film], [late], progress=False), 0.04, phases=1)
    np.testing.assert_allclose(out["error_s"], 0.08)
    assert not out["failed"].any()
    assert errors(sweep([film], [late], progress=False), 0.04, phases=1, limit_s=0.07)["failed"].all()


def test_times_of_each_method_and_frame():
    film = small_film()
    table = sweep([film], [perfect(film)], progress=False)
    own = errors(table.assign(tau_s=0.1), phases=2)
    pd.testing.assert_frame_equal(own, errors(table, 0.1, phases=2))
    by_frame = errors(table.assign(tau_s=np.linspace(0.05, 0.15, len(table))), phases=2)
    np.testing.assert_allclose(by_frame["tau_s"], 0.1)
    with pytest.raises(ValueError, match="tau_s"):
        errors(table)


@pytest.mark.parametrize(("settings", "nothing"), [({"shift_um": 1000.0}, False), ({}, True)])
def test_a_trigger_that_never_comes_is_counted_not_averaged(settings, nothing):
    film = small_film()
    method = Method(evaluator=oracle, calibration=answers(film, nothing=nothing), settings=settings)
    table = sweep([film], [method], progress=False)
    out = errors(table, 0.04, phases=3).query("trigger == 'h'")
    assert out["error_s"].isna().all()
    assert not out["fired"].any()
    assert out["failed"].all()
    row = summary(out, ["trigger"]).iloc[0]
    assert (row["replays"], row["never"], row["failed"], row["impossible"], row["films"]) == (3, 3, 3, 0, 1)
    assert np.isnan(row["error_s_median"])


def test_a_film_that_ends_too_early_is_nobodys_failure():
    film = small_film(duration_s=0.12)
    out = errors(sweep([film], [perfect(film)], progress=False), 0.04, phases=2)
    assert out["true_s"].isna().all()
    assert not out["possible"].any()
    assert not out["failed"].any()
    assert summary(out, ["trigger"])["impossible"].tolist() == [2, 2]


def test_summary_of_known_errors():
    film = small_film()
    out = errors(sweep([film], [perfect(film)], progress=False), 0.04, phases=5).query("trigger == 'w'")
    out = out.assign(error_s=[0.1, 0.2, 0.3, 0.4, np.nan], fired=[True] * 4 + [False])
    row = summary(out, ["trigger", "tau_s"]).iloc[0]
    np.testing.assert_allclose(row[["error_s_q25", "error_s_median", "error_s_q75"]].tolist(), [0.175, 0.25, 0.325])
    assert row["never"] == 1


def test_every_so_many_frames_truth_at_all():
    film = small_film()
    all_, some = (sweep([film], [perfect(film)], every=k, progress=False) for k in (1, 4))
    assert some["frame"].tolist() == list(range(0, len(film), 4))
    pd.testing.assert_frame_equal(some, all_.iloc[::4].reset_index(drop=True))


def test_nothing_is_evaluated_twice():
    film = small_film()
    one, other = perfect(film), perfect(film, settings={"shift_um": 1.0})
    first = evaluate(film, [one], progress=False)[0]
    assert len(CALLS) == len(film)
    both = evaluate(small_film(), [perfect(film), other], progress=False)
    assert len(CALLS) == 2 * len(film)
    pd.testing.assert_frame_equal(both[0], first)
    np.testing.assert_array_equal(both[1]["z_um"], first["z_um"] + 1)
    evaluate(film, [one], cache=False, progress=False)
    assert len(CALLS) == 3 * len(film)


def test_all_that_matters_is_in_the_key():
    film = small_film()
    evaluate(film, [perfect(film)], progress=False)
    others = [small_film(1), small_film(camera=type(film.camera)(read_noise=30.0)), small_film(mean_in_view=9)]
    for other in others:
        before = len(CALLS)
        evaluate(other, [perfect(other)], progress=False)
        assert len(CALLS) == before + len(other)


@pytest.mark.parametrize("change", ["sources", "versions"])
def test_tables_of_other_software_are_not_read(change, tmp_path, monkeypatch):
    film, method = small_film(), perfect(small_film())
    monkeypatch.setenv("GDPTLAB_CACHE", str(tmp_path))
    monkeypatch.setattr(replay, "sources_folder", _files.sources_folder.__wrapped__)
    evaluate(film, [method], progress=False)
    evaluate(film, [method], progress=False)
    assert len(CALLS) == len(film)
    if change == "sources":
        monkeypatch.setattr(_files, "sources_digest", lambda: "0123456789abcdef")
    else:
        monkeypatch.setattr(replay, "versions", lambda: {"numpy": "9.0"})
    evaluate(film, [method], progress=False)
    assert len(CALLS) == 2 * len(film)


def test_without_a_cache_folder_a_film_is_evaluated_each_time(monkeypatch):
    film = small_film(duration_s=0.12)
    monkeypatch.setattr(replay, "sources_folder", lambda name: None)
    for _ in range(2):
        evaluate(film, [perfect(film)], progress=False)
    assert len(CALLS) == 2 * len(film)


def test_the_name_of_a_table_is_the_same_in_any_process_and_after_use():
    film, again = small_film(), small_film()
    again[3]  # fills what is kept between frames
    names = {replay._cache_name(f, perfect(f), np.arange(3)) for f in (film, again, pickle.loads(pickle.dumps(again)))}
    assert len(names) == 1


def test_a_stopped_sweep_goes_on(monkeypatch):
    films = [small_film(seed) for seed in (1, 2, 3)]
    method = Method(evaluator=oracle, calibration=answers(films[0]) | answers(films[1]) | answers(films[2]))
    render = Film.__getitem__

    def power_cut(film, frame):
        if (film.seed, frame) == (2, 5):
            raise KeyboardInterrupt
        return render(film, frame)

    monkeypatch.setattr(Film, "__getitem__", power_cut)
    with pytest.raises(KeyboardInterrupt):
        sweep(films, [method], progress=False)
    monkeypatch.setattr(Film, "__getitem__", render)
    CALLS.clear()
    again = sweep(films, [method], progress=False)
    assert len(CALLS) == len(films[1]) + len(films[2])
    pd.testing.assert_frame_equal(again, sweep(films, [method], cache=False, progress=False))


def test_a_damaged_cache_is_made_anew(tmp_path):
    film = small_film()
    first = evaluate(film, [perfect(film)], progress=False)[0]
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:-40])
    pd.testing.assert_frame_equal(evaluate(film, [perfect(film)], progress=False)[0], first)


def test_locate_gives_the_same_for_any_number_of_processes(monkeypatch):
    monkeypatch.setattr(replay, "FRAMES_PER_JOB", 3)
    film = small_film(mean_in_view=15)
    methods = replay.grid(locate, partial(Calibration.from_stack, *film.stack(11, 41)), n=(11,), n_sub=(6, 12))
    assert [m.label for m in methods] == [{"n": 11, "n_sub": 6, "refine": r} for r in (True, False)]
    tables = [evaluate(film, methods, n_jobs=k, every=2, cache=False, progress=False) for k in (1, 2)]
    for a, b in zip(*tables, strict=True):
        pd.testing.assert_frame_equal(a, b, check_exact=True)
        assert {"frame", "x_px", "y_px", "z_um", "cm", "at_end"} == set(a)


def test_durations_are_of_the_evaluator():
    film = small_film()
    out = replay.durations(film, [perfect(film, label={"who": "oracle"})], count=4, progress=False)
    assert list(out) == ["who", "frame", "tau_s"]
    assert out["frame"].tolist() == [0, 4, 9, 14]
    assert (out["tau_s"] > 0).all()


# -------------------- bad input


def no_table(image, calibration):
    return [1, 2, 3]


def no_depth(image, calibration):
    return pd.DataFrame({"x_px": [1.0], "y_px": [2.0]})


def words(image, calibration):
    return pd.DataFrame({"x_px": [1.0], "y_px": [2.0], "z_um": ["deep"]})


def blind(image, calibration):
    CALLS.append(0)
    return pd.DataFrame(columns=["x_px", "y_px", "z_um"])


def test_an_evaluator_may_see_nothing_and_say_so_without_types():
    film = small_film()
    for _ in range(2):
        table = sweep([film], [Method(evaluator=blind)], progress=False)
        assert (table["count"] == 0).all()
        assert table["fraction_h"].isna().all()
    assert len(CALLS) == len(film)


@pytest.mark.parametrize(
    ("method", "error", "match"),
    [
        (Method(evaluator=no_table), TypeError, "evaluator"),
        (Method(evaluator=no_depth), ValueError, "z_um"),
        (Method(evaluator=words), TypeError, "evaluator"),
        (Method(evaluator=no_depth, calibration=object()), TypeError, "method"),
        (Method(evaluator=partial(no_depth)), TypeError, "evaluator"),
        (no_depth, TypeError, "methods"),
    ],
)
def test_methods_that_cannot_be(method, error, match):
    with pytest.raises(error, match=match):
        evaluate(small_film(), [method], progress=False)


def test_arguments_of_sweeps_that_cannot_be():
    film = small_film()
    method = perfect(film)
    with pytest.raises(TypeError, match="evaluator"):
        Method(evaluator="locate")
    with pytest.raises(ValueError, match="n_jobs"):
        evaluate(film, [method], n_jobs=0)
    with pytest.raises(ValueError, match="every"):
        evaluate(film, [method], every=0)
    with pytest.raises(ValueError, match="films"):
        sweep([film, film], [method])
    with pytest.raises(ValueError, match="films"):
        sweep([], [method])
    with pytest.raises(ValueError, match="methods"):
        sweep([film], [])
    for level in (0, 1.1, -1, np.nan):
        with pytest.raises(ValueError, match="level"):
            sweep([film], [method], level=level, progress=False)
        with pytest.raises(ValueError, match="level"):
            trigger_time([0.0], [1.0], level)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: watch([], 0.1), "times_s"),
        (lambda: watch([0.0, 0.0], 0.1), "times_s"),
        (lambda: watch([0.0, 1.0], 0.0), "tau_s"),
        (lambda: watch([0.0, 1.0], -0.1), "tau_s"),
        (lambda: watch([0.0, 1.0], [0.1]), "tau_s"),
        (lambda: watch([0.0, 1.0], [0.1, np.nan]), "tau_s"),
        (lambda: watch([0.0, 1.0], 0.1, -1.0), "phase_s"),
        (lambda: expected_delay(0.0), "tau_s"),
        (lambda: expected_delay(0.1, 0.0), "camera_s"),
        (lambda: expected_delay(0.1, 0.1, 0.04), "truth_s"),
        (lambda: fractions(pd.DataFrame({"frame": [1]}), [1], Channel()), "y_channel_um"),
        (lambda: fractions(pd.DataFrame(columns=["frame", "y_channel_um", "z_um"]), [1, 1], Channel()), "frames"),
        (lambda: errors(pd.DataFrame(columns=["frame", "tau_s"]), phases=0), "phases"),
        (lambda: errors(pd.DataFrame(columns=["frame", "tau_s"]), limit_s=0), "limit_s"),
    ],
)
def test_numbers_that_cannot_be(call, match):
    with pytest.raises(ValueError, match=match):
        call()
