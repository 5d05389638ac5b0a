"""The tables behind the paper's Figure 5: many films, many settings, three kinds of image, two evaluators.

Too much for a notebook that is run each time, so `python -m gdptlab sweep` computes the tables once, and notebooks
05, 06 and 07 draw them. What has been evaluated is kept in the cache folder: a sweep that was stopped goes on where
it was.

Four tables of what a monitor sees (`PARTS`) go into one file, a row for each film, setting and evaluated frame, with
the columns of `replay.sweep` and `valid`, the number of measured particles that match a true one
(`assessment.count_valid`). The times of evaluation go into a second file, and a card into a third.
"""

import argparse
import json
import platform
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import binomtest, norm
from tqdm.auto import tqdm

from gdptlab._checks import whole
from gdptlab._files import written_whole
from gdptlab._versions import versions
from gdptlab.assessment import count_valid
from gdptlab.calibration import Calibration
from gdptlab.experiment.film import Film
from gdptlab.experiment.image_types import IMAGE_TYPES
from gdptlab.experiment.plain import locate_plainly
from gdptlab.experiment.replay import Method, durations, evaluate, evaluated_frames, sweep
from gdptlab.locate import locate

DATA = Path(__file__).parents[2] / "data"
"""Folder of the tables."""

MEAN_IN_VIEW = 25.0
"""Mean number of particles in the field of view. The paper names none; notebook 05 compares 25, 50 and 100."""

SIZE_PX = 31
"""Rows and columns of a template, px, chosen by accuracy in notebook 04. The paper names no size."""

THRESHOLD = 0.5
"""Lowest C_m of a particle (paper, section 2)."""

LEVEL = 0.9
"""Fraction of the particles that triggers (paper, section 4)."""

EARLY_S = 8.0
"""Every frame up to this time (s) is evaluated: both triggers are over by then (closed form: 2.2 and 4.8 s)."""

SETTINGS = {
    "gdptlab": ((51, 9), (51, 6), (51, 4), (11, 9), (11, 6), (11, 4), (6, 6), (6, 4)),
    "plain": ((51, 9), (51, 4), (6, 6)),
}
"""N and N_sub, each with refinement and without. N = 51 and N = 6 are the paper's, the other numbers ours."""

EVALUATORS = {
    "gdptlab": (locate, {}),
    "OpenCV": (locate_plainly, {"correlate": "opencv"}),
    "scikit-image": (locate_plainly, {"correlate": "scikit-image"}),
}
"""Evaluators that are timed. The two plain ones find the same, so OpenCV's is the one that evaluates films."""


REPEATS = 3
"""Runs of each timed evaluation, of which the least counts."""


@dataclass(frozen=True)
class Part:
    """Films of some kinds, evaluated in some ways: every frame up to `duration_s`, or one of `every` so many."""

    image_types: tuple[str, ...]
    evaluator: str
    settings: tuple[tuple[int, int], ...]
    duration_s: float = EARLY_S
    every: int = 1


PARTS = {
    "settings": Part(("fluorescent",), "gdptlab", SETTINGS["gdptlab"]),
    "image types": Part(("brightfield", "disturbed"), "gdptlab", SETTINGS["gdptlab"][:3]),
    "later": Part(("fluorescent",), "gdptlab", ((51, 9), (51, 4), (6, 6), (6, 4)), duration_s=20.0, every=10),
    "plain": Part(("fluorescent",), "OpenCV", SETTINGS["plain"], every=5),
}
"""What is evaluated. A plain evaluator takes ten times as long, and sees every fifth frame. What comes `later` than
`EARLY_S` only numbers of particles and very slow monitors need: every tenth frame will do."""


def film(seed: int, image_type: str = "fluorescent", duration_s: float = 20.0, **changed: object) -> Film:
    """First `duration_s` of one of the films of 20 s; `changed` are other settings of `Film.seeded`."""
    whole_film = Film.seeded(seed, **{"mean_in_view": MEAN_IN_VIEW, "image_type": image_type} | changed)
    return replace(whole_film, trajectories=replace(whole_film.trajectories, duration_s=duration_s))


@cache
def methods(evaluator: str, image_type: str, settings: tuple[tuple[int, int], ...]) -> list[Method]:
    """Ways to evaluate a frame: each pair of N and N_sub, with refinement and without."""
    function, own = EVALUATORS[evaluator]
    stack = film(1, image_type).stack(size=SIZE_PX)
    calibrations = {(n, n_sub): Calibration.from_stack(*stack, n=n, n_sub=n_sub) for n, n_sub in settings}
    return [
        Method(
            evaluator=function,
            calibration=calibration,
            settings={"threshold": THRESHOLD, "refine": refine, **own},
            label={"evaluator": evaluator, "n": n, "n_sub": n_sub, "refine": refine},
        )
        for (n, n_sub), calibration in calibrations.items()
        for refine in (True, False)
    ]


def monitor(part: Part, seed: int) -> pd.DataFrame:
    """What the monitor sees of one film in each of its image types, as from `replay.sweep`, and `valid` particles."""
    tables = []
    for image_type in part.image_types:
        one, ways = film(seed, image_type, part.duration_s), methods(part.evaluator, image_type, part.settings)
        table = sweep([one], ways, every=part.every, level=LEVEL, progress=False)
        found = evaluate(one, ways, every=part.every, progress=False)  # from the cache
        frames, true = evaluated_frames(one, part.every), one.truth()
        valid = [count_valid(measured, true, frames) for measured in found]
        tables.append(table.assign(valid=np.concatenate(valid)))
    return pd.concat(tables, ignore_index=True)


def times(count: int) -> pd.DataFrame:
    """Evaluation times of every setting, with both plain evaluators: labels, `frame`, `tau_s`.

    Each is the least of `REPEATS` runs, since what else runs on a machine can only add to it.
    """
    tables = []
    for image_type in IMAGE_TYPES:
        ways = methods("gdptlab", image_type, SETTINGS["gdptlab"])
        if image_type == "fluorescent":
            ways = [
                *ways,
                *(m for name in ("OpenCV", "scikit-image") for m in methods(name, image_type, SETTINGS["plain"])),
            ]
        runs = [durations(film(1, image_type), ways, count=count, progress=False) for _ in range(REPEATS)]
        tables.append(pd.concat(runs).assign(image_type=image_type))
    names = ["image_type", *ways[0].label, "frame"]
    return pd.concat(tables).groupby(names, sort=False, as_index=False)["tau_s"].min()


def processor() -> str:
    """Name of this machine's processor."""
    try:
        return re.search(r"model name\s*:\s*(.+)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))[1]
    except (OSError, TypeError):
        return platform.processor() or platform.machine()


def load(folder: Path = DATA) -> tuple[dict[str, pd.DataFrame], pd.DataFrame, dict]:
    """Read what `main` wrote.

    Parameters
    ----------
    folder : path, optional
        The repository's `data/` if not given.

    Returns
    -------
    monitors : dict of DataFrame
        By the names of `PARTS`.
    times : DataFrame
        `image_type`, `evaluator`, `n`, `n_sub`, `refine`, `frame`, `tau_s`.
    card : dict
        How, when and on what machine the tables were made.
    """
    table = pd.read_parquet(folder / "figure5_monitor.parquet")
    monitors = {name: part.drop(columns="part").reset_index(drop=True) for name, part in table.groupby("part")}
    card = json.loads((folder / "figure5_card.json").read_text(encoding="utf-8"))
    return monitors, pd.read_csv(folder / "figure5_times.csv"), card


def verdicts(errors: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Sum up the trigger errors of many films; a film that failed is counted, and is not in median and quartiles.

    Parameters
    ----------
    errors : DataFrame
        From `replay.errors`. Replays that could not fire before their film ends (`possible` is False) are left out.
    by : list of str
        Columns to group by; 'trigger' should be among them.

    Returns
    -------
    DataFrame
        The columns `by`; `median`, `q25`, `q75` of `error_s`; `own`, the median of `own_error_s`, which is less the
        delay of the clock; `failed`, the fraction of replays that failed, and `failed_low`, `failed_high`, the ends
        of its 95 % interval (Wilson, with one count a film); `films`, their number.
    """
    rows = []
    for key, part in errors[errors["possible"]].groupby(by, sort=False):
        right, films = part[~part["failed"]], part.groupby(["seed", "image_type"])["failed"].mean()
        interval = binomtest(round(films.sum()), len(films)).proportion_ci(method="wilson")
        low, middle, high = right["error_s"].quantile([0.25, 0.5, 0.75])
        found = {"median": middle, "q25": low, "q75": high, "own": right["own_error_s"].median()}
        found |= {"failed": part["failed"].mean(), "failed_low": interval.low, "failed_high": interval.high}
        rows.append(dict(zip(by, key, strict=True)) | found | {"films": len(films)})
    return pd.DataFrame(rows)


def paired_difference(errors: pd.DataFrame, one: str, other: str) -> tuple[float, float, float]:
    """Compare how often two settings fail on the same films: `one` less `other`, and the ends of the 95 % interval.

    Parameters
    ----------
    errors : DataFrame
        From `replay.errors`.
    one, other : str
        Queries that pick the rows of each setting.

    Returns
    -------
    (float, float, float)
        Mean over the films, and the interval for proportions in pairs of D. G. Bonett and R. M. Price (Br. J. Math.
        Stat. Psychol. 65 (2012) 479), which has a width even if no film differs.
    """
    possible = errors[errors["possible"]]
    first, second = (possible.query(q).groupby("seed")["failed"].mean() for q in (one, other))
    difference = (first - second).dropna().to_numpy()
    number = len(difference) + 2
    more, fewer = ((np.maximum(sign * difference, 0).sum() + 1) / number for sign in (1, -1))
    half_width = norm.ppf(0.975) * np.sqrt((more + fewer - (more - fewer) ** 2) / number)
    return difference.mean(), more - fewer - half_width, more - fewer + half_width


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line ``python -m gdptlab sweep``; give its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m gdptlab sweep",
        description=f"{__doc__.splitlines()[0]} This takes about an hour with all films (the card in the folder says "
        "how long it took last). It may be stopped at any time: the same command goes on where it was.",
    )
    parser.add_argument("--films", type=int, default=20, help="films of each kind (20)")
    parser.add_argument("--frames-timed", type=int, default=12, help="frames on which evaluations are timed (12)")
    parser.add_argument("--films-plain", type=int, help="films for the plain evaluator (as many)")
    parser.add_argument("--every", type=int, default=1, help="evaluate only every so many frames (1)")
    parser.add_argument("--folder", type=Path, default=DATA, help="folder of the tables (data/)")
    options = parser.parse_args(arguments)
    started = datetime.now(UTC)
    films = dict.fromkeys(PARTS, whole("--films", options.films, 1, 10_000))
    films["plain"] = whole("--films-plain", options.films_plain or options.films, 1, 10_000)

    tables = []
    for name, part in PARTS.items():
        slower = replace(part, every=max(part.every, whole("--every", options.every, 1, 25)))
        for seed in tqdm(range(1, films[name] + 1), desc=name, unit="film"):
            table = monitor(slower, seed)
            tables.append(table[(name != "later") | (table["t_s"] >= EARLY_S)].assign(part=name))
    timed = times(options.frames_timed)
    card = {
        "command": f"python -m gdptlab sweep --films {options.films} --films-plain {films['plain']}"
        f" --every {options.every}",
        "date": started.date().isoformat(),
        "minutes": round((datetime.now(UTC) - started).total_seconds() / 60, 1),
        "films": films,
        "seeds": "films 1, 2, ... of gdptlab.experiment.figure5.film",
        "processor": processor(),
        "versions": {name: version for name, version in versions().items() if name != "platform"},
    }
    with written_whole(options.folder / "figure5_monitor.parquet") as temporary:
        pd.concat(tables, ignore_index=True).to_parquet(temporary, compression="zstd", index=False)
    with written_whole(options.folder / "figure5_times.csv") as temporary:
        timed.round({"tau_s": 5}).to_csv(temporary, index=False, lineterminator="\n")
    with written_whole(options.folder / "figure5_card.json") as temporary:
        temporary.write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
