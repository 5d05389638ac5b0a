"""The real-time experiment: evaluate a film once, then replay camera and monitor as often as wanted.

A monitor takes the camera's newest frame as soon as it is free, is busy for the evaluation time τ, then takes
the newest again; frames in between are dropped. It fires when 90 % of the particles it measured are in the
middle third of the height (trigger 'h', the paper's t_{h/3}) or of the width ('w', t_{w/3}).

The result of evaluating a frame does not depend on τ. So `sweep` evaluates the frames of many films in many ways,
renders each frame once for all of them, and keeps the tables on disk; `watch` is the clock; `errors` lets the clock
run over those tables for any τ and any moment of switching on.

Any function with the signature of `locate` can be the evaluator.
"""

import inspect
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from numbers import Integral
from typing import Any

import joblib
import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from gdptlab._checks import flag, function, instance, instances, numbers, positive, processes, whole
from gdptlab._checks import table as check_table
from gdptlab._files import keep_arrays, kept_arrays, sources_folder
from gdptlab._versions import versions
from gdptlab._workers import leave_with_parent
from gdptlab.experiment.film import Film
from gdptlab.experiment.trigger import fractions, trigger_time

FRAMES_PER_JOB = 25
"""Number of frames that one job of a worker process holds; no result depends on it. Chosen: to hand a job over takes
some ms, which is little beside 25 frames of 10 ms; with thousands, a film of 500 frames would not fill two cores."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Method:
    """One way to evaluate a frame.

    Attributes
    ----------
    evaluator : callable
        (image, calibration, **settings) -> DataFrame with at least `x_px`, `y_px`, `z_um`, like `locate`.
    calibration : object
        Second argument of the evaluator.
    settings : mapping
        Its keyword arguments.
    label : mapping
        Columns, and their values, that tell this method from others in tables.
    """

    evaluator: Callable[..., pd.DataFrame]
    calibration: Any = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    label: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        function("evaluator", self.evaluator)
        for name in ("settings", "label"):
            instance(name, getattr(self, name), Mapping)

    def __call__(self, image: NDArray) -> pd.DataFrame:
        """Evaluate one frame.

        Raises
        ------
        TypeError, ValueError
            If the evaluator returns no table, one without a column that is needed, or one that holds anything
            but numbers.
        """
        table = self.evaluator(image, self.calibration, **self.settings)
        if not isinstance(table, pd.DataFrame):
            raise TypeError(f"evaluator: got a {type(table).__name__} from it, allowed is a DataFrame")
        if not {"x_px", "y_px", "z_um"} <= set(table):
            raise ValueError(f"evaluator: got columns {list(table)} from it, needed are x_px, y_px and z_um")
        if len(table) == 0:
            return table.astype({name: float for name, dtype in table.dtypes.items() if dtype.kind == "O"})
        if not all(dtype.kind in "buif" for dtype in table.dtypes):
            raise TypeError(f"evaluator: got {dict(table.dtypes)} from it, allowed are columns of numbers")
        return table


def grid(
    evaluator: Callable[..., pd.DataFrame],
    calibrate: Callable[..., Any],
    *,
    n: Iterable[int] = (51, 26, 11, 6),
    n_sub: Iterable[int] = (11, 9, 6, 4),
    refine: Iterable[bool] = (True, False),
    **settings: Any,
) -> list[Method]:
    """Methods of the paper's Figure 5 (a-c): all combinations with n_sub ≤ n.

    Parameters
    ----------
    evaluator : callable
        `locate`, or one that also has the setting `refine`.
    calibrate : callable
        Called as calibrate(n=..., n_sub=...), for example `partial(Calibration.from_stack, stack, z_um)`.
    n, n_sub, refine : iterables
        N, N_sub, and whether the refinement step is done.
    **settings
        Of the evaluator, the same for all.

    Returns
    -------
    list of Method
        With labels `n`, `n_sub`, `refine`.
    """
    function("calibrate", calibrate)
    n, n_sub, refine = (
        instances(name, value, kind)
        for name, value, kind in (("n", n, Integral), ("n_sub", n_sub, Integral), ("refine", refine, bool))
    )
    pairs = [(a, b) for a in n for b in n_sub if b <= a]
    calibrations = {pair: calibrate(n=pair[0], n_sub=pair[1]) for pair in pairs}
    return [
        Method(
            evaluator=evaluator,
            calibration=calibrations[pair],
            settings={"refine": r, **settings},
            label={"n": pair[0], "n_sub": pair[1], "refine": r},
        )
        for pair in pairs
        for r in refine
    ]


def evaluate(
    film: Film,
    methods: Sequence[Method],
    *,
    every: int = 1,
    n_jobs: int = 1,
    cache: bool = True,
    progress: bool = True,
) -> list[pd.DataFrame]:
    """Evaluate a film in several ways, each frame rendered once.

    Parameters
    ----------
    film : Film
    methods : sequence of Method
    every : int
        Evaluate only every so many frames: a slower camera.
    n_jobs : int
        Processes; -1 for one per core. The result does not depend on it.
    cache : bool
        Look for each method's table in the cache folder, and put it there. The tables are read again only by the
        same sources and versions of all packages.
    progress : bool
        Show a progress bar.

    Returns
    -------
    list of DataFrame
        For each method `frame` (its number in the film) and the columns of its evaluator.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of its form, an evaluator returns no such table, or, with `cache`, a part of a
        method cannot be told from another by its value.
    """
    n_jobs = processes("n_jobs", n_jobs)
    methods = instances("methods", methods, Method)
    frames = evaluated_frames(film, every)
    flag("progress", progress)
    folder = sources_folder("replay") if flag("cache", cache) else None
    paths = [folder / _cache_name(film, method, frames) if folder else None for method in methods]
    # `joblib.Memory` would keep the result of one call; here one pass over the film serves all missing tables.
    tables = [kept_arrays(path) if path else None for path in paths]
    missing = [i for i, table in enumerate(tables) if table is None]
    if not missing:
        return [pd.DataFrame(table) for table in tables]
    todo = [methods[i] for i in missing]
    # This process evaluates the first frame, so that workers get calibrations whose lazy parts are there already.
    parts = [_evaluated(film, todo, frames[:1])]
    blocks = [frames[k : k + FRAMES_PER_JOB] for k in range(1, len(frames), FRAMES_PER_JOB)]
    parallel = Parallel(n_jobs=n_jobs, return_as="generator", initializer=leave_with_parent)
    jobs = parallel(delayed(_evaluated)(film, todo, block) for block in blocks)
    with tqdm(total=len(frames), initial=1, desc="frames", unit="frame", leave=False, disable=not progress) as bar:
        for block, part in zip(blocks, jobs, strict=True):
            parts.append(part)
            bar.update(len(block))
    for i, *pieces in zip(missing, *parts, strict=True):
        tables[i] = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
        if paths[i]:
            keep_arrays(paths[i], tables[i])
    return [pd.DataFrame(table) for table in tables]


def evaluated_frames(film: Film, every: int = 1) -> NDArray[np.int64]:
    """Return the numbers of the frames that `evaluate` looks at, (n,)."""
    return np.arange(0, len(instance("film", film, Film)), whole("every", every, 1, len(film)))


def _evaluated(film: Film, methods: Sequence[Method], frames: NDArray[np.int64]) -> list[dict[str, NDArray]]:
    """Return the columns of each method's table over the frames with these numbers (n,)."""
    found: list[list[pd.DataFrame]] = [[] for _ in methods]
    for frame in frames.tolist():
        image = film[frame]
        for tables, method in zip(found, methods, strict=True):
            tables.append(method(image))
    return [
        {"frame": np.repeat(frames, [len(t) for t in tables])}
        | {name: np.concatenate([t[name].to_numpy() for t in tables]) for name in tables[0] if name != "frame"}
        for tables in found
    ]


def _cache_name(film: Film, method: Method, frames: NDArray[np.int64]) -> str:
    """Return the name of a table's file: a hash of all that the table depends on, besides the package's sources."""
    parts = versions(), film, frames, _source(method.evaluator), method.calibration, method.settings
    return f"{joblib.hash([_plain(part) for part in parts])}.npz"


def _source(evaluator: Callable) -> list[str]:
    """Return name and code of a function (of its whole module, unless that is a notebook)."""
    try:
        module = sys.modules[evaluator.__module__]
        return [evaluator.__qualname__, inspect.getsource(module if hasattr(module, "__file__") else evaluator)]
    except (AttributeError, KeyError, OSError, TypeError) as error:
        raise TypeError(f"evaluator: got {evaluator!r}, allowed is a plain function, or cache=False") from error


def _plain(value: Any) -> Any:
    """Return a value as new dicts and lists of arrays, numbers and text, whose hash is the same in any process."""
    if isinstance(value, pd.DataFrame):
        value = {name: value[name].to_numpy() for name in value}
    if is_dataclass(value) and not isinstance(value, type):
        public = {f.name: getattr(value, f.name) for f in fields(value) if not f.name.startswith("_")}
        value = {"class": type(value).__qualname__, **public}
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, np.ndarray) and value.dtype.kind != "O":
        return value
    raise TypeError(f"method: got {value!r} in it, allowed are numbers, text, arrays and dataclasses, or cache=False")


def durations(film: Film, methods: Sequence[Method], *, count: int = 20, progress: bool = True) -> pd.DataFrame:
    """Measure evaluation times τ, one frame after another, in this process.

    `evaluate` measures no times, since its worker processes slow each other down.

    Parameters
    ----------
    film : Film
    methods : sequence of Method
    count : int
        Frames, spread evenly over the film. The first is evaluated once before, untimed, as a warm-up.
    progress : bool
        Show a progress bar.

    Returns
    -------
    DataFrame
        The methods' labels, `frame`, and `tau_s`, the wall time.
    """
    methods, last = instances("methods", methods, Method), len(instance("film", film, Film)) - 1
    frames = np.unique(np.linspace(0, last, whole("count", count, 1, 10_000)).astype(int)).tolist()
    for method in methods:
        method(film[frames[0]])
    rows = []
    for frame in tqdm(frames, desc="timed", unit="frame", leave=False, disable=not flag("progress", progress)):
        image = film[frame]
        for method in methods:
            start = time.perf_counter()
            method(image)
            rows.append({**method.label, "frame": frame, "tau_s": time.perf_counter() - start})
    return pd.DataFrame(rows)


def sweep(
    films: Iterable[Film],
    methods: Sequence[Method],
    *,
    every: int = 1,
    level: float = 0.9,
    n_jobs: int = 1,
    cache: bool = True,
    progress: bool = True,
) -> pd.DataFrame:
    """Evaluate many films in many ways, and list the fractions that the monitor would see in each frame.

    A sweep that was interrupted continues, when it is called again, with the film that it was evaluating.

    Parameters
    ----------
    films : iterable of Film
        Told apart by `seed` and `image_type`. All are evaluated by the same methods.
    methods : sequence of Method
    every, n_jobs, cache, progress
        As in `evaluate`.
    level : float
        Fraction that triggers, in (0, 1] (paper: 0.9).

    Returns
    -------
    DataFrame
        A row for each film, method and evaluated frame:

        * `seed`, `image_type`, and the labels of the method;
        * `frame`, `t_s`; `count`, `fraction_h`, `fraction_w` of the particles measured (see `fractions`);
        * `true_count`, `true_fraction_h`, `true_fraction_w` of those whose centre is in the frame;
        * `level`; `true_h_s`, `true_w_s`: first of *all* frames of the film, evaluated or not, at which the
          true fraction reaches it (NaN: never).
    """
    films, methods = instances("films", films, Film), instances("methods", methods, Method)
    names = [(film.seed, film.image_type) for film in films]
    if len(set(names)) < len(names):
        raise ValueError(f"films: got {names}, allowed are films that differ in seed or image_type")
    if not films or not methods:
        raise ValueError(f"films, methods: got {len(films)} and {len(methods)}, allowed are one or more")
    parts = []
    for film in tqdm(films, desc="films", unit="film", disable=not flag("progress", progress)):
        channel, frames = film.trajectories.focusing.channel, evaluated_frames(film, every)
        truth = fractions(film.to_channel(film.truth()), np.arange(len(film)), channel).drop(columns="frame")
        triggers = {f"true_{a}_s": trigger_time(film.times_s, truth[f"fraction_{a}"], level) for a in "hw"}
        seen = truth.iloc[frames].add_prefix("true_").reset_index(drop=True)
        name = {"seed": film.seed, "image_type": film.image_type}
        bar = progress and len(films) == 1  # one bar is enough
        tables = evaluate(film, methods, every=every, n_jobs=n_jobs, cache=cache, progress=bar)
        for method, table in zip(methods, tables, strict=True):
            monitor = fractions(film.to_channel(table), frames, channel)
            monitor.insert(1, "t_s", film.times_s[frames])
            labels = pd.DataFrame({**name, **method.label}, index=monitor.index)
            parts.append(pd.concat([labels, monitor, seen], axis=1).assign(level=level, **triggers))
    return pd.concat(parts, ignore_index=True)


def watch(times_s: ArrayLike, tau_s: ArrayLike, phase_s: float = 0.0) -> pd.DataFrame:
    """List the frames that a monitor evaluates: whenever it is free, it takes the newest frame.

    If there is no newer frame than the last that it took, it waits for one. It stops at the end of the film.

    Parameters
    ----------
    times_s : array (n,)
        When frames arrive, increasing.
    tau_s : float or array (n,)
        Evaluation time, of any frame or of each.
    phase_s : float
        When the monitor is switched on.

    Returns
    -------
    DataFrame
        `index` into `times_s` and `t_s` of each frame used; `decision_s`, when its evaluation ends;
        `dropped`, the number of frames between it and the one used before.

    Raises
    ------
    TypeError, ValueError
        If τ is not above 0, the phase negative, or the times do not increase.
    """
    times = numbers("times_s", times_s)
    if times.ndim != 1 or not len(times) or not (np.diff(times) > 0).all():
        raise ValueError(f"times_s: got {times_s!r}, allowed are one or more increasing times")
    if np.ndim(tau_s) == 0:
        tau = np.full(len(times), positive("tau_s", tau_s))
    else:
        tau = numbers("tau_s", tau_s)
        if tau.shape != times.shape or not (np.isfinite(tau) & (tau > 0)).all():
            raise ValueError(
                f"tau_s: got {tau_s!r}, allowed is a number above 0, or one for each of {len(times)} frames"
            )
    end = times[-1] + (times[-1] - times[-2] if len(times) > 1 else np.inf)
    now, last, rows = positive("phase_s", phase_s, zero=True), -1, []
    while now < end - 1e-9:
        newest = int(np.searchsorted(times, now + 1e-9, side="right")) - 1  # but for rounding, times[newest] <= now
        if newest == last:
            if last == len(times) - 1:
                break
            newest = last + 1
        start = max(now, times[newest])
        now = start + tau[newest]
        rows.append((newest, times[newest], now, newest - last - 1 if rows else 0))
        last = newest
    table = pd.DataFrame(rows, columns=["index", "t_s", "decision_s", "dropped"])
    return table.astype({"index": int, "t_s": float, "decision_s": float, "dropped": int})


def expected_delay(tau_s: ArrayLike, camera_s: float = 0.04, truth_s: float | None = None) -> pd.DataFrame:
    """Return the expected delay of a monitor that measures without error: the grey area of Figure 5.

    The true trigger is at a frame of the film, at T. From then on the monitor looks out for the first evaluation
    that starts at or after the first frame it can see, T + A. Switched on at a random moment, it starts one at
    T + A + U, with U even over 0 to τ, and takes the newest frame there is: T + A + d floor(U / d), where d is
    the time between frames it can see. If τ < d it waits for each of them, and the delay is A alone. A is 0 where
    it can see every frame; where only every k-th is evaluated, A is one of 0, d/k, ... (k - 1) d/k, all as likely.
    The moment of decision is later by one τ, and by the frame's age, U - d floor(U / d), on top.

    Parameters
    ----------
    tau_s : float or array (n,)
        Evaluation times.
    camera_s : float
        Time between the frames that are evaluated, d.
    truth_s : float, optional
        Time between the frames of the film, d / k; d if not given.

    Returns
    -------
    DataFrame
        `tau_s`; `mean_s`, `low_s` and `high_s`: mean, smallest and largest delay of the frame's timestamp.

    Raises
    ------
    TypeError, ValueError
        If an argument is not of that form, or times are more than 1e9 times as long as others.
    """
    tau = _one_axis("tau_s", tau_s)
    for value in tau.tolist():
        positive("tau_s", value)
    d = positive("camera_s", camera_s)
    fine = d if truth_s is None else positive("truth_s", truth_s)
    if not fine * 1e9 > d or abs(d / fine - round(d / fine)) > 1e-6 or round(d / fine) < 1:
        raise ValueError(f"truth_s: got {fine:g}, allowed is a whole part of camera_s = {d:g}")
    if not tau.max() <= 1e9 * d:
        raise ValueError(
            f"camera_s: got {d:g}, allowed is at least 1e-9 of tau_s, of which the longest is {tau.max():g}"
        )
    full = np.floor(tau / d + 1e-9)  # steps of the staircase d floor(U / d) that are whole
    mean = d * (full * (full - 1) / 2 * d + full * np.maximum(tau - full * d, 0)) / tau
    high = d * np.maximum(np.ceil(tau / d - 1e-9) - 1, 0)
    return pd.DataFrame({"tau_s": tau, "mean_s": mean + (d - fine) / 2, "low_s": 0.0, "high_s": high + d - fine})


def errors(
    table: pd.DataFrame, tau_s: ArrayLike | None = None, *, phases: int = 8, limit_s: float = 1.0
) -> pd.DataFrame:
    """Replay the monitor over evaluated films, and compare its trigger times with the true ones.

    Parameters
    ----------
    table : DataFrame
        From `sweep`.
    tau_s : float or array, optional
        Evaluation times to impose. By default those in the table's column `tau_s`, which can differ between
        methods and between frames.
    phases : int
        Number of moments of switching on, evenly over one τ (or the time between frames, if that is longer).
    limit_s : float
        Largest error of a trigger time, beyond the clock's own delay, that does not count as a failure, s.

    Returns
    -------
    DataFrame
        A row for each film, method, τ, phase and trigger:

        * `seed`, `image_type`, labels; `tau_s` (the mean, where it differs from frame to frame), `phase_s`;
          `trigger`, 'h' or 'w'; `true_s`, the film's true trigger time;
        * `error_s`: timestamp of the first frame used that reaches the level, minus `true_s`;
          `decision_error_s`: the moment of decision minus `true_s`; both NaN where `fired` is False;
        * `delay_s`: the error of the same clock with true positions; `own_error_s` = `error_s` - `delay_s`;
        * `dropped`: frames dropped until then (or the film's end);
        * `fired`; `possible`, whether the clock would fire with true positions before the film ends;
          `failed`: it was possible, but the monitor never fired or its own error is beyond ± `limit_s`.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of range, or there is no τ.
    """
    whole("phases", phases, 1, 10_000)
    positive("limit_s", limit_s)
    if tau_s is not None:
        _one_axis("tau_s", tau_s)
    columns = [
        "frame",
        "t_s",
        "fraction_h",
        "fraction_w",
        "true_fraction_h",
        "true_fraction_w",
        "level",
        "true_h_s",
        "true_w_s",
    ]
    table = check_table("table", table, columns).astype(dict.fromkeys(columns[1:], float))
    numbers("table, column t_s", table["t_s"])
    if tau_s is None and "tau_s" not in table:
        raise ValueError("tau_s: got None, allowed is a number above 0 where the table has no column tau_s")
    keys = [name for name in table.columns[: table.columns.get_loc("frame")] if name != "tau_s"]
    clocks: dict[tuple, tuple] = {}
    rows = []
    for key, part in table.groupby(keys, sort=False):
        times = part["t_s"].to_numpy()
        seen = part[["fraction_h", "fraction_w", "true_fraction_h", "true_fraction_w"]].to_numpy().T
        seen, true = seen >= part["level"].iloc[0], part[["true_h_s", "true_w_s"]].iloc[0].tolist()
        for tau in [part["tau_s"].to_numpy()] if tau_s is None else np.atleast_1d(tau_s).tolist():
            for k in range(phases):
                name = (times.tobytes(), np.asarray(tau).tobytes(), k)
                if name not in clocks:
                    clocks[name] = _clock(times, tau, (k + 0.5) / phases)
                mean, phase, index, t, decision, dropped = clocks[name]
                hit = seen[:, index]
                ever, first = hit.any(axis=1).tolist(), hit.argmax(axis=1).tolist()
                for i, trigger in enumerate("hw"):
                    j, fired, ideal = first[i], ever[i], ever[i + 2]
                    error, decided = (t[j] - true[i], decision[j] - true[i]) if fired else (np.nan, np.nan)
                    delay = t[first[i + 2]] - true[i] if ideal else np.nan
                    off = not abs(error - delay) <= limit_s  # so, too, if there is no error
                    result = (true[i], error, delay, error - delay, decided, dropped[j if fired else -1])
                    rows.append((*key, mean, phase, trigger, *result, fired, ideal, ideal and off))
    columns = ["tau_s", "phase_s", "trigger", "true_s", "error_s", "delay_s", "own_error_s", "decision_error_s"]
    return pd.DataFrame(rows, columns=[*keys, *columns, "dropped", "fired", "possible", "failed"])


def _one_axis(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return a number, or numbers along one axis, as an array (n,)."""
    array = np.atleast_1d(numbers(name, value))
    if array.ndim > 1 or not array.size:
        raise ValueError(f"{name}: got shape {array.shape}, allowed is a number, or one axis of one or more")
    return array


def _clock(times: NDArray, tau: float | NDArray, fraction: float) -> tuple:
    """Return mean τ, phase and index (k,) of the frames used at times (n,), and lists (k,) of time, decision, drops."""
    mean = float(np.mean(tau))
    phase = fraction * (max(mean, times[1] - times[0]) if len(times) > 1 else mean)
    used = watch(times, tau, phase)
    if used.empty:
        raise ValueError(f"tau_s: got {mean:g}, allowed is no more than the film lasts")
    lists = (used["t_s"].tolist(), used["decision_s"].tolist(), used["dropped"].cumsum().tolist())
    return mean, phase, used["index"].to_numpy(), *lists


def summary(table: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """Return median and quartiles of trigger errors, with the numbers of replays that they leave out.

    Parameters
    ----------
    table : DataFrame
        From `errors`.
    by : sequence of str
        Columns to group by; 'trigger' should be among them.

    Returns
    -------
    DataFrame
        `by`; `films`; `replays` that were possible; of these `never` (did not fire) and `failed` (those, and the
        ones beyond the limit); `impossible`, not among them: the film ends too early. For `error_s` and
        `own_error_s` of all possible ones that fired: `..._median`, `..._q25`, `..._q75` (NaN where none did).
    """
    by, rows = instances("by", by, str), []
    check_table("table", table, ["possible", "fired", "failed", "error_s", "own_error_s"])
    if not by or {*by, "seed", "image_type"} - set(table):
        raise ValueError(f"by: got {by}, allowed are one or more columns of the table, {', '.join(table)}")
    for key, part in table.groupby(by, sort=False):
        possible = part[part["possible"].astype(bool)]
        fired = possible[possible["fired"].astype(bool)]
        row = dict(zip(by, key, strict=True)) | {
            "films": len(part[["seed", "image_type"]].drop_duplicates()),
            "replays": len(possible),
            "never": len(possible) - len(fired),
            "failed": int(possible["failed"].sum()),
            "impossible": len(part) - len(possible),
        }
        for name in ("error_s", "own_error_s"):
            for suffix, q in {"median": 0.5, "q25": 0.25, "q75": 0.75}.items():
                row[f"{name}_{suffix}"] = fired[name].quantile(q)
        rows.append(row)
    return pd.DataFrame(rows)
